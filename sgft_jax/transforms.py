"""SGFT as transforms of a sampled batch: relabel, branch, weigh, shape, clip, shorten.

A method composes them in this order. Relabelling and branching come first, because they make rows. Shaping comes before
shortening, because it needs the discount of the whole task.
Source: SGFT (Yin et al., ICLR 2025), section 4 and Algorithms 1 and 2; for weights H2O+ (Niu et al. 2023).
"""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from envs.types import Array, Key, PyTree
from sgft_jax.math import losses
from sgft_jax.models import ratio
from sgft_jax.models.networks import add_noise
from sgft_jax.types import Batch, Imagination, Metrics, Transform

__all__ = ["branch", "clip", "compose", "relabel", "shape", "shaped_reward", "shorten", "stateless", "weigh"]


def stateless(apply: Callable[[Any, Batch, Key], Batch]) -> Transform:
    """A transform that learns nothing."""
    return Transform(lambda params, key: (), lambda state, imagination, batch, key: apply(imagination, batch, key))


def compose(*transforms: Transform) -> Transform:
    """Applies transforms from left to right, each with its own key and state."""
    n = max(len(transforms), 1)

    def init(params: PyTree, key: Key) -> PyTree:
        keys = jax.random.split(key, n)
        return tuple(transform.init(params, sub) for transform, sub in zip(transforms, keys, strict=False))

    def apply(states: PyTree, imagination: Any, batch: Batch, key: Key) -> Batch:
        for transform, state, sub in zip(transforms, states, jax.random.split(key, n), strict=False):
            batch = transform.apply(state, imagination, batch, sub)
        return batch

    def update(states: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
        members = zip(transforms, states, jax.random.split(key, n), strict=False)
        done = [transform.update(state, batch, sub) for transform, state, sub in members]
        return tuple(state for state, _ in done), {name: x for _, metrics in done for name, x in metrics.items()}

    return Transform(init, apply, update)


# --- rewards ----------------------------------------------------------------------------------------------------------


def shaped_reward(imagination: Imagination, row: Batch) -> Array:
    """Shaped reward [] r + discount V(s') - V(s) of one row. The discount makes V count as 0 after a termination."""
    return row.reward + row.discount * imagination.value(row.next_obs) - imagination.value(row.obs)


@stateless
def shape(imagination: Imagination, batch: Batch, key: Key) -> Batch:
    """Replaces every reward by the shaped one. Source: SGFT Algorithm 1; `key` is not used."""
    del key
    return batch._replace(reward=jax.vmap(lambda row: shaped_reward(imagination, row))(batch))


def clip(bound: float | None) -> Transform:
    """Keeps every reward in [-bound, bound]; None leaves it as it is.

    V_sim falls off a cliff where a task can be lost for good, such as a puck over the edge. One such row outweighs a
    thousand others in a squared error, and its sign is all that a policy needs.
    """
    limit = jnp.inf if bound is None else bound
    return stateless(lambda imagination, batch, key: batch._replace(reward=jnp.clip(batch.reward, -limit, limit)))


# --- horizons ---------------------------------------------------------------------------------------------------------


def steps_to_go(k: Array, horizon: int) -> Array:
    """The context [horizon] that tells a network that `k` [] steps of a segment are left: one_hot(k), zeros for 0."""
    return jax.nn.one_hot(k - 1, horizon, dtype=jnp.float32)


def shorten(horizon: int) -> Transform:
    """Ends every segment after `horizon` steps: no bootstrap in the last one, and a context with the steps to go.

    Rows without a segment draw k ~ Uniform{1..H}: a real transition is as good a step of any segment. The context of
    next observations says k - 1. With horizon 1 every row ends its segment, and there is no context.
    Source: SGFT section 4.2.
    """

    def apply(imagination: Imagination, batch: Batch, key: Key) -> Batch:
        del imagination
        if horizon == 1:
            return batch._replace(discount=jnp.zeros_like(batch.discount))
        k = jax.random.randint(key, batch.reward.shape, 1, horizon + 1)
        if batch.context is not None:
            assigned = jnp.round(batch.context @ jnp.arange(1.0, horizon + 1)).astype(jnp.int32)
            k = jnp.where(assigned == 0, k, assigned)
        tell = jax.vmap(steps_to_go, (0, None))
        return batch._replace(
            context=tell(k, horizon), next_context=tell(k - 1, horizon), discount=jnp.where(k == 1, 0.0, batch.discount)
        )

    return stateless(apply)


# --- weights ----------------------------------------------------------------------------------------------------------

_LR_RATIO = 3e-4  # Adam's rate of the discriminators, as in the released code of H2O+


def weigh(config: ratio.RatioConfig) -> Transform:
    """Weighs every simulated row by w = min(P(s'|s, a) / P_sim(s'|s, a), 1), and every real one by 1.

    w comes from two discriminators. In every update they first take a step on the rows as they were sampled: the real
    replay against the simulator. They read observations that are standardised by the statistics of the prior.
    After `relabel` or `branch`, s' is what the models expect. Then w says whether that looks like the real system or
    like the simulator. Batches must say which rows are simulated. Source: H2O+ Eqs. (8), (9).
    """

    def init(params: PyTree, key: Key) -> ratio.RatioState:
        state = ratio.init(config, key)
        return state if params is None else state._replace(normalizer=params.normalizer)

    def apply(state: ratio.RatioState, imagination: Any, batch: Batch, key: Key) -> Batch:
        del imagination, key
        weights = jax.vmap(ratio.weight)(ratio.log_ratios(config, state, batch))
        return batch._replace(weight=jnp.where(losses.is_simulated(batch), weights, 1.0))

    def update(state: ratio.RatioState, batch: Batch, key: Key) -> tuple[ratio.RatioState, Metrics]:
        state, _, metrics = ratio.step(config, state, batch, batch, key, rate=_LR_RATIO)
        return state, metrics

    return Transform(init, apply, update)


# --- models -----------------------------------------------------------------------------------------------------------


def branch(horizon: int, branches: int, *, noise: float | Array = 0.0, segments: bool = True) -> Transform:
    """Appends `branches` imagined rollouts of `horizon` steps from every row's observation, after the rows themselves.

    B rows become B (1 + branches * horizon). noise: std of Gaussian noise on the policy's imagined actions, in units of
    the action's range [-1, 1]: the policy's own actions say nothing about better ones. segments: policy and learner
    read the steps to go; False for methods with an infinite horizon. After an imagined termination a
    rollout repeats its last transition, so that every row stays valid.
    Source: SGFT Algorithm 2; MBPO (Janner et al. 2019).
    """
    segmented = segments and horizon > 1

    def rollout(imagination: Imagination, start: Batch, key: Key) -> Batch:
        """One branch from start.obs: rows with a leading axis [horizon]."""

        def step(carry: tuple[Batch, Array], inputs: tuple[Array, Key]) -> tuple[tuple[Batch, Array], Batch]:
            last, alive = carry
            k, key = inputs
            new, terminated = _imagine(imagination, _with_steps(last, k) if segmented else last, key, noise=noise)
            last = jax.tree.map(lambda n, o: jnp.where(alive, n, o).astype(o.dtype), new, last)
            return (last, alive & ~terminated), last

        k = jnp.arange(horizon, 0, -1)
        begin = start._replace(next_obs=start.obs)  # only its next_obs is read: the first step is always alive
        return jax.lax.scan(step, (begin, jnp.bool_(True)), (k, jax.random.split(key, horizon)))[1]

    def _with_steps(row: Batch, k: Array) -> Batch:
        return row._replace(context=steps_to_go(k, horizon), next_context=steps_to_go(k - 1, horizon))

    def apply(imagination: Imagination, batch: Batch, key: Key) -> Batch:
        if segmented:
            unassigned = jnp.zeros((batch.reward.shape[0], horizon))
            batch = batch._replace(context=unassigned, next_context=unassigned)
        keys = jax.random.split(key, (batch.reward.shape[0], branches))
        from_row = jax.vmap(lambda row, key: rollout(imagination, row, key), (None, 0))
        imagined = jax.tree.map(lambda x: x.reshape(-1, *x.shape[3:]), jax.vmap(from_row)(batch, keys))
        return jax.tree.map(lambda rows, new: jnp.concatenate([rows, new]), batch, imagined)

    return stateless(apply)


def relabel(first: int) -> Transform:
    """Gives the rows from index `first` on the successors, rewards and ends that the models expect.

    These rows are the simulator's. Their observations and actions are as wide as a task; only what follows from them
    need be real. They show a learner what the fitted models say about places where no rollout has been.
    """

    def apply(imagination: Imagination, batch: Batch, key: Key) -> Batch:
        keys = jax.random.split(key, batch.reward.shape[0] - first)
        rows = jax.tree.map(lambda x: x[first:], batch)
        new = jax.vmap(lambda row, key: _expected(imagination, row, row.obs, row.action, key)[0])(rows, keys)
        return jax.tree.map(lambda old, changed: jnp.concatenate([old[:first], changed]), batch, new)

    return stateless(apply)


def _imagine(imagination: Imagination, last: Batch, key: Key, *, noise: float | Array) -> tuple[Batch, Array]:
    """One imagined row from last.next_obs, and whether it terminates."""
    key_policy, key_noise, key_dynamics = jax.random.split(key, 3)
    action = imagination.policy(last.next_obs, last.context, key_policy)
    return _expected(imagination, last, last.next_obs, add_noise(action, noise, key_noise), key_dynamics)


def _expected(imagination: Imagination, row: Batch, obs: Array, action: Array, key: Key) -> tuple[Batch, Array]:
    """`row` with the transition that the models expect, and whether it terminates."""
    next_obs = imagination.dynamics(obs, action, key)
    terminated = imagination.terminated(obs, action, next_obs)
    discount = jnp.where(terminated, 0.0, imagination.gamma)
    reward = imagination.reward(obs, action, next_obs)
    return row._replace(obs=obs, action=action, reward=reward, discount=discount, next_obs=next_obs), terminated
