"""Insertion in C MuJoCo: rewards and geometry by hand, a script that solves it, walls that hold, time-step accuracy."""

import c_reference
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from scripted import PROBES, as_params, measure, play_script, reference_steps, sample_theta

from envs.franka import arm, insert

NOMINAL = {p.name: p.nominal for p in insert.PARAMETERS}
PROBE = PROBES["insert"]
INITIAL = jax.jit(insert.initial)


def obs_at(dx, dy, dz):
    """An observation with the leg that far from its place."""
    hole = jnp.array([0.5, 0.0, -0.025])
    return jnp.concatenate([jnp.zeros(3), hole + jnp.array([dx, dy, dz]), hole])


@pytest.mark.parametrize(
    ("offset", "reward", "success"),
    [
        ((0.0, 0.0, 0.0), 1.0, True),
        ((0.009, -0.009, 0.009), 1 - 100 * 3 * 0.009**2, True),  # 1 - 0.0243
        ((0.011, 0.0, 0.0), -100 * 0.011**2, False),  # one axis off: no bonus, -0.0121
        ((0.2, -0.3, 0.05), -100 * (0.1**2 + 0.1**2 + 0.05**2), False),  # capped at 10 cm: -2.25
    ],
)
def test_reward_and_success_by_hand(offset, reward, success):
    np.testing.assert_allclose(insert.reward(obs_at(1, 1, 1), jnp.zeros(3), obs_at(*offset)), reward, rtol=1e-4)
    assert bool(insert.success(obs_at(*offset))) == success


def test_parameters_are_table_3():
    ranges = {p.name: (p.low, p.high) for p in insert.PARAMETERS if p.low < p.high}
    assert ranges == {
        "part_x": (-0.05, 0.05),
        "part_y": (-0.05, 0.05),
        "part_rotation": (-np.pi / 12, np.pi / 12),
        "part_friction": (0.14, 0.16),
    }


def test_place_of_the_hole():
    np.testing.assert_allclose(insert.assembled(as_params(NOMINAL)), [0.5, 0.0, -0.025], atol=1e-6)
    turned = as_params(NOMINAL | {"part_x": 0.02, "part_rotation": np.pi / 2})
    # The part's centre is at (0.5 - 0.06075, -0.06075); a quarter turn takes the offset (a, a) to (-a, a).
    np.testing.assert_allclose(insert.assembled(turned), [0.5 - 0.1215 + 0.02, 0.0, -0.025], atol=1e-6)


@pytest.mark.parametrize("rotation", [0.0, 0.2])
def test_simulated_hole_is_the_observed_one(rotation):
    theta = NOMINAL | {"part_x": 0.03, "part_y": -0.02, "part_rotation": rotation}
    model = insert.build(theta).compile()
    np.testing.assert_allclose(model.body("hole").pos[:2], insert.assembled(as_params(theta))[:2], atol=1e-6)


def test_observed_leg_is_the_simulated_one():
    state = INITIAL(as_params(NOMINAL), jax.random.key(0))
    model = insert.build(NOMINAL).compile()
    data = mujoco.MjData(model)
    data.qpos[:] = state.qpos
    mujoco.mj_forward(model, data)
    obs = insert.observe(as_params(NOMINAL), state)
    lowest = data.geom("tip").xpos - [0, 0, insert.TIP_ROUNDING]
    np.testing.assert_allclose(obs[3:6], lowest, atol=2e-4)
    np.testing.assert_allclose(obs[:3] - obs[3:6], [0, 0, insert.GRASP], atol=2e-4)


@pytest.mark.heavy
def test_starts_lie_around_the_nominal_hole():
    keys = jax.random.split(jax.random.key(0), 300)
    params = as_params(NOMINAL)
    tips = jax.jit(jax.vmap(lambda key: insert.observe(params, insert.initial(params, key))))(keys)
    offset = np.asarray(tips[:, 3:6]) - [0.5, 0.0, 0.0]
    low, high = insert.START_LOW, insert.START_HIGH
    assert (offset > low - 5e-4).all() and (offset < high + 5e-4).all()
    assert (np.ptp(offset, axis=0) > 0.9 * (high - low)).all()


@pytest.mark.slow
def test_script_inserts_for_every_theta():
    rng = np.random.default_rng(0)
    for seed in range(12):
        theta = sample_theta(insert.SCENE, rng)
        start = INITIAL(as_params(theta), jax.random.key(seed))
        steps = play_script(PROBE, theta, start, steps=20)
        assert insert.success(insert.observe(as_params(theta), steps[-1].after))


def pressed(theta, aside, *, down, seed=0):
    """[T, 3] m: the tip relative to the hole's mouth while pressing `aside` m next to the hole's axis."""
    params = as_params(theta)
    observe = jax.jit(insert.observe)
    state, seen = INITIAL(params, jax.random.key(seed)), []
    for t in range(20):
        obs = np.asarray(observe(params, state))
        aim = obs[6:8] + np.array([aside, 0.0]) - obs[3:5]
        action = np.append(aim / insert.STEP, 0.0 if t < 8 and np.abs(aim).max() > 5e-4 else -down)
        state = c_reference.play(insert.SCENE, theta, state, [np.clip(action, -1, 1).astype(np.float32)])[0]
        seen.append(np.asarray(observe(params, state))[3:6] - obs[6:9] + [0, 0, -insert.DEPTH])
    return np.array(seen)


def test_surface_holds_beside_the_hole():
    heights = pressed(NOMINAL, 0.02, down=1.0)[:, 2]
    assert heights.min() > -8e-4  # pressed with 100 N and 2 cm steps: sinks in by less than 0.8 mm
    assert heights[-1] < 1e-3  # and does touch


@pytest.mark.slow
def test_rounded_tip_slips_in_only_near_the_hole():
    """Friction 0.15: the tip slides where the rim is steeper than atan(0.15), within 0.5 + 3 (1 - 0.148) = 3.06 mm."""
    assert pressed(NOMINAL, 0.002, down=0.3)[-1, 2] < -0.015
    assert pressed(NOMINAL, 0.006, down=0.3)[-1, 2] > -1e-3


@pytest.mark.parametrize(("hole_radius", "clearance"), [(0.012, 0.0005), (0.0118, 0.0003)])
def test_clearance(hole_radius, clearance):
    """A light sideways push inside the hole ends at a wall."""
    theta = NOMINAL | {"hole_radius": hole_radius}
    params, observe = as_params(theta), jax.jit(insert.observe)
    start = INITIAL(params, jax.random.key(0))
    state = play_script(PROBE, theta, start, steps=15)[-1].after
    for _ in range(3):
        state = c_reference.play(insert.SCENE, theta, state, [np.array([0.1, 0, 0], np.float32)])[0]  # 2 mm
    obs = observe(params, state)
    np.testing.assert_allclose(obs[3] - obs[6], clearance, atol=1.5e-4)


@pytest.mark.slow
def test_time_step_is_accurate():
    errors = measure(PROBE, reference_steps(PROBE, thetas=3, steps=10, seed=0), substeps=insert.SUBSTEPS, iterations=0)
    assert errors.p95 < 0.5  # mm after 0.2 s, at a quarter of the step and 100 iterations


@pytest.mark.slow
def test_target_keeps_the_leg_upright():
    tilted = jnp.asarray(insert.initial(as_params(NOMINAL), jax.random.key(0)).qpos).at[5].add(0.05)
    pose = arm.forward(insert.target(tilted, jnp.zeros(3)))
    np.testing.assert_allclose(pose.rotation, arm.DOWN, atol=2e-3)
    assert insert.NV == arm.N_JOINTS
