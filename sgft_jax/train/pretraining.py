"""Massive training in simulation. Members are seeds."""

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Domain, Env, EnvState, Theta, Varying, World
from envs.domains import sample_worlds, uniform
from envs.doraemon import doraemon
from envs.mesh import split, whole
from envs.observations import all_varying
from envs.patches import patches
from envs.rollout import Fleet, launch, play_episode, pool_size
from envs.types import Array, Key, PyTree, Transition
from sgft_jax.algorithms import make_policy, recipe_of
from sgft_jax.files.disk import jsonable
from sgft_jax.keys import Pretraining, seed_keys
from sgft_jax.models import normalizer
from sgft_jax.presets import PretrainConfig
from sgft_jax.stacking import member, stack
from sgft_jax.train import fleet, value_fit
from sgft_jax.train.fleet import Collected, FleetState, Plan, Pools, RoundKeys, StartKeys, Trainer, over_members
from sgft_jax.types import Batch, Metrics, Prior

__all__ = ["pretrain", "priors_of"]

_RANDOM_STEPS = 3_125  # of a simulator under random actions, at most


class Programs(NamedTuple):
    """What pretraining compiles, of M members.

    collect(worlds [M, W], keys [M]) -> experience [M, ...] under random actions. train: see `fleet.make_programs`.
    succeed(worlds [M, W], learners [M], keys [M]) -> [M, W] success of an exploring episode in each.
    """

    collect: Any
    train: Trainer
    succeed: Any


def make_programs(env: Env, config: PretrainConfig, members: int) -> Programs:
    """Jitted: they compile when they are first called, or before, by `lower(...).compile()`."""
    collect = over_members(functools.partial(random_experience, env, config), members)
    succeed = over_members(functools.partial(success_in, env, config), members)
    train = fleet.make_programs(make_trainer(env, config), members, shared=False)
    return Programs(jax.jit(collect), train, jax.jit(succeed))


# --- the iterator -----------------------------------------------------------------------------------------------------


def pretrain(
    env: Env,
    config: PretrainConfig,
    seeds: Sequence[int] | Array,
    *,
    domain: Domain | None = None,
    pools: Pools | None = None,
    random: PyTree = None,
    state: FleetState | None = None,
    programs: Programs | None = None,
) -> Iterator[tuple[FleetState, Metrics]]:
    """Trains M members, one for each seed, for `config.env_steps` environment steps each, see `fleet.train`.

    domain: what worlds are drawn from; default that of training. pools: where members live; default worlds of that
    domain. `config.refresh_every` decides when the next set is asked for. random: experience under random actions, see
    `Programs`; collected here if None. state: where an earlier run stopped, or None. Both are consumed. Every random
    draw follows from the seeds, so a resumed run ends like an uninterrupted one. A round of the state is one step of
    all environments. programs: see `make_programs`.
    """
    seeds = jnp.asarray(seeds, jnp.uint32)
    plan, members, domain = make_plan(env, config), len(seeds), domain or domain_of(env, config)
    pools = pools or training_pools(config, seeds, domain, maker(env, config))
    programs, first = programs or make_programs(env, config, members), domains(domain, members)
    if random is None:
        random = programs.collect(pools(0, first), seed_keys(seeds, Pretraining.RANDOM))
    else:
        random = jax.jit(over_members(fleet.spread_replay, members), donate_argnums=0)(random)
    if state is None:
        begun = programs.train.init(pools(0, first), random, seed_keys(seeds, Pretraining.START))._replace(domain=first)
    else:
        begun = jax.jit(over_members(fleet.spread, members), donate_argnums=0)(state)

    def adapt(worlds: World, state: FleetState) -> PyTree:
        keys = jax.vmap(jax.random.fold_in)(seed_keys(seeds, Pretraining.DOMAIN), state.rounds)
        success = programs.succeed(worlds, state.learner, keys)
        rows = (member((state.domain, worlds.theta, success), i) for i in range(members))
        return stack([domain.update(*row) for row in rows])

    adapts = {"adapt": adapt} if config.doraemon else {}
    return fleet.train(plan, programs.train, pools, random, begun, refresh_every=config.refresh_every, **adapts)


