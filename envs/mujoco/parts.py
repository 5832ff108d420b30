"""What scenes are built of, a line each: an empty scene, geoms, joints and motors.

Geoms touch only in pairs that a task declares, so that the simulator's contact buffers stay small. `more`: any other
attribute that MuJoCo knows of the part, such as name, pos, mass, rgba.
"""

from typing import Any

import mujoco

NO_CONTACT = {"contype": 0, "conaffinity": 0}
INVISIBLE = [0.0, 0.0, 0.0, 0.0]


def empty_spec(timestep: float, integrator: mujoco.mjtIntegrator) -> mujoco.MjSpec:
    """A scene of nothing, for small models. timestep: of the physics, s."""
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = timestep, integrator
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    return spec


def stiff_spec(timestep: float, *, iterations: int, ls_iterations: int) -> mujoco.MjSpec:
    """The same for stiff servos and contacts: implicit steps, Newton's method."""
    spec = empty_spec(timestep, mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    option = spec.option
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations, option.ls_iterations = iterations, ls_iterations
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    return spec


def add_sphere(body: mujoco.MjsBody, radius: float, **more: Any) -> None:
    """A sphere of that radius, m."""
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], **more, **NO_CONTACT)


def add_capsule(body: mujoco.MjsBody, radius: float, half: float = 0.0, **more: Any) -> None:
    """A capsule along z of that radius and half length, m, without its ends; or between the points `fromto` [6]."""
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[radius, half, 0], **more, **NO_CONTACT)


def add_cylinder(body: mujoco.MjsBody, radius: float, half: float = 0.0, **more: Any) -> None:
    """A cylinder along z of that radius and half length, m; or between the points `fromto` [6]."""
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[radius, half, 0], **more, **NO_CONTACT)


def add_box(body: mujoco.MjsBody, half: Any, **more: Any) -> None:
    """A box with half of its sides along x, y, z, m."""
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=half, **more, **NO_CONTACT)


def add_plane(spec: mujoco.MjSpec, name: str, **more: Any) -> None:
    """A level plane without edges, which no viewer sees."""
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    spec.worldbody.add_geom(name=name, type=plane, size=[2, 2, 0.1], rgba=INVISIBLE, **more, **NO_CONTACT)


def add_pair(
    spec: mujoco.MjSpec, one: str, other: str, sliding: float, spin: float = 0.0, condim: int = 3, **more: Any
) -> None:
    """Lets two geoms touch. sliding: friction. spin: m, torsional friction, with a `condim` of 4."""
    friction = [sliding, sliding, spin, 1e-4, 1e-4]
    spec.add_pair(geomname1=one, geomname2=other, condim=condim, friction=friction, **more)


def add_slide(body: mujoco.MjsBody, axis: Any, **more: Any) -> mujoco.MjsJoint:
    """A joint along an axis [3]."""
    return body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, **more)


def add_hinge(body: mujoco.MjsBody, axis: Any, **more: Any) -> mujoco.MjsJoint:
    """A joint about an axis [3]."""
    return body.add_joint(type=mujoco.mjtJoint.mjJNT_HINGE, axis=axis, **more)


def add_servo(
    spec: mujoco.MjSpec, joint: str, stiffness: float, damping: float, most: float | None = None, name: str = ""
) -> None:
    """A servo that draws a joint to where it is sent, named like it by default. In N/m and N s/m, or N m/rad, ...

    most: N or N m, the force that it has.
    """
    servo = spec.add_actuator(name=name or joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    servo.gaintype, servo.biastype = mujoco.mjtGain.mjGAIN_FIXED, mujoco.mjtBias.mjBIAS_AFFINE
    servo.gainprm[0], servo.biasprm[:3] = stiffness, [0, -stiffness, -damping]
    if most is not None:
        servo.forcelimited, servo.forcerange = True, [-most, most]


def add_motor(
    spec: mujoco.MjSpec, name: str, target: str, gear: float, kind: mujoco.mjtTrn = mujoco.mjtTrn.mjTRN_JOINT
) -> None:
    """A motor that pulls at a joint or tendon with `gear` N or N m at a control of 1, its bound."""
    motor = spec.add_actuator(name=name, target=target, trntype=kind, gear=[gear, 0, 0, 0, 0, 0])
    motor.ctrllimited, motor.ctrlrange = True, [-1, 1]
