"""Impure: an estimator of a task's systems learns from simulation."""

import functools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Env
from envs.types import Array, Policy, PyTree
from experiments.runner.ahead import compiling
from experiments.runner.progress import doing, far
from sgft_jax.posterior.candidates import Candidates
from sgft_jax.posterior.estimator import Estimator, at_half_precision, log_density
from sgft_jax.posterior.learning import MOST, TOGETHER, Lessons, begin, learn, simulate
from sgft_jax.stacking import join

_SEED = 1_000_000
_AT_ONCE = 3072  # systems that are simulated in one program, each with `MOST` rollouts
_TURNS = 50  # into how many calls the updates are divided
_TEST = 256  # systems that it has not learned from


def learned(
    env: Env, systems: Candidates, policy: Policy, params: Sequence[PyTree], *, lessons: int, updates: int
) -> tuple[Estimator, dict[int, float]]:
    """An estimator that has learned from so many systems, `updates` times for each number of rollouts that are read
    together, and by how many nats so many rollouts make it surer of other systems. params: of the priors whose policies
    play in turn.
    """
    key_play, key_start, key_learn = jax.random.split(jax.random.key(_SEED), 3)
    size, per_call = min(lessons, _AT_ONCE), max(1, updates // _TURNS)
    parts = -(-lessons // size)
    some = jax.jit(lambda params, key: simulate(env, systems, policy, params, key, size))
    test = jax.jit(lambda key: simulate(env, systems, policy, params[0], key, min(size, _TEST)))
    start = jax.jit(begin)
    steps = {
        n: jax.jit(functools.partial(learn, together=n, updates=per_call, total=updates), donate_argnums=0)
        for n in TOGETHER
    }
    with compiling() as ahead:
        with doing(f"simulating {parts * size * MOST} rollouts of {env.name} to learn from", 100):
            first = some(params[0], key_play)
            shape = jax.eval_shape(begin, key_start, first)
            whole = jax.tree.map(lambda x: jax.ShapeDtypeStruct((parts * x.shape[0], *x.shape[1:]), x.dtype), first)
            for step in steps.values():
                ahead.promise(step, lambda: (shape, whole, key_learn))
            taught = [jax.block_until_ready(first)]
            for i in range(1, parts):
                taught.append(jax.block_until_ready(some(params[i % len(params)], jax.random.fold_in(key_play, i))))
                far((i + 1) / parts)
        learning, seen, count = start(key_start, first), join(taught), -(-updates // per_call)
        with doing(f"learning which systems of {env.name} make which rollouts", 100):
            ahead.wait(*steps.values())
            for i in range(count):
                for n, step in steps.items():
                    learning = step(learning, seen, jax.random.fold_in(jax.random.fold_in(key_learn, i), n))
                jax.block_until_ready(learning)
                far((i + 1) / count)
        estimator = at_half_precision(learning.estimator)  # what is saved is what is judged
        return estimator, _gained(estimator, test(jax.random.fold_in(key_play, parts)))


def _gained(estimator: Estimator, lessons: Lessons) -> dict[int, float]:
    """Mean nats of the true systems after one, four and ten rollouts; before any they have none."""

    @jax.jit
    def nats(counts: Array) -> Array:
        def one(row: tuple[Array, PyTree]) -> Array:
            return log_density(estimator, row[1], counts, row[0]).sum()

        return jax.lax.map(one, (lessons.points, lessons.rollouts), batch_size=64).mean()

    return {n: float(np.asarray(nats(jnp.arange(MOST) < n))) for n in (1, 4, MOST)}
