"""The tables of the real runners and of every gap, read from the compiled models, and steps known to the last digit.

Numbers: measured with MuJoCo 3.17 on Gym's own models before ours were written.
"""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiled import make
from runners import EVERY, GOLDEN, TASKS, at_rest, begun, compiled, play, pool_of

from envs import gaps

LEGS = {
    "halfcheetah": ("bthigh", "bshin", "bfoot", "fthigh", "fshin", "ffoot"),
    "walker2d": ("thigh", "leg", "foot", "thigh_left", "leg_left", "foot_left"),
}
MASSES = {  # kg: torso, then limb by limb
    ("halfcheetah", "sim"): (6.2502, 1.5435, 1.5874, 1.0954, 1.4381, 1.2008, 0.8845),
    ("halfcheetah", "big-thigh"): (2.5093, 4.9575, 0.6373, 0.4398, 4.6188, 0.4821, 0.3551),
    ("halfcheetah", "small-thigh"): (7.6817, 0.2371, 1.9510, 1.3463, 0.2209, 1.4759, 1.0871),
    ("halfcheetah", "long-torso"): (10.0082, 0.7950, 0.8177, 0.5642, 0.7407, 0.6185, 0.4556),
    ("walker2d", "sim"): (3.6652, *(4.0579, 2.7814, 3.1667) * 2),
    ("walker2d", "big-thigh"): (3.6652, *(18.326, 2.7814, 3.1667) * 2),
    ("walker2d", "small-thigh"): (3.6652, *(0.949, 2.7814, 3.1667) * 2),
}
TOTALS = {"big-thigh": 52.2133, "small-thigh": 17.4594}  # kg, of Walker2d
RANGES = {  # degrees
    "halfcheetah": np.degrees([(-0.52, 1.05), (-0.785, 0.785), (-0.4, 0.785), (-1, 0.7), (-1.2, 0.87), (-0.5, 0.5)]),
    "walker2d": np.array([(-150.0, 0.0), (-150.0, 0.0), (-45.0, 45.0)] * 2),
}
SPRINGS = {"halfcheetah": [240, 180, 120, 180, 120, 60], "walker2d": [0] * 6}  # N m/rad
DAMPINGS = {"halfcheetah": [6, 4.5, 3, 4.5, 3, 1.5], "walker2d": [0.1] * 6}  # N m s/rad
GEARS = {"halfcheetah": [120, 90, 60, 120, 60, 30], "walker2d": [100] * 6}  # N m
FRICTIONS = {"halfcheetah": [0.4] * 8, "walker2d": [0.9] * 6 + [1.9]}  # the left foot of Walker2d comes last
FIRST = {  # position and speed after one golden step
    "halfcheetah": (
        [0.008286, 0.000252, 0.000089, 0.168645, -0.232811, 0.086019, -0.131568, 0.385489, -0.297585],
        [0.218928, -0.190736, -0.08256, 4.052136, -5.049612, 2.152861, -3.064244, 9.405716, -7.969706],
    ),
    "walker2d": (
        [-0.000919, 1.250244, -0.003878, 0.003166, -0.015675, 0.016583, -0.006928, 0.008302, -0.055713],
        [-0.291227, 0.059848, -1.239668, 0.421143, -3.703145, 4.008265, -1.474696, 0.971034, -13.417318],
    ),
}
REWARD = {"halfcheetah": -0.096773, "walker2d": 0.882537}
LATER = {  # x, z, pitch after 20 golden steps of HalfCheetah, on the floor by then
    "sim": (0.00368, -0.08274, 0.02600),
    "gravity": (0.00132, -0.11261, 0.03314),
    "friction": (0.01372, -0.08770, 0.02622),
    "big-thigh": (-0.00555, -0.09171, 0.01911),
    "small-thigh": (0.01013, -0.07988, 0.02844),
    "broken-thigh": (0.00368, -0.08274, 0.02600),  # no limit is touched
    "flexible-thigh": (0.00368, -0.08274, 0.02600),
    "long-torso": (0.00750, -0.08882, 0.01961),
    "soft-feet": (0.02081, -0.11221, -0.01089),
}
THIGHS = {  # rad/s of the thighs after one golden step of Walker2d
    "sim": (0.42114, -1.47470),
    "gravity": (0.42114, -1.47470),  # in the air everything falls alike
    "friction": (0.42114, -1.47470),  # and touches nothing
    "big-thigh": (0.19733, -0.46396),
    "small-thigh": (0.67419, -2.41950),
    "broken-thigh": (0.30518, -1.39943),
    "flexible-thigh": (0.66851, -1.61383),
    "broken-thigh-range-only": (0.42114, -1.47470),
    "flexible-thigh-range-only": (0.42114, -1.47470),
}


