"""How pretraining uses each algorithm: `RECIPES` has one entry for `sac` and one for `tdmpc2`. Pure."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from sgft_jax.data import replay, sequences
from sgft_jax.learners import sac, tdmpc2, tdmpc2_model
from sgft_jax.presets import PretrainConfig
from sgft_jax.types import Array, Batch, Key, Learner, PyTree, Task, Transition


class Memory(NamedTuple):
    """Experience of a fleet.

    empty(transitions) -> experience with room for that many; one that keeps time slots takes the slots that fit.
    add(experience, rows [n_envs], valid [n_envs], last [n_envs]) -> the same with one step more. valid: not exploded;
        last: of its episode.
    cut(experience): no episode goes on after its newest step. held(experience) -> [capacity] bool.
    sample(experience, key, n) -> Batch [n, ...].
    """

    empty: Callable[[int], PyTree]
    add: Callable[[PyTree, Transition, Array, Array], PyTree]
    cut: Callable[[PyTree], PyTree]
    held: Callable[[PyTree], Array]
    sample: Callable[[PyTree, Key, int], Batch]


class Recipe(NamedTuple):
    """How an algorithm is pretrained.

    hyper(steps []) -> the learner's numbers after so many steps of all environments.
    init_carry() and act(agent, carry, obs, key) -> (action, carry): exploration, cheap enough for a fleet.
    extract(agents [M]) -> params [M].
    """

    learner: Learner
    memory: Memory
    hyper: Callable[[Array], Any]
    init_carry: Callable[[], PyTree]
    act: Callable[[PyTree, PyTree, Array, Key], tuple[Array, PyTree]]
    extract: Callable[[Any], PyTree]


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
    rows = Memory(
        empty=lambda transitions: replay.init(replay.blank(task.obs_dim, task.act_dim), transitions),
        add=lambda experience, rows, valid, last: replay.add_batch(experience, rows, valid),
        cut=lambda experience: experience,
        held=lambda experience: jnp.arange(experience.data.reward.shape[0]) < experience.size,
        sample=replay.sample,
    )
    explore = functools.partial(learner.act, explore=True)
    return Recipe(learner, rows, hyper, learner.init_carry, explore, sac.extract_params)


def _tdmpc2(task: Task, config: PretrainConfig) -> Recipe:
    """The fleet follows the policy alone: a plan costs some ten thousand evaluations of the model, the policy one."""
    own = {name: getattr(config, name) for name in ("horizon", "size", "plan_samples")}
    structure, rate = tdmpc2_model.named_config(task.obs_dim, task.act_dim, **own), _rate(config)

    def hyper(steps: Array) -> tdmpc2.TDMPC2Hyper:
        numbers = tdmpc2.TDMPC2Hyper(lr=rate(steps), tau=config.tau, gamma=config.gamma)
        return jax.tree.map(jnp.float32, numbers)

    def act(agent: Any, carry: PyTree, obs: Array, key: Key) -> tuple[Array, PyTree]:
        return tdmpc2.policy_action(structure, agent, obs, key, explore=True), carry

    windows = Memory(
        empty=lambda transitions: sequences.init(
            replay.blank(task.obs_dim, task.act_dim), transitions // config.n_envs, config.n_envs
        ),
        add=sequences.add,
        cut=sequences.end_episodes,
        held=lambda experience: experience.valid,
        sample=lambda experience, key, n: sequences.sample(experience, key, n, config.horizon),
    )
    learner = tdmpc2.make_tdmpc2(structure, hyper(jnp.int32(0)))
    return Recipe(learner, windows, hyper, lambda: (), act, tdmpc2.extract_params)


def _rate(config: PretrainConfig) -> Callable[[Array], Array]:
    """The learning rate [] after so many steps of all environments."""
    schedule = optax.linear_schedule(config.lr, config.lr * config.lr_end, max(1, config.env_steps // config.n_envs))
    return lambda steps: jnp.asarray(schedule(steps))


RECIPES: dict[str, Callable[[Task, PretrainConfig], Recipe]] = {"sac": _sac, "tdmpc2": _tdmpc2}