def domain_of(env: Env, config: PretrainConfig) -> Domain:
    """What worlds are drawn from."""
    return doraemon(env) if config.doraemon else uniform(env)


def domains(domain: Domain, members: int) -> PyTree:
    """[M] the states with which a domain begins."""
    return stack([domain.init()] * members)


def training_pools(
    config: PretrainConfig, seeds: Sequence[int] | Array, domain: Domain, make: Callable[[Theta], World]
) -> Pools:
    """Pools of `config.worlds` worlds each, drawn from a domain by each seed. make: see `maker`."""
    last: dict[int, World] = {}  # worlds take long to compile

    def pools(number: int, domains: PyTree) -> World:
        if number not in last:
            last.clear()
            rows = enumerate(world_keys(seeds, number))
            last[number] = stack([make(domain.sample(member(domains, i), key, config.worlds)) for i, key in rows])
        return last[number]

    return pools


def maker(env: Env, config: PretrainConfig) -> Callable[[Theta], World]:
    """What makes worlds [n] of thetas [n]: MuJoCo's compiler, or patches for a domain that adapts, which needs others
    every few seconds.
    """
    if not config.doraemon:
        return env.make_worlds
    ranges = np.array([(p.low, p.high) for p in env.parameters]).reshape(-1, 2)

    @functools.cache
    def program() -> Callable[[Theta], World]:
        model = patches(env, ranges).model
        return jax.jit(lambda theta: World(theta, jax.vmap(model)(theta.params)))

    return lambda theta: program()(theta)


def world_keys(seeds: Sequence[int] | Array, number: int = 0) -> Key:
    """Keys [M] that decide the worlds of a set."""
    keys = seed_keys(seeds, Pretraining.WORLDS)
    return keys if number == 0 else jax.vmap(jax.random.fold_in, (0, None))(keys, number)


# --- what it leaves ---------------------------------------------------------------------------------------------------


def exported(env: Env, config: PretrainConfig, state: FleetState) -> PyTree:
    """Params [M, ...] of the agents as they are now."""
    return recipe_of(env, config).extract(state.learner)


def prior_card(env: Env, config: PretrainConfig) -> dict[str, Any]:
    """What a prior says of itself, as JSON data: all that it takes to use it."""
    return {
        "task": env.name,
        "algorithm": config.algorithm,
        "obs_dim": env.obs_dim,
        "act_dim": env.act_dim,
        "previous_actions": env.previous_actions,
        "system": [v._asdict() for v in env.system],
        "network": jsonable(config.network),
        "ensemble_size": config.ensemble_size,
        "gamma": config.gamma,
        "config": jsonable(config),
        "observation": [e._asdict() for e in env.observation],
        "action": [e._asdict() for e in env.action],
        "control_dt": env.control_dt,
        "episode_length": env.episode_length,
        "domain": [p._asdict() for p in env.parameters],
        "impl": env.impl,
    }


def priors_of(env: Env, config: PretrainConfig, state: FleetState) -> list[Prior]:
    """A prior for each member, with copies of the parameters as they are now, to which V_sim is fitted."""
    params, members = exported(env, config, state), state.rounds.shape[0]
    priors = [Prior(jax.tree.map(jnp.copy, member(params, i)), prior_card(env, config)) for i in range(members)]
    return refitted(env, config, priors) if recipe_of(env, config).valued else priors


def refitted(env: Env, config: PretrainConfig, priors: Sequence[Prior], *, seed: int = 0) -> list[Prior]:
    """The same priors of SAC, policies of one task, with a new V_sim. env: with the training domain's effects.

    config: how it is fitted, with the discount and the network of the priors.
    """
    fit, inputs = value_fit_of(env, config, priors, seed=seed)
    return with_values(env, priors, fit(*inputs))


def value_fit_of(
    env: Env, config: PretrainConfig, priors: Sequence[Prior], *, seed: int = 0
) -> tuple[Any, tuple[World, PyTree, Key]]:
    """The program of that fit, see `make_value_program`, and what it takes."""
    key_worlds, key_fit = jax.random.split(jax.random.key(seed))
    pool, params = sample_worlds(env, key_worlds, max(config.worlds, value_fit.WORLDS)), [p.params for p in priors]
    pools = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(priors), *x.shape)), pool)
    program = make_value_program(env, config, all_varying(env), priors[0].card, len(priors))
    return program, (pools, stack([p._replace(value=None) for p in params]), jax.random.split(key_fit, len(priors)))