@pytest.mark.parametrize("task", TASKS)
def test_time_and_solver_are_gyms(task):
    model, scene = compiled(task), TASKS[task].SCENE
    euler, runge_kutta = mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4
    step, substeps, integrator = {"halfcheetah": (0.01, 5, euler), "walker2d": (0.002, 4, runge_kutta)}[task]
    assert (model.opt.timestep, scene.substeps, model.opt.integrator) == (step, substeps, integrator)
    assert scene.control_dt == pytest.approx(step * substeps) and scene.episode_length == 1000
    assert model.opt.solver == mujoco.mjtSolver.mjSOL_NEWTON and model.opt.iterations == 100
    assert model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL and not model.opt.disableflags
    assert (model.nq, model.nv, model.nu) == (9, 9, 6)
    np.testing.assert_allclose(model.qpos0, at_rest(task).qpos)


@pytest.mark.parametrize(("task", "gap"), MASSES)
def test_masses(task, gap):
    model = compiled(task, gap)
    assert [model.body(i).name for i in range(1, model.nbody)] == ["torso", *LEGS[task]]
    np.testing.assert_allclose(model.body_mass[1:], MASSES[task, gap], atol=6e-5 if gap == "sim" else 6e-4)
    total = 14.0 if task == "halfcheetah" else TOTALS.get(gap, 23.6771)
    np.testing.assert_allclose(model.body_mass.sum(), total, atol=6e-5)


def pitch_inertia(model):
    """kg m^2 of the torso about y, at its centre of mass."""
    turned = np.zeros(9)
    mujoco.mju_quat2Mat(turned, model.body("torso").iquat)
    axes = turned.reshape(3, 3)
    return (axes @ np.diag(model.body("torso").inertia) @ axes.T)[1, 1]


def test_inertia_of_the_torso():
    """Of HalfCheetah the second principal moment, about an axis near z; the first is that about y."""
    for gap, about_z, about_y in (("sim", 0.886, 0.8971), ("long-torso", 12.915, 12.9259)):
        model = compiled("halfcheetah", gap)
        np.testing.assert_allclose(model.body("torso").inertia[1], about_z, atol=6e-4)
        np.testing.assert_allclose(pitch_inertia(model), about_y, atol=6e-5)
    # A rod of 2 * 0.2 m with round ends of 0.05 m. Cylinder 3.1416 kg: m (r^2 / 4 + (2h)^2 / 12) = 0.043852; both
    # ends 0.5236 kg: m (2 r^2 / 5 + h^2 + 3 h r / 4) = 0.025395.
    np.testing.assert_allclose(pitch_inertia(compiled("walker2d")), 0.069247, atol=1e-5)


def changed(task, gap):
    """What a gap makes of each table of the real system."""
    thighs = np.array(["thigh" in name for name in LEGS[task]])
    feet = np.array(["foot" in name for name in LEGS[task]])
    factor = {"broken": 0.5, "flexible": 2.0}.get(gap.split("-")[0], 1.0)
    torque = factor if task == "walker2d" and not gap.endswith("only") else 1.0
    return {
        "ranges": np.where(thighs[:, None], factor, 1.0) * RANGES[task],
        "springs": SPRINGS[task] * np.where(feet & (gap == "soft-feet"), 0.0, 1.0),
        "gears": GEARS[task] * np.where(thighs, torque, 1.0),
        "frictions": np.array(FRICTIONS[task]) * (0.3 if gap == "friction" else 1.0),
        "gravity": -9.81 * (2.0 if gap == "gravity" else 1.0),
    }


