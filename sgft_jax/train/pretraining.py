"""Massive training in simulation, as an iterator over compiled chunks: (step all environments, insert, update).

It prints nothing and touches no files; the caller does both. Members are seeds, all in one program.
"""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Domain, Env, EnvState, World
from envs.domains.uniform import uniform
from envs.mesh import split, whole
from envs.rollout import Fleet, launch, step_fleet
from envs.types import Array, Key, PyTree, Transition
from sgft_jax.files.jsonfile import jsonable
from sgft_jax.models import normalizer
from sgft_jax.models.networks import precision
from sgft_jax.presets import PretrainConfig
from sgft_jax.stacking import stack
from sgft_jax.train.recipes import RECIPES
from sgft_jax.types import Batch, Metrics, Prior

__all__ = ["PretrainState", "pretrain", "priors_of"]

_WORLDS, _RANDOM, _START = range(3)  # purposes, folded into a seed's key

Pools = Callable[[int], World]  # number of a set of worlds -> its worlds [M, W], a pool for each member


class PretrainState(NamedTuple):
    """Everything that changes while pretraining, [M, ...]: agent, experience, environments.

    steps: [M] int32, steps of all environments so far.
    """

    learner: Any
    replay: Any
    fleet: Fleet
    key: Key
    steps: Array


class Best(NamedTuple):
    """The best policy by evaluation, of one member.

    params: what it leaves. score, total: [] mean score and return of that evaluation. steps: [] int32, when it was.
    exploded: [] share of its episodes that exploded: they count as the worst known. worst: [2] that score and return.
    """

    params: PyTree
    score: Array
    total: Array
    steps: Array
    exploded: Array | float = 0.0
    worst: Array | float = jnp.inf


# --- the iterator -----------------------------------------------------------------------------------------------------


def pretrain(
    env: Env,
    config: PretrainConfig,
    seeds: Sequence[int] | Array,
    *,
    pools: Pools | None = None,
    random: PyTree = None,
    state: PretrainState | None = None,
) -> Iterator[tuple[PretrainState, Metrics]]:
    """Trains M members, one for each seed, for `config.env_steps` environment steps each.

    pools: where they live; default the training domain of `env`. `config.refresh_every` decides when the next set is
    asked for. random: experience under random actions, see `collect_random`; collected here if None. state: where an
    earlier run stopped, or None. Both are consumed.

    Yields the state that it starts from with no metrics, once everything is compiled, then once per chunk. Metrics are
    arrays [M]. A yielded state is valid until the next step, which donates its arrays: copy it to keep it longer.
    Every random draw follows from the seeds, so a resumed run ends like an uninterrupted one.
    """
    seeds = jnp.asarray(seeds, jnp.uint32)
    programs, pools = make_programs(env, config, seeds.shape[0]), pools or training_pools(env, config, seeds)
    begun = 0 if state is None else chunks_done(state, config)
    number = set_number(config, max(begun - 1, 0))
    random = programs.collect(pools(0), seed_keys(seeds, _RANDOM)) if random is None else programs.spread_random(random)
    worlds = pools(number)
    now = programs.begin(worlds, random, seed_keys(seeds, _START)) if state is None else programs.spread(state)
    chunk: Any = programs.chunk.lower(worlds, random, now).compile() if begun < config.chunks else None
    yield now, {}
    for done in range(begun, config.chunks):
        if set_number(config, done) != number:
            number = set_number(config, done)
            worlds = pools(number)
            now = programs.renew(worlds, now)
        now, metrics = chunk(worlds, random, now)
        yield now, metrics


def collect_random(env: Env, config: PretrainConfig, seeds: Sequence[int] | Array, worlds: World) -> PyTree:
    """Experience [M, ...] under uniformly random actions in `worlds` [M, W]: the first set of a run's pools."""
    seeds = jnp.asarray(seeds, jnp.uint32)
    return make_programs(env, config, seeds.shape[0]).collect(worlds, seed_keys(seeds, _RANDOM))


def shapes(
    env: Env, config: PretrainConfig, seeds: Sequence[int] | Array, worlds: World
) -> tuple[PyTree, PretrainState]:
    """Shapes and types of a run's random experience and state: what checkpoints are read into."""
    seeds = jnp.asarray(seeds, jnp.uint32)
    programs = make_programs(env, config, seeds.shape[0])
    random = jax.eval_shape(programs.collect, worlds, seed_keys(seeds, _RANDOM))
    return random, jax.eval_shape(programs.begin, worlds, random, seed_keys(seeds, _START))


