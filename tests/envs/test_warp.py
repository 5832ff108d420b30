"""MuJoCo Warp, here on the CPU, against C MuJoCo: one control period from each state of hammering episodes."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from franka_bench import EXACT, SCENES, theta_of

from envs import engine_warp
from envs.franka.task import make_env
from experiments.accuracy import PROBES

pytest.importorskip("warp")
WORLDS, STEPS = 3, 24


def in_random_worlds(env, rng):
    """[WORLDS], every parameter varied, so that the board stands elsewhere in each."""
    thetas = [theta_of(SCENES["hammer"], rng) for _ in range(WORLDS)]
    pools = [env.sample_worlds(jax.random.key(0), 1, params=theta, effects=EXACT) for theta in thetas]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *pools)


def hammer(env, world, key):
    """Actions [STEPS, 3] of the scripted controller and the states [STEPS + 1] that they lead through."""
    start = env.reset(world, key)

    def step(state, t):
        action = PROBES["hammer"].script(world.params, state.physics, t)
        after = env.step(world, state, action, key)
        return after, (action, after)

    actions, later = jax.lax.scan(step, start, jnp.arange(STEPS))[1]
    return actions, jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, later)


def test_hammering():
    """0.2 mrad and 0.01 mm after 0.2 s with blows on nail and board and saturated servos; all worlds in one batch."""
    c, warp = (make_env(SCENES["hammer"], impl=impl) for impl in ("c", "warp"))
    worlds, keys = in_random_worlds(c, np.random.default_rng(3)), jax.random.split(jax.random.key(1), WORLDS)
    actions, states = jax.jit(jax.vmap(lambda *x: hammer(c, *x)))(worlds, keys)
    before, after = (jax.tree.map(lambda x, s=s: x[:, s], states) for s in (slice(0, -1), slice(1, None)))
    over_time = jax.vmap(warp.step, (None, 0, 0, None))
    seen = jax.jit(jax.vmap(over_time))(worlds, before, actions, keys)
    assert not seen.invalid.any()
    error = np.abs(seen.physics.qpos - after.physics.qpos)
    assert error[..., :7].max() < 2e-4 and error[..., 7].max() < 2e-5
    nail = np.asarray(states.physics.qpos)[..., 7]
    assert (nail[:, 0] - nail[:, -1]).max() > 1e-3  # some blow drove a nail


def test_arm_on_the_board():
    """0.1 mrad after 0.2 s under saturated commands that press hammer, wrist and elbow on the board."""
    c, warp = (make_env(SCENES["hammer"], impl=impl) for impl in ("c", "warp"))
    actions = jnp.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    worlds = c.sample_worlds(jax.random.key(3), len(actions), effects=EXACT)
    keys = jax.random.split(jax.random.key(0), len(actions))
    state = jax.vmap(c.reset)(worlds, keys)
    steps = [jax.jit(jax.vmap(env.step)) for env in (c, warp)]
    for _ in range(12):
        after, seen = (step(worlds, state, actions, keys) for step in steps)
        np.testing.assert_allclose(seen.physics.qpos, after.physics.qpos, atol=1e-4)
        state = after


@pytest.mark.slow
def test_lost_contacts_are_explosions(monkeypatch):
    """With room for fewer constraint rows than a blow needs, the state is not finite instead of silently wrong."""
    monkeypatch.setattr(engine_warp, "budget", lambda host: (2, 1))
    env = make_env(SCENES["hammer"], impl="warp")
    worlds = in_random_worlds(env, np.random.default_rng(3))
    world = jax.tree.map(lambda x: x[0], worlds)
    _, states = jax.jit(lambda key: hammer(env, world, key))(jax.random.key(1))
    assert states.invalid.any() and not states.invalid[0]
