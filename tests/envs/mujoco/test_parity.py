"""MJX against C MuJoCo: the same commands from the same states, over whole episodes with contacts.

A scripted controller plays in C MuJoCo. From each of its states MJX repeats one control period: after that, contacts
would amplify rounding errors (a puck between two fingertips: a hundredfold in three periods). Then the same controller
plays a whole episode in MJX and must end alike.
"""

import itertools

import c_reference
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from franka_bench import EXACT, SCENES, bench, member
from scripted import PROBES, play_script

import envs
from envs.franka import insert
from envs.mujoco.scene import make_env

KEY = jax.random.key(0)


def play_in_c(rig, world, start):
    """The scripted episode and its true observations [T + 1, obs_dim]."""
    probe = PROBES[rig.env.name]
    theta = dict(zip([p.name for p in rig.env.parameters], map(float, world.theta.params), strict=True))
    steps = play_script(probe, theta, start.physics, steps=rig.env.episode_length)
    observe = jax.jit(probe.scene.observe)
    return steps, np.array([observe(world.theta.params, s) for s in [start.physics, *(step.after for step in steps)]])


def repeat_in_mjx(rig, world, start, steps):
    """[T, obs_dim] true observations of MJX one control period after each state of the C episode."""
    return np.array([rig.step(world, start._replace(physics=step.before), step.action, KEY).true_obs for step in steps])


def play_in_mjx(rig, world, start):
    """[T, obs_dim] true observations of an episode that the script plays in MJX itself."""
    script, state, seen = jax.jit(PROBES[rig.env.name].script), start, []
    for t in range(rig.env.episode_length):
        state = rig.step(world, state, script(world.theta.params, state.physics, t), KEY)
        assert not state.invalid
        seen.append(np.asarray(state.true_obs))
    return np.array(seen)


@pytest.mark.slow
@pytest.mark.parametrize("i", [0, 1, 2])
def test_pushing(pushing, i):
    """0.5 mm, after up to 5 cm of pushing; at the end both pucks rest within 1 mm of where the script wants them."""
    world = member(pushing.worlds, i)
    start = pushing.reset(world, jax.random.key(i))
    steps, wanted = play_in_c(pushing, world, start)
    assert wanted[-1, 2] - wanted[0, 2] > 0.2  # the puck was pushed 20 cm, so contacts were at work
    np.testing.assert_allclose(repeat_in_mjx(pushing, world, start, steps), wanted[1:], atol=5e-4)
    np.testing.assert_allclose(play_in_mjx(pushing, world, start)[-1, 2], wanted[-1, 2], atol=1e-3)


@pytest.mark.slow
def test_saturated_servos(pushing):
    """A command 1 rad away drives every servo to its force limit at the start of the period."""
    world = member(pushing.worlds, 0)
    start = pushing.reset(world, KEY)
    far = start.physics._replace(ctrl=start.physics.ctrl + 1.0)
    theta = dict(zip([p.name for p in pushing.env.parameters], map(float, world.theta.params), strict=True))
    wanted = c_reference.play(SCENES["push"], theta, far, [np.zeros(2, np.float32)])[0]
    assert (np.abs(wanted.qpos - far.qpos)[:7] > 0.01).all()
    seen = pushing.step(world, start._replace(physics=far), np.zeros(2, np.float32), KEY).physics
    np.testing.assert_allclose(seen.qpos[:7], wanted.qpos[:7], atol=1e-5)


def slow_rig(name):
    env = make_env(SCENES[name])
    return bench(env, envs.sample_worlds(env, jax.random.key(5), 3, effects=EXACT))


@pytest.mark.slow
def test_hammering():
    """Blows with a saturated wrist: 0.5 mm, mrad, mrad/s after a period, 0.1 mm of nail after a whole episode apart."""
    rig = slow_rig("hammer")
    for i in range(3):
        world = member(rig.worlds, i)
        start = rig.reset(world, jax.random.key(i))
        steps, wanted = play_in_c(rig, world, start)
        assert wanted[0, 9] - wanted[-1, 9] > 0.01  # the nail went in
        np.testing.assert_allclose(repeat_in_mjx(rig, world, start, steps), wanted[1:], atol=5e-4)
        np.testing.assert_allclose(play_in_mjx(rig, world, start)[-1, 9], wanted[-1, 9], atol=1e-4)


def touched(model, states):
    """Names of the geoms of the arm that touch something in any of the states."""
    data, names = mujoco.MjData(model), set()
    for state in states:
        data.qpos[:] = state.qpos
        mujoco.mj_forward(model, data)
        names |= {model.geom(g).name for g in data.contact.geom.flat if model.geom_bodyid[g]}
    return names


@pytest.mark.slow
def test_arm_on_the_board():
    """Every combination of saturated commands, which press hammer, wrist and elbow on the board: 0.1 mrad."""
    rig, scene = slow_rig("hammer"), SCENES["hammer"]
    world = member(rig.worlds, 0)
    start = rig.reset(world, KEY)
    theta = dict(zip([p.name for p in rig.env.parameters], map(float, world.theta.params), strict=True))
    names = set()
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        action = jnp.array(signs)
        states = [start.physics, *c_reference.play(scene, theta, start.physics, [action] * 12)]
        names |= touched(scene.build(theta).compile(), states)
        seen = [rig.step(world, start._replace(physics=s), action, KEY).physics.qpos for s in states[:-1]]
        np.testing.assert_allclose(seen, [s.qpos for s in states[1:]], atol=1e-4)
    assert names >= {"face", "handle", "wrist", "elbow"}


def grope(params, state, t):
    """[3]: come down 1.5 mm beside the hole, press, and slip in with a wiggle."""
    obs = insert.observe(params, state)
    off = jnp.array([0.0015 * jnp.cos(t * 1.0), 0.0015 * jnp.sin(t * 1.0)])
    aim = obs[6:8] + off - obs[3:5]
    down = jnp.where(jnp.linalg.norm(aim) < 0.005, -0.5, 0.0)
    return jnp.clip(jnp.append(aim / insert.STEP, down), -1.0, 1.0)


@pytest.mark.slow
def test_insertion(monkeypatch):
    """Groping about the hole's rim and on its walls: 0.1 mm after a period, 1 mm after a whole episode apart."""
    monkeypatch.setitem(PROBES, "insert", PROBES["insert"]._replace(script=grope))
    rig = slow_rig("insert")
    for i in range(3):
        world = member(rig.worlds, i)
        start = rig.reset(world, jax.random.key(i))
        steps, wanted = play_in_c(rig, world, start)
        assert np.abs(wanted[-1, 3:6] - wanted[-1, 6:9]).max() < 0.002  # the leg went in
        inside = wanted[:, 5] < -0.005
        aside = np.linalg.norm(wanted[inside, 3:5] - wanted[inside, 6:8], axis=1)
        assert inside.sum() > 10 and aside.max() < 0.001  # sent 1.5 mm aside, held back by the walls
        np.testing.assert_allclose(repeat_in_mjx(rig, world, start, steps), wanted[1:], atol=1e-4)
        np.testing.assert_allclose(play_in_mjx(rig, world, start), wanted[1:], atol=1e-3)
