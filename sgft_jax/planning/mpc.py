"""Planning with a prior of SAC: H steps of its dynamics ensemble, ended by V_sim. MPC-SGFT, the paper's Algorithm 3.

The paper plans in the latent space of TD-MPC2 (`tdmpc2.py`). A prior of SAC has all that a plan needs in the space of
observations: an ensemble of models, the task's reward, V_sim, and a policy that proposes.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import jax
import jax.numpy as jnp

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.models import dynamics, value
from sgft_jax.models.networks import (
    NetworkConfig,
    add_noise,
    make_actor,
    make_dynamics,
    make_value,
    tanh_gaussian_action,
)
from sgft_jax.models.normalizer import normalize
from sgft_jax.planning import mppi
from sgft_jax.types import Normalizer

__all__ = ["MPCConfig"]

_ITERATIONS = 3  # of the search: half of TD-MPC2's, for plans a quarter as long
_PROPOSALS, _ELITES = 4, 8  # one of so many samples is the policy's, and an elite
# TD-MPC2 averages over elites that differ by some units of return; here a plan is a step or a few, a tenth is a lot.
_SEARCH = mppi.MPPIHyper(temperature=20.0, std_min=0.05, std_max=1.0)


@dataclass(frozen=True)
class MPCConfig:
    """obs_dim, act_dim; network: the prior's. horizon: steps of a plan, H. samples: sequences tried per iteration.

    noise: std of the noise on the policy's proposals, in units of the action's range [-1, 1]. gamma: discount factor.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig
    horizon: int = 1
    samples: int = 128
    noise: float = 0.5
    gamma: float = 0.99

    def __post_init__(self) -> None:
        checks.at_least(self, 1, "horizon")
        checks.at_least(self, _ELITES, "samples")


class PlanningParams(Protocol):
    """What a plan reads of a prior's parameters, see `SACParams`: dynamics [members, ...], the rest of one network."""

    @property
    def actor(self) -> PyTree:
        """Of the policy that proposes."""
        ...

    @property
    def value(self) -> PyTree:
        """Of V_sim."""
        ...

    @property
    def dynamics(self) -> PyTree:
        """Of the ensemble."""
        ...

    @property
    def normalizer(self) -> Normalizer:
        """Statistics of the observations."""
        ...


def init_carry(config: MPCConfig) -> Array:
    """The plan [H, act_dim] of a step that never was, for the first step of an episode."""
    return jnp.zeros((config.horizon, config.act_dim))


def make_act(
    config: MPCConfig,
    *,
    reward: Callable[[Array, Array, Array], Array],
    terminated: Callable[[Array, Array, Array], Array],
) -> Callable[..., tuple[Array, PyTree]]:
    """act(params, carry, obs [obs_dim], key, *, explore) -> (action [act_dim], carry); explore: [] bool, may be traced.

    reward, terminated: the task as functions of one (obs, action, next_obs). A plan's score is the mean over the
    ensemble's members, each followed on its own, of sum_t gamma^t r_t + gamma^H V_sim(s_H). Source: SGFT equation (1)
    but for V_sim(s_0), which is the same for all plans.
    """
    actor = make_actor(config.obs_dim, config.act_dim, config.network)
    value_net = make_value(config.obs_dim, config.network)
    model = make_dynamics(config.obs_dim, config.act_dim, config.network)
    search = mppi.MPPIConfig(config.samples, config.samples // _ELITES, _ITERATIONS)

    def score(params: PlanningParams, obs: Array, sequence: Array) -> Array:
        members = jax.tree.leaves(params.dynamics)[0].shape[0]

        def step(carry: tuple[Array, Array, Array], action: Array) -> tuple[tuple[Array, Array, Array], None]:
            obs, discount, total = carry  # of every member: [members, obs_dim], [members], [members]
            next_obs = dynamics.predict_each(model, params.dynamics, params.normalizer, obs, action)
            moved = obs, action, next_obs
            goes_on = config.gamma * (1.0 - jax.vmap(terminated, (0, None, 0))(*moved).astype(jnp.float32))
            earned = discount * jax.vmap(reward, (0, None, 0))(*moved)
            return (next_obs, discount * goes_on, total + earned), None

        start = (jnp.tile(obs, (members, 1)), jnp.ones(members), jnp.zeros(members))
        (end, discount, total), _ = jax.lax.scan(step, start, sequence)
        to_go = jax.vmap(lambda obs: value.predict(value_net, params.value, params.normalizer, obs))(end)
        return jnp.mean(total + discount * to_go)

    def propose(params: PlanningParams, member: PyTree, obs: Array, key: Key) -> Array:
        """[H, act_dim]: the policy with noise, followed by one member of the ensemble."""

        def step(obs: Array, key: Key) -> tuple[Array, Array]:
            key_policy, key_noise = jax.random.split(key)
            moments = actor.apply(params.actor, normalize(params.normalizer, obs))
            action = tanh_gaussian_action(moments, key_policy, explore=True)
            action = add_noise(action, config.noise, key_noise)
            return dynamics.predict(model, member, params.normalizer, obs, action)[0], action

        return jax.lax.scan(step, obs, jax.random.split(key, config.horizon))[1]

    def act(
        params: PlanningParams, carry: PyTree, obs: Array, key: Key, *, explore: bool | Array
    ) -> tuple[Array, PyTree]:
        key_member, key_propose, key_search = jax.random.split(key, 3)
        member = dynamics.draw_member(params.dynamics, key_member)
        keys = jax.random.split(key_propose, config.samples // _PROPOSALS)
        proposals = jax.vmap(lambda key: propose(params, member, obs, key))(keys)
        rate = functools.partial(score, params, obs)
        return mppi.plan(search, _SEARCH, rate, proposals, carry, key_search, explore=explore)

    return act
