"""Kinematics against MuJoCo's, and inverse kinematics over the workspaces of the Cartesian tasks."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs.franka import arm, insert, push
from envs.franka.arm import new_spec

TOOLS = (None, [0.02, -0.03, 0.25])


def angles(n):
    return np.random.default_rng(0).uniform(arm.Q_MIN, arm.Q_MAX, (n, arm.N_JOINTS)).astype(np.float32)


@pytest.fixture(scope="module")
def mujoco_arm():
    """The arm with a site at each tool point, oriented like the hand."""
    spec = new_spec(substeps=40, iterations=1, ls_iterations=1)
    link = arm.add_arm(spec)
    for i, tool in enumerate(TOOLS):
        link.add_site(name=f"tool{i}", pos=[0, 0, arm.TCP] if tool is None else tool, quat=arm.HAND_TURN)
    model = spec.compile()
    return model, mujoco.MjData(model)


def at(mujoco_arm, q, site):
    """Position, rotation matrix and Jacobian of a site."""
    model, data = mujoco_arm
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    jac = np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, jac[:3], jac[3:], model.site(site).id)
    return data.site(site).xpos.copy(), data.site(site).xmat.reshape(3, 3).copy(), jac


@pytest.mark.parametrize("i", [0, 1])
def test_forward_and_jacobian_are_mujocos(mujoco_arm, i):
    tool = None if TOOLS[i] is None else jnp.array(TOOLS[i])
    forward = jax.jit(lambda q: arm.forward(q, tool))
    jacobian = jax.jit(lambda q: arm.jacobian(q, tool))
    for q in angles(50):
        position, rotation, jac = at(mujoco_arm, q, f"tool{i}")
        pose = forward(q)
        np.testing.assert_allclose(pose.position, position, atol=3e-6)
        np.testing.assert_allclose(pose.rotation, rotation, atol=3e-6)
        np.testing.assert_allclose(jacobian(q), jac, atol=3e-6)


def test_gripper_points_down_at_home():
    """Upper arm up, forearm level, hand down: lengths of the manufacturer's table add up."""
    pose = arm.forward(jnp.asarray(arm.Q_HOME, jnp.float32))
    np.testing.assert_allclose(pose.rotation, arm.DOWN, atol=1e-6)
    # x: elbow offset 0.0825 + forearm 0.384 + wrist offset 0.088
    # z: 0.333 + 0.316 + elbow offset 0.0825 - flange 0.107 - fingers 0.1034
    np.testing.assert_allclose(pose.position, [0.5545, 0.0, 0.5211], atol=1e-4)


def test_rotation_error_is_the_small_rotation_vector():
    c, s = np.cos(0.01), np.sin(0.01)
    turn = jnp.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])  # 0.01 rad about the base's z
    current = jnp.asarray(arm.DOWN, jnp.float32)
    np.testing.assert_allclose(arm.rotation_error(current, turn @ current), [0, 0, 0.01], atol=1e-6)


def walk(target, tip, q, actions, goal):
    """Largest distance (m) of the tip from where each of `actions` should have brought it."""
    worst = 0.0
    for action in actions:
        wanted = goal(np.asarray(tip(q)), action)
        q = target(q, jnp.asarray(action, jnp.float32))
        worst = max(worst, float(np.abs(tip(q) - wanted).max()))
    return worst


@pytest.mark.parametrize("seed", range(4))
def test_pushing_steps_are_exact(seed):
    """From random starts ahead to the edge, within 0.3 mm. Beyond 0.78 m the arm is too short."""
    tip = jax.jit(lambda q: arm.forward(q).position)
    origin = np.array([push.TABLE_ORIGIN, 0.0])

    def goal(here, action):
        return np.append(np.clip(here[:2] - origin + push.STEP * action, *push.WORKSPACE) + origin, push.HEIGHT)

    params = jnp.array([p.nominal for p in push.PARAMETERS])
    q = push.initial(params, jax.random.key(seed)).qpos[: arm.N_JOINTS]
    sideways = np.random.default_rng(seed).uniform(-1, 1, (12, 1))
    ahead = np.concatenate([np.full((12, 1), 0.8), 0.3 * sideways], 1)
    assert walk(jax.jit(push.target), tip, q, ahead, goal) < 3e-4


@pytest.mark.parametrize("corner", np.stack(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), -1).reshape(-1, 3))
def test_insertion_reaches_its_whole_workspace(corner):
    """From a random start at full steps into every corner of the box, within 0.3 mm."""
    tip = jax.jit(insert._tip)

    def goal(here, action):
        return np.clip(here + insert.STEP * action, *insert.WORKSPACE)

    params = jnp.array([p.nominal for p in insert.PARAMETERS])
    q = insert.initial(params, jax.random.key(1)).qpos[: arm.N_JOINTS]
    assert walk(jax.jit(insert.target), tip, q, [corner] * 20, goal) < 3e-4


def test_solve_stays_inside_the_joint_limits():
    far = arm.Pose(jnp.array([1.5, 0.0, 0.1]), jnp.asarray(arm.DOWN, jnp.float32))
    q = arm.solve(jnp.asarray(arm.Q_HOME, jnp.float32), far, iterations=30)
    assert ((q >= arm.Q_MIN - 1e-6) & (q <= arm.Q_MAX + 1e-6)).all()