def training_pools(
    env: Env, config: PretrainConfig, seeds: Sequence[int] | Array, domain: Domain | None = None
) -> Pools:
    """Pools of `config.worlds` worlds each, drawn from a domain (default: the task's training domain) by each seed."""
    domain = domain or uniform(env)

    @functools.lru_cache(maxsize=1)  # worlds take long to compile
    def pools(number: int) -> World:
        keys = world_keys(seeds, number)
        return stack([env.make_worlds(domain.sample(domain.init(), key, config.worlds)) for key in keys])

    return pools


def world_keys(seeds: Sequence[int] | Array, number: int = 0) -> Key:
    """Keys [M] that decide the worlds of a set."""
    keys = seed_keys(seeds, _WORLDS)
    return keys if number == 0 else jax.vmap(jax.random.fold_in, (0, None))(keys, number)


def chunks_done(state: PretrainState, config: PretrainConfig) -> int:
    """Chunks behind a state."""
    return int(jax.device_get(state.steps)[0]) // config.chunk_steps


def set_number(config: PretrainConfig, done: int) -> int:
    """Which set of worlds the chunk after `done` others takes place in."""
    return done // config.refresh_every if config.refresh_every else 0


# --- what it leaves ---------------------------------------------------------------------------------------------------


def exported(env: Env, config: PretrainConfig, state: PretrainState) -> PyTree:
    """Params [M, ...] of the agents as they are now."""
    return RECIPES[config.algorithm](env, config).extract(state.learner)


def keep_better(old: Best, new: Best, since: float | Array) -> Best:
    """The one with the higher score, then fewer explosions, then the higher return; the old one if they tie.

    since: [] steps before which nothing competes: an old one from before it always gives way.
    """
    worst = jnp.minimum(old.worst, new.worst)
    old, new = _at_worst(old, worst), _at_worst(new, worst)
    better = new.total > old.total
    for less, more in [(old.exploded, new.exploded)[::-1], (old.score, new.score)]:
        better = (more > less) | ((more == less) & better)
    better |= old.steps < since
    return jax.tree.map(lambda a, b: jnp.where(better, a, b), new, old)


def _at_worst(best: Best, worst: Array) -> Best:
    """The same evaluation now that `worst` is known; its explosions counted as `best.worst`."""
    shift = jnp.where(best.exploded > 0, best.exploded * (worst - best.worst), 0.0) * jnp.ones(2)
    return best._replace(score=best.score + shift[0], total=best.total + shift[1], worst=worst)


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


def priors_of(env: Env, config: PretrainConfig, state: PretrainState) -> list[Prior]:
    """A prior for each member, with copies of the parameters as they are now."""
    params, card = exported(env, config, state), prior_card(env, config)
    own = lambda i: jax.tree.map(lambda x: jnp.copy(x[i]), params)  # noqa: E731
    return [Prior(own(i), card) for i in range(state.steps.shape[0])]


def memory(env: Env, config: PretrainConfig) -> dict[str, int]:
    """Bytes that one seed keeps on its devices, by the setting that decides them: experience, and what updates hold."""
    kept = RECIPES[config.algorithm](env, config).memory
    size = lambda f: sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(jax.eval_shape(f)))  # noqa: E731
    drawn = config.updates_per_step * config.batch_size
    networks = config.ensemble_size + 4  # two critics, actor and V_sim
    activations = 2 * networks * config.batch_size * sum(config.network.hidden) * 4  # forwards and backwards, float32
    return {
        "random_transitions": size(lambda: kept.empty(config.random_transitions)),
        "replay_capacity": size(lambda: kept.empty(config.replay_capacity)),
        # Drawn, then put together.
        "batch_size": activations + 2 * size(lambda: kept.sample(kept.empty(config.n_envs), jax.random.key(0), drawn)),
    }


# --- compiled programs ------------------------------------------------------------------------------------------------


class Programs(NamedTuple):
    """Jitted functions of all members. worlds: [M, W]; keys: [M].

    collect(worlds, keys) -> random experience. begin(worlds, random, keys) -> state.
    spread_random(random), spread(state): the same, laid out over the devices. chunk(worlds, random, state) -> (state,
    metrics). renew(worlds, state): the same with new episodes in new worlds. The last four consume what they change.
    """

    collect: Callable[..., PyTree]
    begin: Callable[..., PretrainState]
    spread_random: Callable[[PyTree], PyTree]
    spread: Callable[[PretrainState], PretrainState]
    chunk: Any
    renew: Callable[..., PretrainState]