def system_card(system: tuple[Varying, ...]) -> dict[str, Any]:
    """What a card says of a V_sim that can be told this."""
    return {"value_system": [v._asdict() for v in system]}


def with_values(env: Env, priors: Sequence[Prior], values: PyTree) -> list[Prior]:
    """These priors with other parameters of V_sim [M, ...], which knows the rewards of `env`."""
    facts = {**system_card(all_varying(env)), "sparse": env.sparse}
    return [
        Prior(prior.params._replace(value=member(values, i)), {**prior.card, **facts}) for i, prior in enumerate(priors)
    ]


def make_value_program(
    env: Env, config: PretrainConfig, system: tuple[Varying, ...], card: Mapping[str, Any], members: int
) -> Any:
    """(pools [M, W], params [M, ...], keys [M]) -> V_sim's parameters [M, ...] of policies with that card, jitted."""
    fit = functools.partial(value_fit.fit_value, env, system, make_policy(card, env), config)
    return jax.jit(over_members(fit, members))


def memory(env: Env, config: PretrainConfig) -> dict[str, int]:
    """Bytes that one seed keeps on its devices, by the setting that decides them: experience, and what updates hold."""
    kept = recipe_of(env, config).memory
    drawn = config.updates_per_step * config.batch_size
    networks = config.ensemble_size + 3  # two critics and the actor
    activations = 2 * networks * config.batch_size * sum(config.network.hidden) * 4  # forwards and backwards, float32

    def batches() -> Batch:
        return kept.sample(kept.empty(config.n_envs), jax.random.key(0), drawn)

    return {
        "random_transitions": fleet.bytes_of(lambda: kept.empty(config.random_transitions)),
        "replay_capacity": fleet.bytes_of(lambda: kept.empty(config.replay_capacity)),
        "batch_size": activations + 2 * fleet.bytes_of(batches),  # drawn, then put together
        "value_episodes": value_fit.bytes_of(env, config) if recipe_of(env, config).valued else 0,
    }


# --- how a member trains ----------------------------------------------------------------------------------------------


