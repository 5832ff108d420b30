"""The delta-dynamics ensemble: s' = s + std * f(s, a), deterministic members with their own weights and data."""

import jax
import jax.numpy as jnp
import optax

from envs.types import Array, Key, PyTree
from sgft_jax.math import losses, optim
from sgft_jax.models.networks import Network
from sgft_jax.models.normalizer import normalize
from sgft_jax.types import Batch, Metrics, Normalizer

__all__ = ["draw_member", "predict", "predict_each", "rollout_error", "update"]


def predict(network: Network, params: PyTree, normalizer: Normalizer, obs: Array, action: Array) -> Array:
    """Successors predicted by every member. obs: [obs_dim] raw; action: [act_dim]. Returns [members, obs_dim] raw."""
    change = network.apply(params, normalize(normalizer, obs), action)
    return jax.vmap(lambda d: obs + normalizer.std * d)(change)


def predict_each(network: Network, params: PyTree, normalizer: Normalizer, obs: Array, action: Array) -> Array:
    """Successors of members that each are somewhere else. obs: [members, obs_dim] raw; action: [act_dim] of all."""
    own = lambda p, o: predict(network, jax.tree.map(lambda x: x[None], p), normalizer, o, action)[0]  # noqa: E731
    return jax.vmap(own)(params, obs)


def draw_member(params: PyTree, key: Key) -> PyTree:
    """The parameters of one random member, still with a leading axis (of 1)."""
    members = jax.tree.leaves(params)[0].shape[0]
    index = jax.random.randint(key, (1,), 0, members)
    return jax.tree.map(lambda p: p[index], params)


def update(
    network: Network,
    optimiser: optax.GradientTransformation,
    fit: optim.Fit,
    normalizer: Normalizer,
    batch: Batch,
    key: Key,
    *,
    rate: Array | float,
) -> tuple[optim.Fit, Metrics]:
    """One step of every member on its own Bayesian bootstrap of the batch [B, ...].

    Each member weighs each row by an independent Exp(1) draw (mean 1), so members follow different gradients from the
    same rows; no row is gathered twice.
    """
    members = jax.tree.leaves(fit.params)[0].shape[0]
    weights = jax.random.exponential(key, (batch.reward.shape[0], members))
    normal = jax.vmap(normalize, (None, 0))
    obs, next_obs = normal(normalizer, batch.obs), normal(normalizer, batch.next_obs)

    def loss(params: PyTree) -> tuple[Array, Array]:
        predictions = jax.vmap(network.apply, (None, 0, 0))(params, obs, batch.action)
        errors = jax.vmap(jax.vmap(losses.dynamics_loss, (0, None)))(predictions, next_obs - obs)
        # Sum over members: their parameters are disjoint, so each follows its own mean.
        each = jax.vmap(losses.row_mean, (1, None))(weights * errors, batch)
        return jnp.sum(each), losses.row_mean(jnp.mean(errors, axis=1), batch)

    grads, error = jax.grad(loss, has_aux=True)(fit.params)
    return optim.step(optimiser, fit, grads, rate), {"dynamics/mse": error}


def rollout_error(network: Network, params: PyTree, normalizer: Normalizer, obs: Array, actions: Array) -> Array:
    """How far open-loop predictions drift from one recorded trajectory.

    obs: [T + 1, obs_dim] raw; actions: [T, act_dim]. Returns [T] RMS error over members and entries after 1..T steps,
    in standard deviations of the observation.
    """
    members = jax.tree.leaves(params)[0].shape[0]

    def advance(imagined: Array, inputs: tuple[Array, Array]) -> tuple[Array, Array]:
        action, true_obs = inputs
        imagined = predict_each(network, params, normalizer, imagined, action)
        error = jax.vmap(lambda o: (o - true_obs) / normalizer.std)(imagined)
        return imagined, jnp.sqrt(jnp.mean(error**2))

    return jax.lax.scan(advance, jnp.tile(obs[0], (members, 1)), (actions, obs[1:]))[1]
