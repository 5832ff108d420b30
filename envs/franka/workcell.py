"""What the Franka tasks share: control period, empty scene, states at rest, and how a viewer sees the arm."""

import functools

import jax.numpy as jnp
import mujoco
import numpy as np

from envs.franka import arm
from envs.mujoco.parts import add_box, add_cylinder, empty_spec
from envs.mujoco.scene import Scene
from envs.mujoco.worlds import PhysicsState
from envs.types import Array

CONTROL_DT = 0.2  # s, 5 Hz as in the paper
RAMP = 0.1  # s: the servo's target moves linearly to its new value, then rests, so the arm has settled at the next step
# Exact commands, occasional sensor noise in raw units (paper, Appendix C).
TRAINING = {"obs_noise": 0.004, "obs_noise_prob": 0.3}
NOISE = {"obs_noise": [0.0, 0.004]}  # of the domain in which actuators and sensors differ
scene = functools.partial(Scene, control_dt=CONTROL_DT, ramp=RAMP, training=TRAINING, actuators=NOISE)
FLOOR = -0.75  # m: the arm stands on a table
_WHITE, _GREY, _DARK = [0.93, 0.94, 0.95, 1.0], [0.60, 0.62, 0.65, 1.0], [0.20, 0.21, 0.24, 1.0]


def new_spec(*, substeps: int, iterations: int, ls_iterations: int) -> mujoco.MjSpec:
    """An empty scene with the solver settings all tasks share; contacts only where a task declares a pair."""
    spec = empty_spec(CONTROL_DT / substeps, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    option = spec.option
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations, option.ls_iterations = iterations, ls_iterations
    # The robot compensates its own weight, which is the same as none, and MuJoCo's per-body compensation costs a
    # quarter of the simulation speed. A task gives weight to the objects that need it, see `push`.
    option.gravity = np.zeros(3)
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    return spec


def at_rest(joints: Array, others: Array, nv: int) -> PhysicsState:
    """A motionless state: arm at `joints` [7], the other coordinates at `others`, servo target where the arm is."""
    return PhysicsState(jnp.concatenate([joints, others]), jnp.zeros(nv), jnp.zeros(nv), joints)


def clip_joints(q: Array) -> Array:
    """Joint targets inside the position limits."""
    return jnp.clip(q, jnp.asarray(arm.Q_MIN, jnp.float32), jnp.asarray(arm.Q_MAX, jnp.float32))


def dress(spec: mujoco.MjSpec, *, table: tuple[float, float, float] | None = None) -> None:
    """The robot's pedestal and livery, and the legs of the table it stands on: x of the back and the front ones and
    how far they stand to the sides, m.
    """
    for body in spec.bodies:
        if body.name.startswith("link"):
            _paint_link(body)
    add_cylinder(spec.worldbody, 0.11, 0.015, pos=[0, 0, 0.015], rgba=_DARK)
    add_cylinder(spec.worldbody, 0.09, 0.09, pos=[0, 0, 0.09], rgba=_WHITE)
    half = -(FLOOR + 0.04) / 2
    for x in table[:2] if table else ():
        for y in (-table[2], table[2]) if table else ():
            add_box(spec.worldbody, [0.02, 0.02, half], pos=[x, y, -0.04 - half], rgba=_DARK)
    spec.stat.extent, spec.stat.center = 1.5, [0.3, 0, 0.3]


def _paint_link(body: mujoco.MjsBody) -> None:
    """White links with a grey ring at each joint; the first geom of a link is its capsule."""
    capsule = body.geoms[0]
    capsule.rgba = _WHITE
    radius = 1.06 * capsule.size[0]
    add_cylinder(body, radius, 0.35 * radius, rgba=_GREY, mass=0)