def _simulators_of(transitions: int, n_envs: int) -> int:
    """How many simulators collect random actions: those of training, or a multiple where that would take hours.

    Of the presets only `paper` has more: 8,000 for 64, so 3,125 steps after another collect its 25 million transitions.
    """
    return n_envs * -(-transitions // (n_envs * _RANDOM_STEPS))


def random_experience(env: Env, config: PretrainConfig, pool: World, key: Key) -> PyTree:
    """Experience of one member under random actions, full but for exploded steps. pool: [W] worlds."""
    kept = recipe_of(env, config).memory
    n = _simulators_of(config.random_transitions, config.n_envs) if kept.any_fleet else config.n_envs
    key_launch, key_steps = jax.random.split(key)
    n_steps = config.random_transitions // n
    start = Collected(launch(env, pool, key_launch, n, ()), kept.empty(n_steps * n))
    keys = jax.vmap(jax.random.split)(jax.random.split(key_steps, n_steps))

    def explore(simulators: Fleet, key: Key) -> tuple[Array, PyTree]:
        return _uniform_actions(env, n, key), ()

    return fleet.collect(env, kept, explore, pool, start, keys, initial_carry=(), gamma=config.gamma)[0].replay


def success_in(env: Env, config: PretrainConfig, pool: World, learner: PyTree, key: Key) -> Array:
    """[W] success of one member that explores, in an episode in each world of its pool [W]."""
    recipe, n = recipe_of(env, config).learner, pool_size(pool)
    act = functools.partial(recipe.act, learner, explore=True)

    def success(world: World, key: Key) -> Array:
        alone = jax.tree.map(lambda x: x[None], world)
        return play_episode(env, alone, act, recipe.init_carry(), key, gamma=config.gamma).success

    return jax.vmap(success)(pool, jax.random.split(key, n))


def make_trainer(env: Env, config: PretrainConfig) -> Trainer:
    """Pretraining of one member as pure functions."""
    return fleet.make_trainer(env, make_plan(env, config), gamma=config.gamma)


def make_plan(env: Env, config: PretrainConfig) -> Plan:
    """How one member trains."""
    recipe = recipe_of(env, config)
    kept = recipe.memory

    def begin(agent: PyTree, random: PyTree) -> PyTree:
        if not config.normalize:
            return agent
        statistics = normalizer.update(normalizer.init(env.obs_dim), random.data.obs, kept.held(random))
        return agent.replace(normalizer=normalizer.finish(statistics))

    def round_keys(key: Key) -> RoundKeys:
        keys = jax.random.split(key, 5)
        return RoundKeys(keys[0], keys[None, 1:3], keys[3], jax.random.split(keys[4], config.updates_per_step))

    def batches(random: PyTree, experience: PyTree, key: Key) -> Batch:
        """[updates, batch] rows, drawn at once, batches in pieces; each holds its share of random-action rows."""
        key_random, key_replay = jax.random.split(key)
        updates, n_random = config.updates_per_step, round(config.random_fraction * config.batch_size)

        def draw(source: PyTree, key: Key, n: int) -> Batch:
            rows = kept.sample(source, key, updates * n)
            return jax.tree.map(lambda x: x.reshape(updates, n, *x.shape[1:]), rows)

        old, new = draw(random, key_random, n_random), draw(experience, key_replay, config.batch_size - n_random)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=1), old, new)
        return split(whole(both), axis=1)  # put together in pieces, they would travel between devices twice more

    def explore(agent: PyTree, simulators: Fleet, key: Key) -> tuple[Array, PyTree]:
        """The policy's actions, more and more of them replaced by random ones along the fleet."""
        key_policy, key_replace, key_random = jax.random.split(key, 3)
        keys = jax.random.split(key_policy, config.n_envs)
        act = functools.partial(recipe.learner.act, agent, explore=True)
        actions, carry = jax.vmap(act)(simulators.carry, simulators.state.obs, keys)
        if not config.random_ladder:
            return actions, carry
        share = jnp.linspace(0.0, config.random_ladder, config.n_envs)
        replaced = jax.random.uniform(key_replace, (config.n_envs,)) < share
        actions = jnp.where(replaced[:, None], _uniform_actions(env, config.n_envs, key_random), actions)
        return actions, jax.vmap(recipe.replaced)(carry, actions)

    return Plan(
        recipe.learner,
        kept,
        simulators=config.n_envs,
        capacity=config.replay_capacity,
        chunks=config.chunks,
        rounds=config.chunk_steps,
        explore=explore,
        begin=begin,
        tune=lambda agent, rounds: agent.replace(hyper=recipe.hyper(rounds)),
        start_keys=lambda key: StartKeys(*jax.random.split(key, 3)),
        round_keys=round_keys,
        batches=batches,
        measure=_measure,
        summarise=_summarise,
        precision=config.precision,
    )


def _uniform_actions(env: Env, n: int, key: Key) -> Array:
    return jax.random.uniform(key, (n, env.act_dim), minval=-1.0, maxval=1.0)


_SHARES = ("success", "terminated")  # of the episodes that ended in a chunk


def _measure(after: EnvState, rows: Transition, valid: Array) -> Metrics:
    """[] of one step of the fleet."""
    ended = (after.truncated | after.terminated) & valid
    counts = {"episodes": ended, "success": ended & after.success, "terminated": ended & after.terminated}
    means = {"reward": rows.reward.mean(), "exploded": 1.0 - valid.mean()}
    return means | {name: mask.sum().astype(jnp.float32) for name, mask in counts.items()}


def _summarise(measured: Metrics) -> Metrics:
    """[] of a chunk, of what `_measure` says of its steps."""
    episodes = measured["episodes"].sum()
    shares = {name: measured[name].sum() / jnp.maximum(episodes, 1.0) for name in _SHARES}
    means = {name: measured[name].mean() for name in ("reward", "exploded")}
    return {f"train/{name}": x for name, x in (means | shares | {"episodes": episodes}).items()}
