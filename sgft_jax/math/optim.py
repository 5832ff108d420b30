"""One Adam per network: a network that is not stepped cannot move, not even by momentum."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from envs.types import Array, PyTree


class Fit(NamedTuple):
    """A network in training: its `params` and the optimiser's `moments`."""

    params: PyTree
    moments: PyTree


def adam(max_grad_norm: float | None = None) -> optax.GradientTransformation:
    """Adam without a learning rate, which `step` takes as a number so that it can be a vmapped leaf."""
    clip = optax.identity() if max_grad_norm is None else optax.clip_by_global_norm(max_grad_norm)
    return optax.chain(clip, optax.scale_by_adam())


def start(optimiser: optax.GradientTransformation, params: PyTree) -> Fit:
    """Fresh moments for `params`."""
    return Fit(params, optimiser.init(params))


def step(optimiser: optax.GradientTransformation, fit: Fit, grads: PyTree, rate: Array | float) -> Fit:
    """One descent step. rate: [] learning rate."""
    updates, moments = optimiser.update(grads, fit.moments, fit.params)
    return Fit(jax.tree.map(lambda p, u: p - rate * u, fit.params, updates), moments)


def minimise[Aux](
    optimiser: optax.GradientTransformation,
    loss: Callable[[PyTree], tuple[Array, Aux]],
    fit: Fit,
    rate: Array | float,
) -> tuple[Fit, Array, Aux]:
    """One descent step on `loss(params) -> (value [], aux)`, and both from before it. rate: [] learning rate."""
    (value, aux), grads = jax.value_and_grad(loss, has_aux=True)(fit.params)
    return step(optimiser, fit, grads, rate), value, aux


def as_leaves(kind: Any, options: Any = None) -> Any:
    """The numbers `kind`, a NamedTuple, as float32 arrays: new ones then vmap, and compile no update again.

    options: whatever has them as attributes, such as numbers of that kind or the options of a method; None = its
    defaults.
    """
    options = kind() if options is None else options
    return kind(*jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), [getattr(options, name) for name in kind._fields]))


def warmup_factor(step: Array, warmup: Array | float) -> Array:
    """Factor [] on the learning rate of the update after `step` [] others; it rises linearly to 1 over `warmup`.

    Adam's first steps are as long as its rate in every weight, however small the gradient, because its moments know
    nothing else yet. In a network that comes from a prior they undo more than a few rows of new data can teach.
    """
    return jnp.clip((step + 1) / jnp.maximum(warmup, 1.0), 0.0, 1.0)


def cosine_factor(step: Array, updates: Array | float) -> Array:
    """Factor [] on the learning rate of the update after `step` [] others; it falls from 1 along half a cosine.

    updates: [] over which it falls; it is 0 from then on. Infinitely many leave it at 1.
    """
    return 0.5 * (1 + jnp.cos(jnp.pi * jnp.minimum(step / updates, 1.0)))


def steps_of(fit: Fit) -> Array:
    """How many steps [] a network in training has made."""
    return optax.tree.get(fit.moments, "count")