def make_programs(env: Env, config: PretrainConfig, members: int) -> Programs:
    """The programs of that many members."""
    trainer = make_pretrainer(env, config)
    each = functools.partial(over_members, members=members)
    return Programs(
        collect=jax.jit(each(trainer.collect_random)),
        begin=jax.jit(each(trainer.init)),
        spread_random=jax.jit(each(spread_replay), donate_argnums=0),
        spread=jax.jit(each(spread), donate_argnums=0),
        chunk=jax.jit(each(trainer.chunk), donate_argnums=2),
        renew=jax.jit(each(trainer.renew), donate_argnums=1),
    )


def over_members(
    function: Callable[..., PyTree], members: int, *, shared: tuple[int, ...] = ()
) -> Callable[..., PyTree]:
    """`function` of one member for arguments and results with a leading axis of members.

    shared: positions of arguments without that axis, one for all members. A single member is not vmapped, because vmap
    would make a `cond` (resets, only where an episode ended) compute both of its branches at every step.
    """

    def several(*args: PyTree) -> PyTree:
        return jax.vmap(function, tuple(None if i in shared else 0 for i in range(len(args))))(*args)

    def single(*args: PyTree) -> PyTree:
        own = (x if i in shared else jax.tree.map(lambda leaf: leaf[0], x) for i, x in enumerate(args))
        return jax.tree.map(lambda x: x[None], function(*own))

    return several if members > 1 else single


class Pretrainer(NamedTuple):
    """Pretraining of one member as pure functions.

    collect_random(pool, key) -> experience under random actions, full but for exploded steps.
    init(pool, random, key) -> PretrainState.
    chunk(pool, random, state) -> (state, metrics): `config.chunk_steps` steps of all environments with their updates.
    renew(pool, state) -> state with new episodes in the worlds of that pool.
    """

    collect_random: Callable[[World, Key], PyTree]
    init: Callable[[World, PyTree, Key], PretrainState]
    chunk: Callable[[World, PyTree, PretrainState], tuple[PretrainState, Metrics]]
    renew: Callable[[World, PretrainState], PretrainState]


