"""Towel and ball: real scenes of pushing with the interface of the simulated one, which deform and come to rest."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import make
from franka_bench import EXACT, Bench, bench, member, push_hard

import envs
from envs import gaps
from envs.base import EnvState
from envs.franka import arm, ball, push, towel
from envs.rollout import real_env
from envs.types import UserError

KEY = jax.random.key(0)
NAMES = {"push-towel": "towel", "push-ball": "ball"}


class Way(NamedTuple):
    """How to push an object to the edge: at which distance the hand touches it; the share of the way that it asks for
    in a step, and the most, m; where the object should stop, m."""

    reach: float
    gain: float
    most: float
    goal: float


WAYS = {"push-towel": Way(0.06, 0.3, 0.03, 0.529), "push-ball": Way(0.055, 0.15, 0.015, 0.535)}


def push_softly(way, obs):
    """[2]: line up with the object and push it along, the slower the nearer to the edge."""
    off = obs[2:] - obs[:2]
    come = jnp.where(jnp.abs(off[1]) < 0.01, jnp.minimum(off[0] - way.reach + 0.005, push.STEP), 0.0)
    along = jnp.clip(way.gain * (way.goal - obs[2]), -0.02, way.most)
    return jnp.clip(jnp.stack([jnp.where(off[0] > way.reach, come, along), off[1]]) / push.STEP, -1.0, 1.0)


@pytest.fixture(scope="module", params=["push-towel", pytest.param("push-ball", marks=pytest.mark.slow)])
def real(request) -> Bench:
    """Four worlds of the default real system on MuJoCo's C engine, with exact sensors."""
    env = make(request.param, "c", NAMES[request.param])
    gap = gaps.load(env, "default")
    return bench(env, envs.sample_worlds(env, jax.random.key(7), 4, params=gap.params, effects=EXACT))


def played(rig, act, i=0, steps=40) -> list[EnvState]:
    """An episode in one world: [steps + 1] states."""
    world = member(rig.worlds, i)
    states = [rig.reset(world, jax.random.key(i))]
    for _ in range(steps):
        states.append(rig.step(world, states[-1], act(states[-1].true_obs), KEY))
    return states


def shape(rig, state):
    """What makes up the object's form, m: the towel's points around their middle, or how far its pads stick out."""
    free = np.asarray(state.physics.qpos)[arm.N_JOINTS :]
    if rig.env.scene == "ball":
        return free[7:]
    points = free.reshape(-1, 3) + towel.POINTS
    return points - points.mean(0)


@pytest.mark.heavy
def test_real_and_simulated_systems_are_one_task(real):
    simulated = make(real.env.name, "c")
    for name in ("name", "observation", "action", "parameters", "episode_length", "control_dt", "success_anytime"):
        assert getattr(simulated, name) == getattr(real.env, name)
    assert (simulated.scene, real.env.scene) == ("", NAMES[simulated.name])
    assert simulated.reward is real.env.reward and simulated.success is real.env.success
    theta = np.asarray(real.worlds.theta.params)
    states = jax.vmap(real.env.reset)(real.worlds, jax.random.split(KEY, 4))
    np.testing.assert_allclose(states.obs[:, 2:], theta[:, :2], atol=1e-6)  # the object lies where theta says
    np.testing.assert_array_equal(states.reward, 0.0)
    assert not states.success.any()


@pytest.mark.heavy
def test_left_alone_it_comes_to_rest(real):
    states = played(real, lambda obs: jnp.zeros(2), steps=20)
    assert not any(state.invalid for state in states)
    moved = np.asarray(states[-1].true_obs[2:] - states[0].true_obs[2:])
    assert np.abs(moved).max() < 0.002
    assert np.abs(states[-1].physics.qvel[arm.N_JOINTS :]).max() < 0.05  # m/s and rad/s


@pytest.mark.heavy
def test_pushed_it_deforms_and_follows(real):
    states = played(real, lambda obs: push_softly(WAYS[real.env.name]._replace(gain=1.0), obs), steps=14)
    assert states[-1].true_obs[2] - states[0].true_obs[2] > 0.03
    at_rest = shape(real, states[1])
    change = max(np.abs(shape(real, state) - at_rest).max() for state in states[2:])
    assert 0.003 < change < 0.2
    assert max(np.abs(state.physics.qvel).max() for state in states) < 20.0


@pytest.mark.heavy
def test_it_comes_to_rest_when_the_hand_stops(real):
    """In the next periods: a towel at once, a ball within a few centimetres, and neither creeps on."""

    def push_then_stop(obs):
        off = obs[3] - obs[1]
        ahead = jnp.where(jnp.abs(off) > 0.02, 0.0, 0.8)
        return jnp.where(obs[2] > 0.34, 0.0, jnp.clip(jnp.stack([ahead, off / push.STEP]), -1.0, 1.0))

    x = np.array([float(state.true_obs[2]) for state in played(real, push_then_stop, steps=28)])
    stop = np.argmax(x > 0.34)
    assert stop and 0.0 < x[stop:].max() - x[stop] < {"towel": 0.005, "ball": 0.03}[real.env.scene]
    assert abs(x[-1] - x[-6]) < 0.002


