"""What the tests of the planar runners share: gaps as parameters, states to start from, golden actions."""

import jax
import jax.numpy as jnp
import numpy as np

from envs import gaps
from envs.locomotion import halfcheetah, planar, walker2d

TASKS = {"halfcheetah": halfcheetah, "walker2d": walker2d}
GOLDEN = np.array([0.5, -0.5, 0.25, -0.25, 1.0, -1.0])  # the reference's action
EVERY = [(task, gap) for task in TASKS for gap in (gaps.SIM, *gaps.presets(task))]


def theta_of(task, gap):
    """Domain parameters by name; 1 where the gap says nothing."""
    found = gaps.find(task, gap).params
    return {p.name: float(found.get(p.name, p.nominal)) for p in TASKS[task].PARAMETERS}


def compiled(task, gap=gaps.SIM):
    return TASKS[task].build(theta_of(task, gap)).compile()


def at_rest(task):
    """The coordinates that the model begins with, without any motion."""
    return planar.start(jnp.zeros(planar.NV).at[1].set(walker2d.HEIGHT * (task == "walker2d")), jnp.zeros(planar.NV))


def pool_of(env, names):
    """One world for each gap, stacked."""
    found = [gaps.worlds(env, gaps.load(env, name), jax.random.key(0)) for name in names]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *found)


def begun(env, pool, physics):
    """Episodes [n] of the worlds in `pool` that begin in that state."""
    n = len(pool.theta.params)
    states = jax.vmap(env.reset)(pool, jax.random.split(jax.random.key(1), n))
    return states._replace(physics=jax.tree.map(lambda x: jnp.broadcast_to(x, (n, *x.shape)), physics))


def play(env, pool, start, actions):
    """States [T + 1, n] under actions [T, n, 6]."""
    step, keys, states = jax.jit(jax.vmap(env.step)), jax.random.split(jax.random.key(2), len(start.time)), [start]
    for action in actions:
        states.append(step(pool, states[-1], action, keys))
    return jax.tree.map(lambda *x: jnp.stack(x), *states)


def thrown(env, pool, steps):
    """States [steps + 1, n] from a start of the task on, under random commands [steps, n, 6] kept for four steps."""
    n = len(pool.theta.params)
    drawn = jax.random.uniform(jax.random.key(3), (steps // 4, n, 6), minval=-1.0, maxval=1.0)
    actions = jnp.repeat(drawn, 4, axis=0)
    return play(env, pool, jax.vmap(env.reset)(pool, jax.random.split(jax.random.key(0), n)), actions), actions


def member(tree, *place):
    return jax.tree.map(lambda x: x[place], tree)