@pytest.mark.parametrize(("task", "gap"), EVERY)
def test_joints_motors_and_contacts(task, gap):
    model, wanted = compiled(task, gap), changed(task, gap)
    np.testing.assert_allclose(np.degrees(model.jnt_range[3:]), wanted["ranges"])
    np.testing.assert_allclose(model.jnt_stiffness, [0, 0, 0, *wanted["springs"]])
    np.testing.assert_allclose(model.dof_damping, [0, 0, 0, *DAMPINGS[task]])
    np.testing.assert_allclose(model.dof_armature, [0, 0, 0, *[{"halfcheetah": 0.1, "walker2d": 0.01}[task]] * 6])
    assert model.jnt_limited.tolist() == [0, 0, 0, *[1] * 6]
    np.testing.assert_allclose(model.actuator_gear[:, 0], wanted["gears"])
    np.testing.assert_allclose(model.actuator_ctrlrange, [[-1, 1]] * 6)
    np.testing.assert_allclose(model.pair_friction[:, :2], np.tile(wanted["frictions"], (2, 1)).T)
    assert (model.pair_dim == 3).all()
    np.testing.assert_allclose(model.opt.gravity, [0, 0, wanted["gravity"]])


SIZES = {  # radius and half length of the thighs, m
    ("halfcheetah", "sim"): [(0.046, 0.145), (0.046, 0.133)],
    ("halfcheetah", "big-thigh"): [(0.092, 0.29), (0.092, 0.266)],
    ("halfcheetah", "small-thigh"): [(0.023, 0.0725), (0.023, 0.0665)],
    ("walker2d", "sim"): [(0.05, 0.225)] * 2,
    ("walker2d", "big-thigh"): [(0.1, 0.225)] * 2,
    ("walker2d", "small-thigh"): [(0.025, 0.225)] * 2,
}


@pytest.mark.parametrize(("task", "gap"), SIZES)
def test_thighs(task, gap):
    model = compiled(task, gap)
    thighs = [name for name in LEGS[task] if "thigh" in name]
    np.testing.assert_allclose([model.geom(name).size[:2] for name in thighs], SIZES[task, gap])


def test_the_long_torso_overhangs():
    real, long = compiled("halfcheetah"), compiled("halfcheetah", "long-torso")
    np.testing.assert_allclose([real.geom("torso").size[1], long.geom("torso").size[1]], [0.5, 2.0])
    np.testing.assert_allclose(real.body_pos, long.body_pos)
    np.testing.assert_allclose(real.geom("head").pos, long.geom("head").pos)


@pytest.mark.parametrize("task", TASKS)
def test_everything_touches_the_floor_and_nothing_else(task):
    model = compiled(task)
    data = mujoco.MjData(model)
    data.qpos[:3] = [0.0, -1.0, 0.0]  # all of it under the floor
    data.qpos[3:] = 0.3  # and tangled up
    mujoco.mj_forward(model, data)
    names = {frozenset((model.geom(a).name, model.geom(b).name)) for a, b in data.contact.geom}
    own = {"torso", *LEGS[task], *(["head"] if task == "halfcheetah" else [])}
    assert names == {frozenset(("floor", name)) for name in own} and len(own) == len(FRICTIONS[task])


@pytest.fixture(scope="module", params=TASKS)
def golden(request):
    """(task, names of the real system and of all gaps but noise, states [T + 1, gaps] under the golden action)."""
    task, steps = request.param, {"halfcheetah": 20, "walker2d": 10}[request.param]
    names = [name for own, name in EVERY if own == task and name != "joint-noise"]
    env = make(task, "c")
    pool = pool_of(env, names)
    actions = jnp.broadcast_to(jnp.asarray(GOLDEN, jnp.float32), (steps, len(names), 6))
    return task, names, play(env, pool, begun(env, pool, at_rest(task)), actions)


@pytest.mark.heavy_after_first
def test_golden_steps_of_the_real_system(golden):
    task, names, states = golden
    i = names.index(gaps.SIM)
    qpos, qvel = FIRST[task]
    np.testing.assert_allclose(states.physics.qpos[1, i], qpos, atol=1e-6)
    np.testing.assert_allclose(states.physics.qvel[1, i], qvel, atol=1e-5)
    np.testing.assert_allclose(states.reward[1, i], REWARD[task], atol=1e-5)
    later = {"halfcheetah": LATER["sim"], "walker2d": (-0.10635, 1.24919, -0.45509)}[task]
    np.testing.assert_allclose(states.physics.qpos[-1, i, :3], later, atol=2e-5)


@pytest.mark.heavy
def test_golden_steps_of_every_gap(golden):
    task, names, states = golden
    if task == "halfcheetah":
        found, wanted = states.physics.qpos[20, :, :3], LATER
    else:
        found, wanted = states.physics.qvel[1][:, jnp.array([3, 6])], THIGHS
    assert set(names) == set(wanted)
    np.testing.assert_allclose(found, [wanted[name] for name in names], atol=2e-5)
