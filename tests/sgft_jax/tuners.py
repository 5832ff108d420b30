"""Every method, tiny, on a point that moves in a plane, compiled once for all tests of a module."""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import untrained

from envs.types import Transition
from sgft_jax import methods
from sgft_jax.data import replay
from sgft_jax.files.disk import jsonable
from sgft_jax.learners import recurrent, sac, tdmpc2, tdmpc2_model
from sgft_jax.models.config import NetworkConfig
from sgft_jax.train.simulation import SimulatedRows
from sgft_jax.types import Finetuner, Normalizer, Prior

T = 12  # steps of an episode
NET = NetworkConfig(hidden=(8,))
# A method gets those that it has; plans have the length of a window
SMALL = (
    {"batch_size": 8, "replay_capacity": 32, "utd": 0.25, "policy_delay": 1, "critics": 3, "critic_network": NET}
    | {"actor_ramp": 0, "critic_warmup": 0, "lr_warmup": 0, "dynamics_warmup": 0, "offline_updates": 4}
    | {"branches": 2, "horizon": 2, "plan_samples": 24, "simulated_transitions": 24, "simulated_anneal": 8}
)
# `posterior` tries systems of a simulator, which the point has not: tests/sgft_jax/posterior/test_interface.py
METHODS = {name: method for name, method in methods.all_methods().items() if name != "posterior"}
PLANNERS = {"tdmpc2", "sgft-tdmpc2", "sgft-tdmpc2-code"}


def reward(obs, action, next_obs):
    return -jnp.linalg.norm(next_obs)


class Point(NamedTuple):
    """A task: actions move a point."""

    obs_dim: int = 2
    act_dim: int = 2
    measured_dim: int = 2
    sensor_errors: tuple[float, ...] = (0.0, 0.0)
    cartesian: bool = True
    episode_length: int = T
    score: str = "success"
    simulator: None = None
    reward: Callable[..., jax.Array] | None = reward
    terminated: Callable[..., jax.Array] | None = lambda obs, action, next_obs: jnp.bool_(False)


TASK = Point()
TINY = "tiny"
tdmpc2_model.SIZES[TINY] = tdmpc2_model.Size(encoder=8, mlp=8, latent=8, members=3)


def shaken(params, scale=0.3):
    """Every network moved a little, so that none says 0."""
    leaves, structure = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(8), len(leaves))
    return jax.tree.unflatten(
        structure, [x + scale * jax.random.normal(k, x.shape) for x, k in zip(leaves, keys, strict=True)]
    )


@functools.cache
def prior(algorithm="sac"):
    """An untrained prior with an opinion."""
    statistics = Normalizer(jnp.array([0.1, -0.2]), jnp.array([2.0, 0.5]))
    if algorithm == "tdmpc2":
        config = {"size": "tiny", "plan_samples": 24, "horizon": 2}
        init = tdmpc2.make_tdmpc2(tdmpc2_model.named_config(2, 2, **config)).init
        params = tdmpc2.extract_params(jax.jit(init)(jax.random.key(7)))
        card = {"algorithm": "tdmpc2", "config": config, "gamma": 0.9}
    elif algorithm == "recurrent":
        init = recurrent.make_recurrent(recurrent.RecurrentConfig(2, 2, network=NET, gru=4)).init
        params = recurrent.extract_params(jax.jit(init)(jax.random.key(7)))
        card = {"algorithm": "recurrent", "network": jsonable(NET), "config": {"gru": 4}, "gamma": 0.9}
    else:
        init = functools.partial(untrained.sac_params, sac.SACConfig(2, 2, network=NET, ensemble_size=2))
        params = jax.jit(init)(jax.random.key(7))
        told = [{"name": "wind", "index": 0, "low": -1.0, "high": 1.0}]  # `sysid` takes the last number for it
        card = {"algorithm": "sac", "network": jsonable(NET), "gamma": 0.9, "system": told}
    return Prior(shaken(params)._replace(normalizer=statistics), card)


def configure(name, **options):
    """The small configuration of a method; options that it does not have are an error."""
    kind = METHODS[name].config
    own = {field.name for field in dataclasses.fields(kind)}
    return kind(**{key: value for key, value in SMALL.items() if key in own} | options)


def build(name, task=TASK, **options):
    """The finetuner of a method as it is, with its small configuration."""
    method = METHODS[name]
    return method.build(configure(name, **options), prior(method.prior), task)


class Case(NamedTuple):
    """plain: the finetuner as built. fine: its functions compiled. data: simulated transitions, or None.

    traces: how often `learn` was traced (a list of one).
    """

    plain: Finetuner
    fine: Finetuner
    data: Any
    params: Any
    traces: list[int]


def compiled(plain, params):
    """A case of a finetuner. learn(state, key, updates=2, *, offline=False) -> (state, metrics)."""
    data, traces = simulated().of(0) if plain.simulation else None, [0]

    def learn(state, key, updates=2, offline=False):
        traces[0] += 1
        return plain.learn(state, key, updates, data, offline=offline)

    fine = plain._replace(
        init=jax.jit(lambda params, key: plain.prepare(plain.init(params, key), data)),
        observe=jax.jit(plain.observe),
        act=jax.jit(plain.act),
        export=jax.jit(plain.export),
        learn=jax.jit(learn, static_argnames=("updates", "offline")),
    )
    return Case(plain, fine, data, params, traces)


@functools.cache
def tuner(name, **options):
    """The case of a method."""
    return compiled(build(name, **options), prior(METHODS[name].prior).params)


@functools.cache
def simulated():
    """The simulator's transitions for one prior: rewards are 100, returns 100 to 300."""
    rows = episode(jax.random.key(5), 24)._replace(reward=jnp.full(24, 100.0))
    buffer = replay.add_batch(replay.init(replay.blank(2, 2), 24), rows)
    return SimulatedRows(jax.tree.map(lambda x: x[None], buffer), jnp.array([[100.0, 300.0]]))


def episode(key, n=T):
    """n steps of a point that jumps about."""
    obs, action = jax.random.uniform(key, (2, n, 2), minval=-1)
    after = obs + 0.2 * action
    return Transition(obs, action, jax.vmap(reward)(obs, action, after), jnp.full(n, 0.9), after)


def started(case, seed=0):
    """A state with one real episode."""
    state = case.fine.init(case.params, jax.random.key(seed))
    return case.fine.observe(state, episode(jax.random.key(seed)), jnp.ones(T, bool), jnp.float32(0))


class Recorded:
    """A system and all that was played on it: [(episodes, explore)]."""

    def __init__(self, system):
        self.system, self.played = system, []

    def play(self, policy, states, keys, *, explore):
        episodes = self.system.play(policy, states, keys, explore=explore)
        self.played.append((episodes, explore))
        return episodes


def copied(tree):
    """A yielded state is donated to the next step."""
    return jax.tree.map(lambda x: np.array(x), tree)


def slow_but(fast, names):
    """Parameters of a test that is quick for some names alone."""
    return [pytest.param(name, marks=[] if name in fast else [pytest.mark.slow]) for name in names]


def bits(tree):
    """Every leaf as bytes."""
    return [jnp.asarray(x).tobytes() for x in jax.tree.leaves(tree)]


def equal(a, b):
    return bits(a) == bits(b)
