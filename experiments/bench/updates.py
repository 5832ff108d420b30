"""Speed of SAC updates next to the same arithmetic by hand, and next to other libraries where they are installed."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Key, PyTree, Transition
from experiments.bench import bare_sac, other_sac
from experiments.bench.timing import Timing, fastest, measure
from sgft_jax.data import replay
from sgft_jax.learners.sac import SACConfig, SACHyper, make_sac
from sgft_jax.models.networks import NetworkConfig, Precision, precision
from sgft_jax.types import Batch

OBS_DIM, ACT_DIM, MEMBERS = 12, 3, 5  # sizes of the updates, a manipulation task's
REPLAY = 100_000  # rows that batches of plain SAC are drawn from


class Agent(NamedTuple):
    """update(state, batch, key) -> state; init(key) -> state."""

    update: Callable[[PyTree, Transition, Key], PyTree]
    init: Callable[[Key], PyTree]


def speed(
    batch: int, seeds: int, *, width: int, updates: int, repeats: int, exact: Precision = "default"
) -> dict[str, Any]:
    """Updates of pretraining per second over all seeds: of the library, and of the hand-written one.

    gb: bytes that the compiled update reads and writes, as XLA counts them.
    """
    network = NetworkConfig(hidden=(width, width), layer_norm=True)
    keys, count = jax.random.split(jax.random.key(0), seeds), seeds * updates
    with precision(exact):
        library, bare = (
            _repeated(agent, batch, keys, updates, repeats) for agent in (_library(network), _by_hand(network, batch))
        )
    moved, per_s = _bytes(_library(network), batch, keys), count / library.seconds
    line = {"batch": batch, "seeds": seeds, "width": width, "precision": exact}
    line |= {"updates_per_s": per_s, "bare_per_s": count / bare.seconds, "updates/bare": bare.seconds / library.seconds}
    line |= {"gb_per_update": moved / 1e9, "tb_per_s": per_s * moved / 1e12}
    return line | {"compile_s": library.compile_s, "memory_mb": library.memory_mb}


def plain_speed(batch: int, *, width: int, updates: int, repeats: int) -> dict[str, Any]:
    """Updates per second of plain SAC, drawing its batches included: ours, and of libraries that are installed."""
    network = NetworkConfig(hidden=(width, width))
    learner = make_sac(SACConfig(OBS_DIM, ACT_DIM, network=network, train_value=False, train_dynamics=False))
    buffer = replay.add_batch(replay.init(replay.blank(OBS_DIM, ACT_DIM), REPLAY), rows(jax.random.key(0), REPLAY))

    def run(agent: PyTree, buffer: replay.ReplayState, key: Key) -> PyTree:
        def update(agent: PyTree, key: Key) -> tuple[PyTree, None]:
            key_draw, key_update = jax.random.split(key)
            return learner.update(agent, replay.sample(buffer, key_draw, batch), key_update)[0], None

        return jax.lax.scan(update, agent, jax.random.split(key, updates))[0]

    ours = measure(run, (learner.init(jax.random.key(1)), buffer, jax.random.key(2)), repeats=repeats)
    line = {"batch": batch, "width": width, "updates_per_s": updates / ours.seconds}
    for name in other_sac.importable():
        train = other_sac.make(name, batch, width, OBS_DIM, ACT_DIM, REPLAY)
        per_s = updates / fastest(lambda train=train: train(updates), repeats=repeats)
        line |= {f"{name}_per_s": per_s, f"updates/{name}": line["updates_per_s"] / per_s}
    return line | {"compile_s": ours.compile_s}


def rows(key: Key, batch: int, obs_dim: int = OBS_DIM, act_dim: int = ACT_DIM) -> Transition:
    """A batch of made-up transitions."""
    blank = replay.blank(obs_dim, act_dim)
    obs, next_obs = jax.random.normal(key, (2, batch, obs_dim))
    full = jax.tree.map(lambda x: jnp.broadcast_to(x, (batch, *x.shape)), blank)
    return full._replace(obs=obs, next_obs=next_obs, discount=full.discount + 0.97)


def _library(network: NetworkConfig) -> Agent:
    """SAC as pretraining uses it."""
    learner = make_sac(SACConfig(OBS_DIM, ACT_DIM, network=network, ensemble_size=MEMBERS))
    return Agent(lambda state, batch, key: learner.update(state, Batch(*batch), key)[0], learner.init)


def _by_hand(network: NetworkConfig, batch: int) -> Agent:
    """The same in bare JAX, for batches of that size."""
    hyper = SACHyper()

    def update(state: bare_sac.Bare, rows: Transition, key: Key) -> bare_sac.Bare:
        return bare_sac.update(state, rows, bare_sac.draw(key, batch, ACT_DIM, MEMBERS), hyper)

    def init(key: Key) -> bare_sac.Bare:
        return bare_sac.init(key, network, OBS_DIM, ACT_DIM, members=MEMBERS, alpha=1.0)

    return Agent(update, init)


def _repeated(agent: Agent, batch: int, keys: Key, n: int, repeats: int) -> Timing:
    """N updates of every seed."""

    def run(state: PyTree, key: Key) -> PyTree:
        data = rows(key, batch)
        return jax.lax.scan(lambda s, k: (agent.update(s, data, k), None), state, jax.random.split(key, n))[0]

    return measure(jax.vmap(run), (jax.jit(jax.vmap(agent.init))(keys), keys), repeats=repeats)


def _bytes(agent: Agent, batch: int, keys: Key) -> float:
    """What one update of one seed moves, by XLA's count of its compiled program for all seeds."""
    made = jax.jit(jax.vmap(agent.init))(keys)
    data = jax.vmap(lambda key: rows(key, batch))(keys)
    cost: Any = jax.jit(jax.vmap(agent.update)).lower(made, data, keys).compile().cost_analysis()
    return float(cost["bytes accessed"]) / len(keys)