def make_pretrainer(env: Env, config: PretrainConfig) -> Pretrainer:
    """Builds the pure functions."""
    recipe = RECIPES[config.algorithm](env, config)
    learner, kept, fresh = recipe.learner, recipe.memory, recipe.init_carry()
    step = functools.partial(step_fleet, env, gamma=config.gamma)

    def uniform_actions(key: Key) -> Array:
        return jax.random.uniform(key, (config.n_envs, env.act_dim), minval=-1.0, maxval=1.0)

    def collect_random(pool: World, key: Key) -> PyTree:
        key_launch, key_steps = jax.random.split(key)

        def random_step(carry: tuple[Fleet, PyTree], key: Key) -> tuple[tuple[Fleet, PyTree], None]:
            fleet, buffer = carry
            key_action, key_step = jax.random.split(key)
            fleet, rows, valid, after = step(pool, fleet, uniform_actions(key_action), (), key_step, initial_carry=())
            return (split(fleet), spread_replay(kept.add(buffer, rows, valid, _ended(after)))), None

        n_steps = config.random_transitions // config.n_envs
        start = (launch(env, pool, key_launch, config.n_envs, ()), kept.empty(n_steps * config.n_envs))
        return jax.lax.scan(random_step, start, jax.random.split(key_steps, n_steps))[0][1]

    def init(pool: World, random: Any, key: Key) -> PretrainState:
        key_learner, key_fleet, key_run = jax.random.split(key, 3)
        statistics = normalizer.update(normalizer.init(env.obs_dim), random.data.obs, kept.held(random))
        agent = learner.init(key_learner).replace(normalizer=normalizer.finish(statistics))
        fleet = launch(env, pool, key_fleet, config.n_envs, fresh)
        return spread(PretrainState(agent, kept.empty(config.replay_capacity), fleet, key_run, jnp.int32(0)))

    def renew(pool: World, state: PretrainState) -> PretrainState:
        key, key_fleet = jax.random.split(state.key)
        fleet = launch(env, pool, key_fleet, config.n_envs, fresh)
        return spread(state._replace(replay=kept.cut(state.replay), fleet=fleet, key=key))

    def sample(random: PyTree, buffer: PyTree, key: Key) -> Batch:
        """[updates, batch] rows, drawn at once, batches in pieces; each holds its share of random-action rows."""
        key_random, key_replay = jax.random.split(key)
        updates, n_random = config.updates_per_step, round(config.random_fraction * config.batch_size)

        def draw(source: PyTree, key: Key, n: int) -> Batch:
            rows = kept.sample(source, key, updates * n)
            return jax.tree.map(lambda x: x.reshape(updates, n, *x.shape[1:]), rows)

        old, new = draw(random, key_random, n_random), draw(buffer, key_replay, config.batch_size - n_random)
        both = jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=1), old, new)
        return split(whole(both), axis=1)  # put together in pieces, they would travel between devices twice more

    def explore(agent: PyTree, fleet: Fleet, key: Key) -> tuple[Array, PyTree]:
        """The policy's actions [n_envs, act_dim], more and more of them replaced by random ones along the fleet, and
        its carries [n_envs].
        """
        key_policy, key_replace, key_random = jax.random.split(key, 3)
        keys = jax.random.split(key_policy, config.n_envs)
        actions, carry = jax.vmap(recipe.act, (None, 0, 0, 0))(agent, fleet.carry, fleet.state.obs, keys)
        if not config.random_ladder:
            return actions, carry
        share = jnp.linspace(0.0, config.random_ladder, config.n_envs)
        replaced = jax.random.uniform(key_replace, (config.n_envs,)) < share
        actions = jnp.where(replaced[:, None], uniform_actions(key_random), actions)
        return actions, jax.vmap(recipe.replaced)(carry, actions)

    def vector_step(pool: World, random: PyTree, state: PretrainState) -> tuple[PretrainState, Metrics]:
        keys = jax.random.split(state.key, 5)
        actions, carry = explore(state.learner, state.fleet, keys[1])
        fleet, rows, valid, after = step(pool, state.fleet, actions, carry, keys[2], initial_carry=fresh)
        buffer = kept.add(state.replay, rows, valid, _ended(after))
        batches = sample(random, buffer, keys[3])
        with precision(config.precision):
            agent, metrics = jax.lax.scan(
                lambda agent, x: learner.update(agent, *x),
                state.learner.replace(hyper=recipe.hyper(state.steps)),
                (batches, jax.random.split(keys[4], config.updates_per_step)),
            )
        metrics = {k: v.mean() for k, v in metrics.items()} | _fleet_metrics(after, rows, valid)
        return spread(PretrainState(agent, buffer, fleet, keys[0], state.steps + 1)), metrics

    def chunk(pool: World, random: PyTree, state: PretrainState) -> tuple[PretrainState, Metrics]:
        state, metrics = jax.lax.scan(lambda s, _: vector_step(pool, random, s), state, None, length=config.chunk_steps)
        counts = {name: metrics.pop(name).sum() for name in ("ended", "succeeded", "terminated")}
        ended = jnp.maximum(counts["ended"], 1.0)
        shares = {f"train/{own}": counts[count] / ended for own, count in _SHARES.items()}
        counted = {"train/episodes": counts["ended"]}
        return state, whole({k: v.mean() for k, v in metrics.items()} | shares | counted)

    return Pretrainer(collect_random, init, chunk, renew)


def spread(state: PretrainState) -> PretrainState:
    """Environments and experience in pieces on the devices of a mesh, the agent whole on each of them."""
    own = state._replace(replay=spread_replay(state.replay), fleet=split(state.fleet))
    return own._replace(learner=whole(state.learner), key=whole(state.key), steps=whole(state.steps))


def spread_replay(experience: PyTree) -> PyTree:
    """The same for experience alone: its rows in pieces, its counters whole."""
    return jax.tree.map(lambda x: split(x) if x.ndim else whole(x), experience)


_SHARES = {"success": "succeeded", "terminated": "terminated"}  # of the episodes that ended in a chunk


def _fleet_metrics(after: EnvState, rows: Transition, valid: Array) -> Metrics:
    ended = _ended(after) & valid
    count = lambda mask: mask.sum().astype(jnp.float32)  # noqa: E731
    return {
        "train/reward": rows.reward.mean(),
        "train/exploded": 1.0 - valid.mean(),
        "ended": count(ended),
        "succeeded": count(ended & after.success),
        "terminated": count(ended & after.terminated),
    }


def _ended(after: EnvState) -> Array:
    """[n_envs] whether a step was the last of its episode."""
    return after.truncated | after.terminated


def seed_keys(seeds: Sequence[int] | Array, purpose: int) -> Key:
    """Keys [M] that depend on nothing but the seed and a number that stands for the purpose."""
    return jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(seed), purpose))(jnp.asarray(seeds, jnp.uint32))
