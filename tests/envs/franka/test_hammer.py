"""Hammering in C MuJoCo: rewards by hand, starts, a script that drives the nail home, time-step accuracy."""

import itertools

import c_reference
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scripted import PROBES, as_params, measure, play_script, reference_steps

from envs.franka import arm, hammer

NOMINAL = {p.name: p.nominal for p in hammer.PARAMETERS}
PROBE = PROBES["hammer"]


def corners():
    """Extreme thetas: the highest, lowest, nearest, farthest nails, thick and thin heads."""
    low, high = {p.name: p.low for p in hammer.PARAMETERS}, {p.name: p.high for p in hammer.PARAMETERS}
    place = ("nail_x", "nail_z")
    return [low, high, low | {k: high[k] for k in place}, high | {k: low[k] for k in place}]


def some_corners():
    """The first one is enough for the fast tests."""
    return [pytest.param(theta, marks=[pytest.mark.slow] * (i > 0)) for i, theta in enumerate(corners())]


def start(theta, seed=0):
    return hammer.initial(as_params(theta), jax.random.key(seed))


def touching(model, qpos):
    """Number of contacts of a scene at rest."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return data.ncon


def drawn(model, bodies):
    """Ids of the visible geoms of some bodies."""
    ids = {model.body(name).id for name in bodies}
    return [g for g in range(model.ngeom) if model.geom_bodyid[g] in ids and model.geom_rgba[g, 3] > 0]


def depth(model, qpos, geoms, obstacles):
    """How far the deepest of `geoms` is inside any of `obstacles`, m; negative: how far the nearest is away."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    pairs = itertools.product(geoms, obstacles)
    return -min(mujoco.mj_geomDistance(model, data, *pair, 1.0, None) for pair in pairs)


def heights(theta, states):
    """Height of the head's underside above the board after each step, m."""
    return np.array([float(s.qpos[arm.N_JOINTS]) for s in states])


def test_parameters_are_table_1():
    ranges = {p.name: (p.low, p.high) for p in hammer.PARAMETERS if p.low < p.high}
    assert ranges == {
        "nail_x": (0.3, 0.4),
        "nail_z": (0.55, 0.65),
        "nail_damping": (250.0, 2500.0),
        "nail_half_height": (0.02, 0.06),
        "nail_radius": (0.005, 0.015),
        "head_radius": (0.03, 0.04),
        "head_thickness": (0.001, 0.01),
        "hammer_mass": (0.015, 0.15),
    }


def test_reward_and_success_by_hand():
    def obs(nail_z):
        return jnp.zeros(12).at[9].set(nail_z).at[11].set(0.5)

    zero = jnp.zeros(3)
    np.testing.assert_allclose(hammer.reward(obs(0.9), zero, obs(0.58)), -0.8, rtol=1e-5)  # -10 * (0.58 - 0.5)
    assert hammer.reward(obs(0.58), zero, obs(0.49)) == 0.0  # sunk below the board: no bonus for it
    assert hammer.success(obs(0.504))
    assert not hammer.success(obs(0.506))


@pytest.mark.heavy
def test_observation_of_a_start():
    theta = NOMINAL | {"nail_x": 0.32, "nail_z": 0.62, "nail_half_height": 0.05}
    state = start(theta)
    obs = np.asarray(hammer.observe(as_params(theta), state))
    model = hammer.build(theta).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = state.qpos
    mujoco.mj_forward(model, data)
    ball = data.geom("face")
    hand_axis = data.body("link7").xmat.reshape(3, 3)[:, 2]
    np.testing.assert_allclose(obs[:3], ball.xpos + hammer.FACE_RADIUS * hand_axis, atol=1e-5)
    np.testing.assert_allclose(obs[3:9], np.concatenate([state.qpos[jnp.array([1, 3, 5])], np.zeros(3)]), atol=1e-6)
    np.testing.assert_allclose(obs[9:], [0.62, 0.32, 0.52], atol=1e-6)  # board: 0.62 - 2 * 0.05


@pytest.mark.heavy
@pytest.mark.parametrize("theta", some_corners())
def test_start_is_above_the_nail_and_inside_the_limits(theta):
    params = as_params(theta)
    states = jax.jit(jax.vmap(lambda key: hammer.initial(params, key)))(jax.random.split(jax.random.key(1), 200))
    face = jax.jit(jax.vmap(lambda state: hammer.observe(params, state)))(states)[:, :3]
    assert (face[:, 2] > theta["nail_z"] + theta["head_thickness"] + 0.02).all()
    assert (face[:, 0] > 0.3).all() and (face[:, 0] < 0.38).all()
    assert np.ptp(face[:, 0]) > 0.05  # starts do differ
    np.testing.assert_allclose(face[:, 1], 0.0, atol=1e-6)
    joints = np.asarray(states.qpos[:, : arm.N_JOINTS])
    assert (joints >= arm.Q_MIN + 0.02).all() and (joints <= arm.Q_MAX - 0.02).all()


def test_targets_step_from_the_measured_angles():
    qpos = jnp.array([0.01, -0.1, 0.02, -0.2, 0.0, 0.9, 0.7, 0.08])
    target = np.asarray(hammer.target(qpos, jnp.array([1.0, 1.0, -0.5])))
    # Joint 2: -0.1 + 0.2; joint 4: -0.2 + 0.2 = 0 is past its limit; joint 6: 0.9 - 0.1; the others go home.
    np.testing.assert_allclose(target, [0.0, 0.1, 0.0, -0.1518, 0.0, 0.8, np.pi / 4], atol=1e-6)


