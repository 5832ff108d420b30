"""Impure: an estimator of a task's systems learns from simulation."""

import functools
from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Env
from envs.types import Array, Key, Policy, PyTree
from experiments.runner.ahead import compiling
from experiments.runner.progress import doing, far
from sgft_jax.posterior.candidates import Candidates
from sgft_jax.posterior.estimator import MOST, Estimator, at_half_precision, log_density
from sgft_jax.posterior.learning import TOGETHER, Lessons, begin, finish, learn, resume, simulate
from sgft_jax.stacking import join

_SEED = 1_000_000
_AT_ONCE = 3072  # systems that are simulated in one program, each with `MOST` rollouts
_SECOND = 22  # one in so many programs runs in the second engine
_TURNS = 50  # into how many calls the updates are divided
_FRESH, _TEST = 1024, 256  # systems that it has not learned from: to finish it, and to judge it


class Simulator(NamedTuple):
    """A task in a physics engine, and its systems there."""

    env: Env
    systems: Candidates


def learned(
    simulators: Sequence[Simulator],
    policy: Policy,
    params: Sequence[PyTree],
    *,
    lessons: int,
    updates: int,
    former: Estimator | None = None,
) -> tuple[Estimator, dict[int, float]]:
    """An estimator that has learned from so many systems, `updates` times for each number of rollouts that are read
    together, and by how many nats so many rollouts make it surer of other systems.

    simulators: of one task in one or two engines; the second makes one in 22 systems. Real contacts are those of no
    engine, so it must not know one by heart. params: of the priors whose policies play in turn. former: goes on
    learning, in place of a new one.
    """
    key_play, key_start, key_learn = jax.random.split(jax.random.key(_SEED), 3)
    cpu = jax.default_backend() == "cpu"
    size, per_call = min(-(-lessons // len(params)), _AT_ONCE), max(1, updates // _TURNS)
    parts, name = -(-lessons // size), simulators[0].env.name
    start = jax.jit(begin if former is None else lambda key, lessons: resume(former))
    steps = {
        n: jax.jit(functools.partial(learn, together=n, updates=per_call, total=updates), donate_argnums=0)
        for n in TOGETHER
    }
    with compiling() as ahead:
        with doing(f"simulating {parts * size * MOST} rollouts of {name} to learn from", 100):
            programs = [_program(simulator, policy, size) for simulator in simulators]
            taught = [programs[0](params[0], key_play)]
            shape = jax.eval_shape(start, key_start, taught[0])
            whole = jax.tree.map(lambda x: jax.ShapeDtypeStruct((parts * x.shape[0], *x.shape[1:]), x.dtype), taught[0])
            for step in steps.values():
                ahead.promise(step, lambda: (shape, whole, key_learn))
            for i in range(1, parts):
                program = programs[-1 if i % _SECOND == 1 else 0]
                taught.append(program(params[i % len(params)], jax.random.fold_in(key_play, i)))
                if program is programs[0]:  # beside it the second engine works on
                    jax.block_until_ready(taught[i])
                far((i + 1) / parts)
            seen = join(jax.device_get(taught))  # from two devices
        count = -(-updates // per_call)
        with doing(f"learning which systems of {name} make which rollouts", 10 * updates if cpu else 100):
            learning = start(key_start, seen)
            ahead.wait(*steps.values())
            for i in range(count):
                for n, step in steps.items():
                    learning = step(learning, seen, jax.random.fold_in(jax.random.fold_in(key_learn, i), n))
                jax.block_until_ready(learning)
                far((i + 1) / count)
        with doing(f"checking how sure of systems of {name} it may be", 240 if cpu else 60):
            key_fresh, key_test = jax.random.split(jax.random.fold_in(key_play, parts))
            others = functools.partial(_others, simulators, policy, params)
            complete = jax.jit(finish)(learning.estimator, others(key_fresh, min(lessons, _FRESH)), key_fresh)
            estimator = at_half_precision(complete)  # what is saved is what is judged
            return estimator, _gained(estimator, others(key_test, min(lessons, _TEST)))


def _program(simulator: Simulator, policy: Policy, n: int) -> Callable[[PyTree, Key], Lessons]:
    """Rollouts in n systems. MuJoCo's own engine runs on the host, with the policy, beside what a GPU does."""
    program = jax.jit(lambda params, key: simulate(*simulator, policy, params, key, n))
    if simulator.env.impl != "c":
        return program
    host = jax.local_devices(backend="cpu")[0]
    return lambda *args: program(*jax.device_put(args, host))


def _others(simulators: Sequence[Simulator], policy: Policy, params: Sequence[PyTree], key: Key, n: int) -> Lessons:
    """Systems from all simulators and priors alike, n of them or a few less."""
    few = max(1, n // (len(simulators) * len(params)))
    programs = [_program(simulator, policy, few) for simulator in simulators]
    pairs = enumerate(product(programs, params))
    return join(jax.device_get([program(prior, jax.random.fold_in(key, i)) for i, (program, prior) in pairs]))


def _gained(estimator: Estimator, lessons: Lessons) -> dict[int, float]:
    """Mean nats of the true systems after one, four and ten rollouts; before any they have none."""

    @jax.jit
    def nats(counts: Array) -> Array:
        def one(row: tuple[Array, PyTree]) -> Array:
            return log_density(estimator, row[1], counts, row[0]).sum()

        return jax.lax.map(one, (lessons.points, lessons.rollouts), batch_size=64).mean()

    return {n: float(np.asarray(nats(jnp.arange(MOST) < n))) for n in (1, 4, MOST)}
