"""What tasks without an arm share: a table, in the solver that their contacts need."""

import mujoco

from envs.mujoco.parts import add_plane, empty_spec


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
