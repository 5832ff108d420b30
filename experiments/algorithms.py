"""What pretraining asks of an algorithm, and the two there are: SAC and TD-MPC2. Pure."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env
from experiments.presets import PretrainConfig
from sgft_jax.data import replay, sequences
from sgft_jax.io import checkpoint
from sgft_jax.io.config import config_from_json, config_to_json
from sgft_jax.learners import sac, tdmpc2, tdmpc2_model
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.planning.mpc import MPCConfig
from sgft_jax.players import Player, mpc_player, sac_player, tdmpc2_player
from sgft_jax.types import Array, Key, Learner, PyTree, Transition


class Algorithm(NamedTuple):
    """A learner and its experience as pretraining uses them.

    hyper(progress [] from 0 to 1) -> its numbers.
    init_carry() -> what `act` remembers from step to step of an episode.
    act(agent, carry, obs, key) -> (an exploring action [act_dim], carry), cheap enough for thousands of environments.
    extract(agent) -> what it hands to fine-tuning.
    empty(transitions) -> experience with room for that many; one that keeps time slots takes the slots that fit.
    add(experience, rows [n_envs], valid [n_envs], last [n_envs]) -> the same with one step more; valid: not exploded;
        last: of its episode.
    held(experience) -> [capacity] bool. sample(experience, key, n) -> a batch [n, ...] of what the learner learns from.
    """

    learner: Learner
    hyper: Callable[[float | Array], Any]
    init_carry: Callable[[], PyTree]
    act: Callable[[PyTree, PyTree, Array, Key], tuple[Array, PyTree]]
    extract: Callable[[Any], PyTree]
    empty: Callable[[int], PyTree]
    add: Callable[[PyTree, Transition, Array, Array], PyTree]
    held: Callable[[PyTree], Array]
    sample: Callable[[PyTree, Key, int], PyTree]


def make_algorithm(env: Env, config: PretrainConfig) -> Algorithm:
    """The one that `config.algorithm` names."""
    return {"sac": _sac, "tdmpc2": _tdmpc2}[config.algorithm](env, config)


def make_player(card: Mapping[str, Any], env: Env) -> Player:
    """How the prior with this card acts and judges. env: its task, which plans ask for rewards."""
    obs_dim, act_dim = card["obs_dim"], card["act_dim"]
    if plan := card.get("plan"):
        config = MPCConfig(obs_dim, act_dim, network_of(card), **plan, gamma=card["gamma"])
        return mpc_player(config, reward=env.reward, terminated=env.terminated)
    if checkpoint.algorithm_of(card) == "sac":
        return sac_player(obs_dim, act_dim, network_of(card))
    own = {name: card["config"][name] for name in ("horizon", "size", "plan_samples")}
    structure = tdmpc2_model.named_config(obs_dim, act_dim, **own)
    return tdmpc2_player(structure, tdmpc2.TDMPC2Hyper(gamma=card["gamma"]))


def describe_use(env: Env, config: PretrainConfig) -> dict[str, Any]:
    """What the card of a prior says of how to use it."""
    return {
        "algorithm": config.algorithm,
        "obs_dim": env.obs_dim,
        "act_dim": env.act_dim,
        "network": config_to_json(config.network),
        "ensemble_size": config.ensemble_size,
        "gamma": config.gamma,
        "config": config_to_json(config),
    }


def network_of(card: Mapping[str, Any]) -> NetworkConfig:
    """The networks of a prior of SAC."""
    return config_from_json(NetworkConfig, card["network"], where="network.")


def _rate(config: PretrainConfig, progress: float | Array) -> float | Array:
    return config.lr * (1.0 - (1.0 - config.lr_end) * jnp.minimum(progress, 1.0))


# --- SAC --------------------------------------------------------------------------------------------------------------


def _sac(env: Env, config: PretrainConfig) -> Algorithm:
    structure = sac.SACConfig(
        env.obs_dim,
        env.act_dim,
        network=config.network,
        ensemble_size=config.ensemble_size,
        policy_delay=config.policy_delay,
    )
    learner = sac.make_sac(structure, sac_hyper(config))
    return Algorithm(
        learner=learner,
        hyper=lambda progress: sac_hyper(config, progress=progress),
        init_carry=learner.init_carry,
        act=functools.partial(learner.act, explore=True),
        extract=sac.extract_prior,
        empty=lambda transitions: replay.init(replay.blank(env.obs_dim, env.act_dim), transitions),
        add=lambda experience, rows, valid, last: replay.add_batch(experience, rows, valid),
        held=lambda experience: jnp.arange(experience.data.reward.shape[0]) < experience.size,
        sample=replay.sample,
    )


def sac_hyper(config: PretrainConfig, *, progress: float | Array = 0.0) -> sac.SACHyper:
    """The numbers of SAC at `progress` [] from 0 to 1: one learning rate for all networks, as in the paper."""
    rate = _rate(config, progress)
    hyper = sac.SACHyper(
        lr_actor=rate,
        lr_critic=rate,
        lr_value=rate,
        lr_dynamics=rate,
        lr_alpha=rate,
        tau=config.tau,
        alpha=config.alpha,
        entropy_per_dim=config.entropy_per_dim,
    )
    return jax.tree.map(jnp.float32, hyper)


# --- TD-MPC2 ----------------------------------------------------------------------------------------------------------


def _tdmpc2(env: Env, config: PretrainConfig) -> Algorithm:
    own = {name: getattr(config, name) for name in ("horizon", "size", "plan_samples")}
    structure = tdmpc2_model.named_config(env.obs_dim, env.act_dim, **own)

    def hyper(progress: float | Array) -> tdmpc2.TDMPC2Hyper:
        numbers = tdmpc2.TDMPC2Hyper(lr=_rate(config, progress), tau=config.tau, gamma=config.gamma)
        return jax.tree.map(jnp.float32, numbers)

    return Algorithm(
        learner=tdmpc2.make_tdmpc2(structure, hyper(0.0)),
        hyper=hyper,
        # The policy alone: a plan costs some ten thousand evaluations of the model, the policy one.
        init_carry=lambda: (),
        act=lambda agent, carry, obs, key: (tdmpc2.policy_action(structure, agent, obs, key, explore=True), carry),
        extract=tdmpc2.extract_prior,
        empty=lambda transitions: sequences.init(
            replay.blank(env.obs_dim, env.act_dim), transitions // config.n_envs, config.n_envs
        ),
        add=sequences.add,
        held=lambda experience: experience.valid,
        sample=lambda experience, key, n: sequences.sample(experience, key, n, config.horizon),
    )
