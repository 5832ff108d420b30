"""Pytrees with a leading axis of seeds. Pure."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

from sgft_jax.types import Array, Key, PyTree


def seed_keys(seeds: Sequence[int], purpose: int) -> Key:
    """Keys [n_seeds] that depend on nothing but the seed and a number that stands for the purpose."""
    return jnp.stack([jax.random.fold_in(jax.random.key(seed), purpose) for seed in seeds])


def stack(trees: Sequence[PyTree]) -> PyTree:
    """Equal pytrees stacked on a new leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def member(tree: PyTree, i: int | Array) -> PyTree:
    """The i-th of stacked pytrees."""
    return jax.tree.map(lambda x: x[i], tree)


def part(tree: PyTree, i: int | Array, n: int) -> PyTree:
    """The i-th n of stacked pytrees."""
    return jax.tree.map(lambda x: x.reshape(-1, n, *x.shape[1:])[i], tree)
