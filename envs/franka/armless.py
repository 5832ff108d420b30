"""What tasks without an arm share: a hand on slides, boxes and a table, in the solver that their contacts need."""

import mujoco

from envs.franka.arm import NO_CONTACT


def table_spec(timestep: float) -> mujoco.MjSpec:
    """A scene that holds a table without edges. timestep: of the physics, s."""
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep, option.integrator = timestep, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver, option.jacobian = mujoco.mjtSolver.mjSOL_NEWTON, mujoco.mjtJacobian.mjJAC_DENSE
    # With pyramids for friction as few iterations leave so large an error that a sliding cube trips over its edge.
    option.cone, option.iterations, option.ls_iterations = mujoco.mjtCone.mjCONE_ELLIPTIC, 6, 8
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    spec.worldbody.add_geom(
        name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[2, 2, 0.1], rgba=[0, 0, 0, 0], **NO_CONTACT
    )
    return spec


def add_servo(spec: mujoco.MjSpec, joint: str, stiffness: float, damping: float) -> mujoco.MjsActuator:
    """A servo that draws the joint to where it is sent, named like it. In N/m and N s/m."""
    servo = spec.add_actuator(
        name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT, gaintype=mujoco.mjtGain.mjGAIN_FIXED,
        biastype=mujoco.mjtBias.mjBIAS_AFFINE,
    )  # fmt: skip
    servo.gainprm[0], servo.biasprm[:3] = stiffness, [0, -stiffness, -damping]
    return servo


def add_box(body: mujoco.MjsBody, name: str, half: tuple[float, float, float], **own: object) -> None:
    """A box that touches only what a pair says; a name of "" is none. half: m."""
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_BOX, size=half, **own, **NO_CONTACT)
