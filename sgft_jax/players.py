"""How the parameters of a prior act and judge, whichever algorithm they come from."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax

from sgft_jax.learners import tdmpc2, tdmpc2_model
from sgft_jax.models import dynamics, value
from sgft_jax.models.networks import NetworkConfig, make_actor, make_dynamics, make_value, tanh_gaussian_action
from sgft_jax.models.normalizer import normalize
from sgft_jax.planning import mpc
from sgft_jax.types import Array, Key, Prior, PyTree


class Player(NamedTuple):
    """Functions of a prior's parameters, for one example.

    init_carry() -> what it remembers from step to step of an episode.
    act(prior, carry, obs, key, *, explore) -> (action, carry); `explore` is static.
    value(prior, obs) -> []: V_sim, deterministic.
    predict(prior, obs, action, key) -> [obs_dim] what a random member of its model says comes next; None where the
        model does not predict observations.
    model_error(prior, obs [T + 1, obs_dim], actions [T, act_dim]) -> [T]: how far its model drifts from a trajectory,
        in standard deviations of the observation; None likewise.
    """

    init_carry: Callable[[], PyTree]
    act: Callable[..., tuple[Array, PyTree]]
    value: Callable[[Any, Array], Array]
    predict: Callable[[Any, Array, Array, Key], Array] | None
    model_error: Callable[[Any, Array, Array], Array] | None


def sac_player(obs_dim: int, act_dim: int, network: NetworkConfig) -> Player:
    """Actor, V_sim and dynamics ensemble of a `Prior`."""
    actor, judge, model = (
        make_actor(obs_dim, act_dim, network), make_value(obs_dim, network), make_dynamics(obs_dim, act_dim, network)
    )  # fmt: skip

    def act(prior: Prior, carry: PyTree, obs: Array, key: Key, *, explore: bool) -> tuple[Array, PyTree]:
        moments = actor.apply(prior.actor, normalize(prior.normalizer, obs))
        return tanh_gaussian_action(moments, key, explore=explore), carry

    return Player(
        init_carry=lambda: (),
        act=act,
        value=lambda prior, obs: value.predict(judge, prior.value, prior.normalizer, obs),
        predict=lambda prior, obs, action, key: dynamics.predict(
            model, dynamics.draw_member(prior.dynamics, key), prior.normalizer, obs, action
        )[0],
        model_error=lambda prior, obs, actions: dynamics.rollout_error(
            model, prior.dynamics, prior.normalizer, obs, actions
        ),
    )


def mpc_player(
    config: mpc.MPCConfig,
    *,
    reward: Callable[[Array, Array, Array], Array],
    terminated: Callable[[Array, Array, Array], Array],
) -> Player:
    """The same `Prior`, acting by plans. reward, terminated: the task as functions of one (obs, action, next_obs)."""
    return sac_player(config.obs_dim, config.act_dim, config.network)._replace(
        init_carry=lambda: mpc.init_carry(config), act=mpc.make_act(config, reward=reward, terminated=terminated)
    )


def tdmpc2_player(config: tdmpc2.TDMPC2Config, hyper: tdmpc2.TDMPC2Hyper) -> Player:
    """The planner and the value of a `TDMPC2Prior`."""
    learner = tdmpc2.make_tdmpc2(config, hyper)

    def state(prior: tdmpc2.TDMPC2Prior) -> tdmpc2.TDMPC2State:
        return tdmpc2.fine_tune_state(config, hyper, prior, jax.random.key(0))

    return Player(
        init_carry=learner.init_carry,
        act=lambda prior, *step, explore: learner.act(state(prior), *step, explore=explore),
        value=lambda prior, obs: tdmpc2_model.value_of(config, state(prior), obs),
        predict=None,
        model_error=None,
    )
