"""Behaviour cloning: the actor imitates the actions of the batch."""

import jax
import jax.numpy as jnp
from flax import struct

from sgft_jax.learners import losses, optim
from sgft_jax.models import normalizer
from sgft_jax.models.config import NetworkConfig
from sgft_jax.models.networks import make_actor, tanh_gaussian_action
from sgft_jax.types import Array, Batch, Key, Learner, Metrics, Normalizer, PyTree


class BCState(struct.PyTreeNode):
    """actor: in training. normalizer: fixed observation statistics."""

    actor: optim.Fit
    normalizer: Normalizer


def make_bc(obs_dim: int, act_dim: int, network: NetworkConfig, rate: float) -> Learner:
    """The learner; rate: Adam's learning rate."""
    actor, optimiser = make_actor(obs_dim, act_dim, network), optim.adam()

    def init(key: Key) -> BCState:
        return BCState(optim.start(optimiser, actor.init(key)), normalizer.identity(obs_dim))

    def act(
        state: BCState, carry: tuple[()], obs: Array, key: Key, *, explore: bool | Array, context: Array | None = None
    ) -> tuple[Array, tuple[()]]:
        moments = actor.apply(state.actor.params, normalizer.normalize(state.normalizer, obs))
        return tanh_gaussian_action(moments, key, explore=explore), carry

    def update(state: BCState, batch: Batch, key: Key) -> tuple[BCState, Metrics]:
        def loss(params: PyTree) -> Array:
            def one(obs: Array, action: Array) -> Array:
                mean = jnp.tanh(actor.apply(params, normalizer.normalize(state.normalizer, obs))[0])
                return jnp.sum((mean - action) ** 2)

            return losses.row_mean(jax.vmap(one)(batch.obs, batch.action), batch)

        value, grads = jax.value_and_grad(loss)(state.actor.params)
        return state.replace(actor=optim.step(optimiser, state.actor, grads, rate)), {"actor/loss": value}

    return Learner(init, lambda: (), act, update)