def test_nail_weighs_what_steel_weighs():
    model = hammer.build(NOMINAL).compile()
    # Shank pi * 0.01^2 * 0.08 = 2.513e-5 m^3, head pi * 0.035^2 * 0.005 = 1.924e-5 m^3; 7850 kg/m^3.
    np.testing.assert_allclose(model.body("nail").mass, 7850 * (2.5133e-5 + 1.9242e-5), rtol=1e-4)
    heavier = hammer.build(NOMINAL | {"hammer_mass": 0.15}).compile()
    np.testing.assert_allclose(heavier.body("link7").mass - model.body("link7").mass, 0.1, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("theta", some_corners())
def test_script_drives_every_extreme_nail_home(theta):
    theta = theta | {"nail_damping": 2500.0}
    episode = play_script(PROBE, theta, start(theta), steps=hammer.SCENE.episode_length)
    obs = hammer.observe(as_params(theta), episode[-1].after)
    assert hammer.success(obs)


def test_script_has_force_to_spare_for_a_rough_nail():
    theta = NOMINAL | {"nail_damping": 2000.0, "nail_friction": 50.0}
    episode = play_script(PROBE, theta, start(theta), steps=30)
    assert heights(theta, [s.after for s in episode])[-1] <= hammer.TOLERANCE


def test_more_damping_means_less_travel_per_blow():
    high = NOMINAL | {"nail_z": 0.65}
    episode = play_script(PROBE, high | {"nail_damping": 500.0}, start(high), steps=8)
    struck = int(np.argmax(heights(high, [s.after for s in episode]) < 0.079))
    actions = [step.action for step in episode[: struck + 1]]
    left = [
        heights(high, c_reference.play(hammer.SCENE, high | {"nail_damping": d}, start(high), actions))[-1]
        for d in (500.0, 1000.0, 2000.0)
    ]
    travels = 0.08 - np.array(left)
    assert (travels[:-1] > 1.2 * travels[1:]).all()
    assert travels[-1] > 0.001


def test_board_stops_the_hammer_beside_the_nail():
    theta = NOMINAL | {"nail_x": 0.4, "nail_half_height": 0.02, "head_radius": 0.03}
    beside = PROBE._replace(script=lambda params, state, t: PROBE.script(params.at[0].set(0.3), state, t))
    states = [step.after for step in play_script(beside, theta, start(theta), steps=12)]
    faces = np.array([hammer.observe(as_params(theta), s)[:3] for s in states])
    assert faces[:, 2].min() < 0.57  # it did come down to the board at 0.56 m
    assert faces[:, 2].min() > 0.56 - 0.02  # O-24
    np.testing.assert_allclose(heights(theta, states), 0.04, atol=1e-6)  # and the nail was left alone


@pytest.mark.heavy
def test_starts_touch_nothing():
    """The high boards closest to the elbow, and of many starts those that lean forward the most."""
    high = NOMINAL | {"nail_x": 0.3, "nail_z": 0.65, "nail_half_height": 0.02}
    initial, keys = jax.jit(jax.vmap(hammer.initial, (None, 0))), jax.random.split(jax.random.key(9), 2000)
    for theta in [high, *corners()]:
        model, states = hammer.build(theta).compile(), initial(as_params(theta), keys)
        leaning = np.argsort(-np.asarray(states.qpos[:, 1]))[:50]
        assert not any(touching(model, states.qpos[i]) for i in leaning)


@pytest.mark.heavy
@pytest.mark.parametrize("theta", some_corners())
def test_arm_stays_out_of_the_board(theta):
    """Whatever all joints are told for 3 s: hammer, hand and wrist stay above its height, the arm outside of it."""
    model = hammer.build(theta).compile()
    hand, limbs = drawn(model, ["link6", "link7"]), drawn(model, ["link3", "link4", "link5"])
    board = [g for g in drawn(model, ["world"]) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX]
    for signs in itertools.product((-1.0, 1.0), repeat=3):
        for state in c_reference.play(hammer.SCENE, theta, start(theta), jnp.tile(jnp.array(signs), (15, 1))):
            assert depth(model, state.qpos, hand, [model.geom("board").id]) < 0.015
            assert depth(model, state.qpos, hand + limbs, board) < 0.015


@pytest.mark.heavy
def test_random_saturated_actions_never_explode():
    rng = np.random.default_rng(0)
    for seed, theta in enumerate(corners()):
        actions = np.repeat(np.sign(rng.normal(size=(10, 3))), 4, axis=0)
        states = c_reference.play(hammer.SCENE, theta, start(theta, seed), jnp.asarray(actions, jnp.float32))
        speeds = np.array([np.abs(s.qvel).max() for s in states])
        assert np.isfinite(speeds).all() and speeds.max() < 20.0


@pytest.mark.slow
def test_time_step_is_fine_enough():
    reference = reference_steps(PROBE, thetas=3, steps=15, seed=1)
    errors = measure(PROBE, reference, substeps=hammer.SUBSTEPS, iterations=0)
    assert errors.travel > 5.0  # mm per control period: the nail moves
    assert errors.p95 < 1.5
    assert errors.relative < 0.04
