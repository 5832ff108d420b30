"""SGFT as three batch transforms; `methods.py` has the table of methods that they compose into.

A transform is `(imagination, batch, key) -> batch` on a batch [B, ...] of real transitions. Compose in the order
branch, shape, shorten: branching needs plain observations, shaping the whole discount.
Source: SGFT (Yin et al., ICLR 2025).
"""

import jax
import jax.numpy as jnp

from sgft_jax.models.networks import add_noise
from sgft_jax.types import Array, BatchTransform, Imagination, Key, Transition, UserError


def shaped_reward(imagination: Imagination, row: Transition) -> Array:
    """Shaped reward [] r + discount V(s') - V(s) of one transition. The discount makes V(terminal) count as 0."""
    return row.reward + row.discount * imagination.value(row.next_obs) - imagination.value(row.obs)


def shape(imagination: Imagination, batch: Transition, key: Key) -> Transition:
    """Replace every reward by the shaped one. Source: SGFT Algorithm 1; `key` is not used."""
    del key
    return batch._replace(reward=jax.vmap(lambda row: shaped_reward(imagination, row))(batch))


def append_steps_to_go(obs: Array, steps_to_go: Array, horizon: int) -> Array:
    """Observation [obs_dim] with one_hot(k) [horizon] appended, zeros for k = 0; unchanged for horizon 1."""
    if horizon == 1:
        return obs
    return jnp.concatenate([obs, jax.nn.one_hot(steps_to_go - 1, horizon, dtype=obs.dtype)])


def shorten(horizon: int) -> BatchTransform:
    """End every segment after `horizon` steps: no bootstrap at k = 1, and observations that tell the steps to go.

    Rows without a segment (k = 0) get k ~ Uniform{1..H}: a real transition is as good a step of any segment. A learner
    becomes conditioned on k without knowing: next observations carry k - 1. Source: SGFT section 3, O-12.
    """
    _check_positive("horizon", horizon)

    def transform(imagination: Imagination, batch: Transition, key: Key) -> Transition:
        del imagination
        drawn = jax.random.randint(key, batch.steps_to_go.shape, 1, horizon + 1)
        k = jnp.where(batch.steps_to_go == 0, drawn, batch.steps_to_go)
        append = jax.vmap(append_steps_to_go, (0, 0, None))
        return batch._replace(
            obs=append(batch.obs, k, horizon),
            next_obs=append(batch.next_obs, k - 1, horizon),
            discount=jnp.where(k == 1, 0.0, batch.discount),
            steps_to_go=k,
        )

    return transform


def branch(horizon: int, branches: int, *, noise: float | Array = 0.0, segments: bool = True) -> BatchTransform:
    """Append `branches` imagined rollouts of `horizon` steps from every real observation, after the real rows.

    noise: std of Gaussian noise on the policy's imagined actions, in units of the action's range [-1, 1]. The policy's
    own actions say nothing about better ones; a model can be asked about any.

    B rows become B (1 + branches * horizon). segments: number the imagined steps H..1, else leave them 0 for methods
    with an infinite horizon. Past an imagined termination a rollout repeats its last transition: every row stays valid.
    Source: SGFT Algorithm 2; MBPO (Janner et al. 2019).
    """
    _check_positive("horizon", horizon)
    _check_positive("branches", branches)

    def rollout(imagination: Imagination, row: Transition, key: Key) -> Transition:
        """One branch from row.obs: transitions with a leading axis [horizon]."""

        def step(
            carry: tuple[Transition, Array], inputs: tuple[Array, Key]
        ) -> tuple[tuple[Transition, Array], Transition]:
            last, alive = carry
            new, terminated = _imagine(imagination, last.next_obs, *inputs, noise=noise)
            last = jax.tree.map(lambda n, o: jnp.where(alive, n, o).astype(o.dtype), new, last)
            return (last, alive & ~terminated), last

        k = jnp.arange(horizon, 0, -1, dtype=jnp.int32) if segments else jnp.zeros(horizon, jnp.int32)
        start = row._replace(next_obs=row.obs)  # only its next_obs is read: the first step is always alive
        return jax.lax.scan(step, (start, jnp.bool_(True)), (k, jax.random.split(key, horizon)))[1]

    def transform(imagination: Imagination, batch: Transition, key: Key) -> Transition:
        keys = jax.random.split(key, (batch.reward.shape[0], branches))
        from_row = jax.vmap(lambda row, key: rollout(imagination, row, key), (None, 0))
        imagined = jax.tree.map(lambda x: x.reshape(-1, *x.shape[3:]), jax.vmap(from_row)(batch, keys))
        return jax.tree.map(lambda real, new: jnp.concatenate([real, new]), batch, imagined)

    return transform


def relabel(imagination: Imagination, batch: Transition, key: Key) -> Transition:
    """Transitions [B, ...] of another system as the models have them: what follows from their observations and actions.

    Only the dynamics need be real, not the observations: the simulator's are as wide as a task, and show a learner what
    fine-tuned models say about places where no rollout has been.
    """

    def one(row: Transition, key: Key) -> Transition:
        return _transition(imagination, row.obs, row.action, row.steps_to_go, key)[0]

    return jax.vmap(one)(batch, jax.random.split(key, batch.reward.shape[0]))


def _imagine(
    imagination: Imagination, obs: Array, k: Array, key: Key, *, noise: float | Array
) -> tuple[Transition, Array]:
    """One imagined transition from obs with k steps to go, and whether it terminates."""
    key_policy, key_noise, key_dynamics = jax.random.split(key, 3)
    action = imagination.policy(obs, k, key_policy)
    return _transition(imagination, obs, add_noise(action, noise, key_noise), k, key_dynamics)


def _transition(imagination: Imagination, obs: Array, action: Array, k: Array, key: Key) -> tuple[Transition, Array]:
    """The transition that the models expect, and whether it terminates."""
    next_obs = imagination.dynamics(obs, action, key)
    terminated = imagination.terminated(obs, action, next_obs)
    discount = jnp.where(terminated, 0.0, imagination.gamma)
    reward = imagination.reward(obs, action, next_obs)
    return Transition(obs, action, reward, discount, next_obs, jnp.bool_(False), k), terminated


def compose(*transforms: BatchTransform) -> BatchTransform:
    """Apply transforms from left to right, each with its own key."""

    def transform(imagination: Imagination, batch: Transition, key: Key) -> Transition:
        for one, sub in zip(transforms, jax.random.split(key, max(len(transforms), 1)), strict=False):
            batch = one(imagination, batch, sub)
        return batch

    return transform


def _check_positive(name: str, value: int) -> None:
    if value < 1:
        raise UserError(f"{name} is {value}: must be at least 1")