def laid(rig, state, past):
    """That physics state with the object as at the start, its middle so far past the edge, m."""
    n = arm.N_JOINTS
    xy = jnp.array([push.TABLE_ORIGIN + push.EDGE + past, 0.1])
    place = {"towel": jnp.tile(jnp.append(xy, 0.0), towel.N**2), "ball": state.physics.qpos[n:].at[:2].set(xy)}
    return state.physics._replace(qpos=state.physics.qpos.at[n:].set(place[rig.env.scene]))


@pytest.mark.parametrize(("short", "stays"), [(0.014, {"towel", "ball"}), (0.007, {"towel"})])
def test_near_the_edge_a_ball_tips_over_and_a_towel_stays(real, short, stays):
    """What hangs over does not carry the ball: docs/physics.md."""
    world = member(real.worlds, 0)
    state = real.reset(world, KEY)
    state = state._replace(physics=laid(real, state, -short))
    for _ in range(20):
        state = real.step(world, state, jnp.zeros(2), KEY)
    assert bool(state.success) == (real.env.scene in stays)


def test_past_the_edge_it_lies_out_of_reach(real):
    world = member(real.worlds, 0)
    state = real.reset(world, KEY)
    there = laid(real, state, 0.04)
    for _ in range(3):
        state = real.step(world, state._replace(physics=there), jnp.zeros(2), KEY)
        np.testing.assert_allclose(state.true_obs[2:], [push.SEEN_AT, 0.1], atol=0.01)
        assert not state.success and not state.invalid
        there = state.physics


def test_the_sphere_is_one():
    for splits, points in ((0, 12), (1, 42), (3, 642)):
        vertices, faces = ball._sphere(splits)
        assert vertices.shape == (points, 3) and faces.shape == (2 * points - 4, 3)
        np.testing.assert_allclose(np.linalg.norm(vertices, axis=1), 1.0)
        a, b, c = vertices[faces.T]
        assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a) > 0).all()  # all faces look outwards


def test_splines_run_through_the_points():
    weights = towel._spline(fine=4)
    np.testing.assert_allclose(weights.sum(1), 1.0)
    np.testing.assert_allclose(weights[::4], np.eye(towel.N), atol=1e-12)
    np.testing.assert_allclose(weights @ np.arange(towel.N), np.arange(0, towel.N - 0.9, 0.25), atol=1e-12)


def test_scenes_by_name():
    with pytest.raises(UserError, match="push: scene: there is no 'towel'"):
        envs.scene("push", "towel")
    with pytest.raises(UserError, match=r"push-towel: scene: there is no 'towl', did you mean 'towel'\?"):
        envs.make("push-towel", "c", "towl")


def test_a_gap_names_its_scene(tmp_path):
    env = envs.make("push-towel", "c")
    own = tmp_path / "own.toml"
    own.write_text('scene = "towel"\nparams = { table_friction = 0.7 }\n')
    gap = gaps.load(env, str(own), ["object_x=0.25"])
    assert gap.scene == "towel" and real_env(env, [gap]).scene == "towel"
    own.write_text("params = { table_friction = 0.7 }\n")
    plain = gaps.load(env, str(own))
    assert real_env(env, [plain]) is env and real_env(env, []) is env
    with pytest.raises(UserError, match=r"own is in the simulated scene and .* in scene 'towel': .* one at a time"):
        real_env(env, [plain, gap])
    own.write_text("scene = 3\n")
    with pytest.raises(UserError, match="'scene' must be a name, got 3"):
        gaps.load(env, str(own))


@pytest.mark.slow
def test_soft_pushes_succeed(real):
    """And those for a puck leave a towel at the edge, where a ball rolls on."""
    way = WAYS[real.env.name]
    soft = [played(real, lambda obs: push_softly(way, obs), i)[-1] for i in range(4)]
    assert sum(bool(state.success) for state in soft) >= 3  # a ball on the goal line may still tip over the edge
    hard = [played(real, push_hard, i)[-1] for i in range(4)]
    if real.env.scene == "ball":
        assert sum(bool(state.success) for state in hard) <= 2
        assert max(float(state.true_obs[2]) for state in hard) > push.EDGE


@pytest.mark.slow
def test_mjx_steps_it_as_mujoco_does(real):
    """From states of a push, one control period.

    MJX counts the couplings of a towel's dampers, which C MuJoCo leaves out (docs/physics.md): in 28 periods they were
    1.1 mm apart on average and 5.5 at worst, in 12 without dampers 0.2 and 0.9.
    """
    states = played(real, lambda obs: push_softly(WAYS[real.env.name], obs), steps=12)
    mjx = bench(envs.make(real.env.name, "jax", real.env.scene), real.worlds)
    apart = []
    for before, after in zip(states[:-1:3], states[1::3], strict=False):
        action = push_softly(WAYS[real.env.name], before.true_obs)
        seen = mjx.step(member(real.worlds, 0), before, action, KEY)
        apart.append(np.abs(seen.true_obs - after.true_obs))
    worst, mean = {"towel": (8e-3, 2e-3), "ball": (1e-3, 1e-3)}[real.env.scene]  # m
    assert np.max(apart) < worst and np.max(apart, axis=1).mean() < mean
    assert np.max(apart, axis=0)[:2].max() < 1e-4  # the hand
