"""Pytrees with a leading axis of members, such as seeds. Pure."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from envs.types import Array, PyTree


def stack(trees: Sequence[PyTree]) -> PyTree:
    """Equal pytrees stacked on a new leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def join(trees: Sequence[PyTree]) -> PyTree:
    """Pytrees with that axis already, one after another."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *trees)


def member(tree: PyTree, i: int | Array) -> PyTree:
    """The i-th of stacked pytrees."""
    return jax.tree.map(lambda x: x[i], tree)


def part(tree: PyTree, i: int | Array, n: int) -> PyTree:
    """The i-th n of stacked pytrees."""
    return jax.tree.map(lambda x: x.reshape(len(x) // n, n, *x.shape[1:])[i], tree)
