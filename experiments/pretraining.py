"""Massive training in simulation as pure functions: random data, then chunks of (step all, insert, update)."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env, EnvState, World
from envs.rollout import Fleet, launch, step_fleet
from experiments.algorithms import Algorithm, make_algorithm
from experiments.presets import PretrainConfig
from sgft_jax.data import replay
from sgft_jax.mesh import split, whole
from sgft_jax.models import normalizer
from sgft_jax.models.networks import precision
from sgft_jax.types import Array, Key, Metrics, PyTree, Transition


class PretrainState(NamedTuple):
    """Everything that changes while pretraining: agent, experience, environments.

    steps: [] int32, vector steps (of all environments) so far.
    """

    learner: Any
    replay: Any
    fleet: Fleet
    key: Key
    steps: Array


class Pretrainer(NamedTuple):
    """Pretraining of one seed as pure functions; vmap over seeds (and over pools of worlds).

    collect_random(pool, key) -> random-action experience, full but for exploded steps.
    init(pool, random, key) -> PretrainState.
    chunk(pool, random, state) -> (state, metrics): `config.chunk_steps` steps of all environments with their updates.
    """

    algorithm: Algorithm
    collect_random: Callable[[World, Key], PyTree]
    init: Callable[[World, PyTree, Key], PretrainState]
    chunk: Callable[[World, PyTree, PretrainState], tuple[PretrainState, Metrics]]


def make_pretrainer(env: Env, config: PretrainConfig) -> Pretrainer:
    """Builds the pure functions."""
    algorithm = make_algorithm(env, config)
    learner = algorithm.learner
    step = lambda pool, fleet, actions, key: step_fleet(env, pool, fleet, actions, key, gamma=config.gamma)  # noqa: E731

    def uniform_actions(key: Key) -> Array:
        return jax.random.uniform(key, (config.n_envs, env.act_dim), minval=-1.0, maxval=1.0)

    def collect_random(pool: World, key: Key) -> PyTree:
        key_launch, key_steps = jax.random.split(key)

        def random_step(carry: tuple[Fleet, PyTree], key: Key) -> tuple[tuple[Fleet, PyTree], None]:
            fleet, buffer = carry
            key_action, key_step = jax.random.split(key)
            fleet, rows, valid, after = step(pool, fleet, uniform_actions(key_action), key_step)
            return (split(fleet), spread_replay(algorithm.add(buffer, rows, valid, _ended(after)))), None

        n_steps = config.random_transitions // config.n_envs
        start = (launch(env, pool, key_launch, config.n_envs), algorithm.empty(n_steps * config.n_envs))
        return jax.lax.scan(random_step, start, jax.random.split(key_steps, n_steps))[0][1]

    def init(pool: World, random: Any, key: Key) -> PretrainState:
        key_learner, key_fleet, key_run = jax.random.split(key, 3)
        statistics = normalizer.update(normalizer.init(env.obs_dim), random.data.obs, algorithm.held(random))
        agent = learner.init(key_learner).replace(normalizer=normalizer.finish(statistics))
        fleet = launch(env, pool, key_fleet, config.n_envs)
        buffer = algorithm.empty(config.replay_capacity)
        return spread(PretrainState(agent, buffer, fleet, key_run, jnp.int32(0)))

    def sample(random: PyTree, buffer: PyTree, key: Key) -> PyTree:
        """[updates, batch] rows, drawn at once, batches in pieces; each holds its share of random-action rows."""
        key_random, key_replay = jax.random.split(key)
        updates, n_random = config.updates_per_step, round(config.random_fraction * config.batch_size)

        def draw(source: PyTree, key: Key, n: int) -> PyTree:
            rows = algorithm.sample(source, key, updates * n)
            return jax.tree.map(lambda x: x.reshape(updates, n, *x.shape[1:]), rows)

        old, new = draw(random, key_random, n_random), draw(buffer, key_replay, config.batch_size - n_random)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=1), old, new)
        return split(whole(both), axis=1)  # put together in pieces, they would travel between devices twice more

    def explore(agent: PyTree, obs: Array, key: Key) -> Array:
        """[n_envs, act_dim]: the policy's actions, more and more of them replaced by random ones along the fleet."""
        key_policy, key_replace, key_random = jax.random.split(key, 3)
        actions = jax.vmap(algorithm.act, (None, 0, 0))(agent, obs, jax.random.split(key_policy, config.n_envs))
        if not config.random_ladder:
            return actions
        share = jnp.linspace(0.0, config.random_ladder, config.n_envs)
        replaced = jax.random.uniform(key_replace, (config.n_envs,)) < share
        return jnp.where(replaced[:, None], uniform_actions(key_random), actions)

    def vector_step(pool: World, random: PyTree, state: PretrainState) -> tuple[PretrainState, Metrics]:
        keys = jax.random.split(state.key, 5)
        actions = explore(state.learner, state.fleet.state.obs, keys[1])
        fleet, rows, valid, after = step(pool, state.fleet, actions, keys[2])
        buffer = algorithm.add(state.replay, rows, valid, _ended(after))
        batches = sample(random, buffer, keys[3])
        learner_now = state.learner.replace(hyper=algorithm.hyper(state.steps / (config.env_steps / config.n_envs)))
        with precision(config.precision):
            agent, metrics = jax.lax.scan(
                lambda agent, x: learner.update(agent, *x),
                learner_now,
                (batches, jax.random.split(keys[4], config.updates_per_step)),
            )
        metrics = {k: v.mean() for k, v in metrics.items()} | _fleet_metrics(after, rows, valid)
        return spread(PretrainState(agent, buffer, fleet, keys[0], state.steps + 1)), metrics

    def chunk(pool: World, random: PyTree, state: PretrainState) -> tuple[PretrainState, Metrics]:
        state, metrics = jax.lax.scan(lambda s, _: vector_step(pool, random, s), state, None, length=config.chunk_steps)
        ended = jnp.maximum(metrics.pop("ended").sum(), 1.0)
        succeeded = metrics.pop("succeeded").sum()
        return state, whole({k: v.mean() for k, v in metrics.items()} | {"train/success": succeeded / ended})

    return Pretrainer(algorithm, collect_random, init, chunk)


