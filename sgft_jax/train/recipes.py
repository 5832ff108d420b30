"""How pretraining uses each algorithm: `RECIPES` has an entry for each. Pure."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from envs.types import Array, Key, PyTree, UserError
from sgft_jax.data import replay, sequences
from sgft_jax.learners import recurrent, sac, tdmpc2, tdmpc2_model
from sgft_jax.presets import PretrainConfig
from sgft_jax.train.fleet import Memory, transitions
from sgft_jax.types import Batch, Learner, Task


class Recipe(NamedTuple):
    """How an algorithm is pretrained.

    hyper(steps []) -> the learner's numbers after so many steps of all environments.
    init_carry() and act(agent, carry, obs, key) -> (action, carry): exploration, cheap enough for a fleet.
    extract(agents [M]) -> params [M].
    replaced(carry, action) -> the carry if another action was taken than `act` chose.
    """

    learner: Learner
    memory: Memory
    hyper: Callable[[Array], Any]
    init_carry: Callable[[], PyTree]
    act: Callable[[PyTree, PyTree, Array, Key], tuple[Array, PyTree]]
    extract: Callable[[Any], PyTree]
    replaced: Callable[[PyTree, Array], PyTree] = lambda carry, action: carry


def _sac(task: Task, config: PretrainConfig) -> Recipe:
    """One learning rate for all networks, as in the paper."""
    rate = _rate(config)

    def hyper(steps: Array) -> sac.SACHyper:
        rates = dict.fromkeys(("lr_actor", "lr_critic", "lr_value", "lr_dynamics", "lr_alpha"), rate(steps))
        numbers = sac.SACHyper(**rates, tau=config.tau, alpha=config.alpha, entropy_per_dim=config.entropy_per_dim)
        return jax.tree.map(jnp.float32, numbers)

    structure = sac.SACConfig(
        task.obs_dim,
        task.act_dim,
        network=config.network,
        ensemble_size=config.ensemble_size,
        policy_delay=config.policy_delay,
    )
    learner = sac.make_sac(structure, hyper(jnp.int32(0)))
    explore = functools.partial(learner.act, explore=True)
    return Recipe(learner, transitions(task), hyper, learner.init_carry, explore, sac.extract_params)


def _tdmpc2(task: Task, config: PretrainConfig) -> Recipe:
    """The fleet follows the policy alone: a plan costs some ten thousand evaluations of the model, the policy one."""
    size = {name: getattr(config, name) for name in ("horizon", "size", "plan_samples")}
    structure, rate = tdmpc2_model.named_config(task.obs_dim, task.act_dim, **size), _rate(config)

    def hyper(steps: Array) -> tdmpc2.TDMPC2Hyper:
        numbers = tdmpc2.TDMPC2Hyper(lr=rate(steps), tau=config.tau, gamma=config.gamma)
        return jax.tree.map(jnp.float32, numbers)

    def act(agent: Any, carry: PyTree, obs: Array, key: Key) -> tuple[Array, PyTree]:
        return tdmpc2.policy_action(structure, agent, obs, key, explore=True), carry

    windows = _windows(task, config, lambda experience, key, n: sequences.sample(experience, key, n, config.horizon))
    learner = tdmpc2.make_tdmpc2(structure, hyper(jnp.int32(0)))
    return Recipe(learner, windows, hyper, lambda: (), act, tdmpc2.extract_params)


def _recurrent(task: Task, config: PretrainConfig) -> Recipe:
    """Learns from whole episodes, so a batch has `batch_size` of them."""
    slots = {name: getattr(config, name) // config.n_envs for name in ("random_transitions", "replay_capacity")}
    for name, held in slots.items():
        if held < task.episode_length:
            raise UserError(
                f"--config.{name.replace('_', '-')} {getattr(config, name)}: recurrent policies learn from whole "
                f"episodes; {config.n_envs} environments need at least {config.n_envs * task.episode_length}"
            )
    structure = recurrent.RecurrentConfig(task.obs_dim, task.act_dim, network=config.network, gru=config.gru)
    rate = _rate(config)

    def hyper(steps: Array) -> recurrent.RecurrentHyper:
        numbers = recurrent.RecurrentHyper(rate(steps), config.tau, config.alpha, config.entropy_per_dim)
        return jax.tree.map(jnp.float32, numbers)

    episodes = _windows(
        task,
        config,
        lambda experience, key, n: sequences.sample_episodes(experience, key, n, task.episode_length),
        spare=1,  # of a full ring the oldest slot begins nothing
    )
    learner = recurrent.make_recurrent(structure, hyper(jnp.int32(0)))
    explore = functools.partial(learner.act, explore=True)
    return Recipe(
        learner,
        episodes,
        hyper,
        learner.init_carry,
        explore,
        recurrent.extract_params,
        replaced=lambda carry, action: carry._replace(action=action),
    )


def _windows(task: Task, config: PretrainConfig, sample: Callable[..., Batch], *, spare: int = 0) -> Memory:
    """A ring of time slots, which `sample` draws from. spare: slots more than the transitions fill."""
    blank, n = replay.blank(task.obs_dim, task.act_dim), config.n_envs
    return Memory(
        empty=lambda transitions: sequences.init(blank, transitions // n + spare, n),
        add=sequences.add,
        cut=sequences.end_episodes,
        held=lambda experience: experience.valid,
        sample=sample,
    )


def _rate(config: PretrainConfig) -> Callable[[Array], Array]:
    """The learning rate [] after so many steps of all environments."""
    schedule = optax.linear_schedule(config.lr, config.lr * config.lr_end, max(1, config.env_steps // config.n_envs))
    return lambda steps: jnp.asarray(schedule(steps))


RECIPES: dict[str, Callable[[Task, PretrainConfig], Recipe]] = {
    "sac": _sac,
    "tdmpc2": _tdmpc2,
    "recurrent": _recurrent,
}
