"""What tasks without an arm share: a table, in the solver that their contacts need."""

import functools

import mujoco

from envs.mujoco.parts import add_plane, empty_spec
from envs.mujoco.scene import Scene

# Steps of a hand; joints or objects that are faster than 500 m/s or rad/s have exploded.
scene = functools.partial(Scene, cartesian=True, training={"obs_noise": 0.002, "obs_noise_prob": 0.3}, max_speed=500.0)


def table_spec(timestep: float) -> mujoco.MjSpec:
    """A scene that holds a table without edges. timestep: of the physics, s."""
    spec = empty_spec(timestep, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    option = spec.option
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    # With pyramids for friction as few iterations leave so large an error that a sliding cube trips over its edge.
    option.cone, option.iterations, option.ls_iterations = mujoco.mjtCone.mjCONE_ELLIPTIC, 6, 8
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    add_plane(spec, "table")
    return spec