def spread(state: PretrainState) -> PretrainState:
    """Environments and experience in pieces on the devices of a mesh, the agent whole on each of them."""
    own = state._replace(replay=spread_replay(state.replay), fleet=split(state.fleet))
    return own._replace(learner=whole(state.learner), key=whole(state.key), steps=whole(state.steps))


def spread_replay(experience: PyTree) -> PyTree:
    """The same for experience alone: its rows in pieces, its counters whole."""
    return jax.tree.map(lambda x: split(x) if x.ndim else whole(x), experience)


def memory(env: Env, config: PretrainConfig) -> dict[str, int]:
    """Bytes of experience that one seed keeps on its devices, by the setting that decides them."""
    row = sum(x.nbytes for x in jax.tree.leaves(replay.blank(env.obs_dim, env.act_dim)))
    drawn = config.updates_per_step * config.batch_size
    rows = {"random_transitions": config.random_transitions, "replay_capacity": config.replay_capacity}
    return {name: row * n for name, n in {**rows, "batch_size": 2 * drawn}.items()}  # drawn, then put together


def _fleet_metrics(after: EnvState, rows: Transition, valid: Array) -> Metrics:
    ended = _ended(after) & valid
    return {
        "train/reward": rows.reward.mean(),
        "train/exploded": 1.0 - valid.mean(),
        "ended": ended.sum().astype(jnp.float32),
        "succeeded": (ended & after.success).sum().astype(jnp.float32),
    }


def _ended(after: EnvState) -> Array:
    """[n_envs] whether a step was the last of its episode."""
    return after.truncated | after.terminated
