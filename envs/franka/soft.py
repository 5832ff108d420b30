"""What the deformable objects of the pushing tasks share: a stage with gravity and a table that ends, and its events.

Their simulator is `push` with a rigid puck, as in the paper (section 6.2), about as large as they; cloth and ball are
other scenes of the same task, with its observations, actions, parameters, reward and success. The place of an object is
what a camera would report of it: the mean of a cloth's points, the middle of a ball. Objects are bodies on joints and
springs, which all engines step, though MJX's own code damps the towel's threads otherwise; it has no flexes
(docs/physics.md).
"""

import functools
from collections.abc import Callable, Sequence

import mujoco
import numpy as np

from envs.base import Parameter
from envs.franka import arm, push
from envs.mujoco.parts import INVISIBLE, add_box, add_capsule
from envs.mujoco.scene import Scene, View
from envs.mujoco.worlds import PhysicsState
from envs.types import Array

TABLE = "table"
TIP = 0.009  # m above the table: the middle of the round ends of the fingertips
NEAREST_FARTHEST = 0.20, 0.30  # m, table frame: where objects lie at the start, clear of the hand
# How much stiffer friction is than the contact that it belongs to. At 1 it gives way slowly: a towel that is pushed
# together creeps on for seconds after the hand has stopped, a ball rolls over the edge by itself.
_GRIP = 10.0
_SPIN = 0.001  # m, torsional friction on the table of what resists rolling
_THICK = 0.1  # m, half of the table's: nothing passes through


def simulated(name: str, *, mass: float) -> Scene:
    """The scene to pretrain in: pushing a puck of that mass, kg, which leaves room for the larger real object."""
    ranges = {"object_x": (0.25, *NEAREST_FARTHEST), "object_mass": (mass, mass, mass)}
    parameters = tuple(Parameter(p.name, p.unit, *ranges.get(p.name, p[2:5]), *p[5:]) for p in push.PARAMETERS)
    # From the front, all of the edge in sight: the hand, which comes from behind, hides nothing of what it pushes.
    view = View((0.64, 0.0, 0.04), 0.64, 172.0, -30.0, arm.FLOOR)
    return push.SCENE._replace(name=name, parameters=parameters, view=view)


def stage(theta: dict[str, float], *, height: float, iterations: int) -> mujoco.MjSpec:
    """Arm, fingers, a table with a physical edge, and gravity, which the arm compensates.

    height: m, of the hand's tool centre point; the fingers reach down from there to just above the table.
    """
    spec = arm.new_spec(substeps=push.SUBSTEPS, iterations=iterations, ls_iterations=iterations + 2)
    spec.option.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE  # a point or a pad touches nothing but its neighbours
    spec.option.gravity = [0, 0, -push.GRAVITY]
    spec.option.impratio = _GRIP
    link = arm.add_arm(spec, stiffness=theta["servo_stiffness"])
    for side, name in push.FINGERS.items():
        x, y = arm.across(0.0, side * push.FINGER_GAP / 2)
        ends = [x, y, arm.FLANGE + 0.07, x, y, arm.TCP + height - TIP]
        add_capsule(link, push.FINGER_RADIUS, name=name, fromto=ends, mass=0.015, rgba=[0.1, 0.1, 0.12, 1])
    for body in spec.bodies:
        body.gravcomp = float(body.name.startswith("link"))
    half = (push.TABLE_ORIGIN + push.EDGE + 0.25) / 2
    size, place = [half, push.TABLE_HALF_WIDTH, _THICK], [half - 0.25, 0, -_THICK]
    add_box(spec.worldbody, size, name=TABLE, pos=place, rgba=INVISIBLE)
    push.add_scenery(spec)
    return spec


def touch(
    spec: mujoco.MjSpec, geom: str, theta: dict[str, float], *, fingers: float = 0.0, rolling: float = 0.0
) -> None:
    """Lets a geom of the object touch table and fingers.

    fingers: m, the distance at which it feels them already. rolling: m, its resistance to rolling on the table.
    """
    friction = [theta["table_friction"]] * 2 + [_SPIN, rolling, rolling]  # MuJoCo ignores the last three at condim 3
    spec.add_pair(geomname1=TABLE, geomname2=geom, condim=6 if rolling else 3, friction=friction)
    friction = [theta["finger_friction"]] * 2 + [0.0, 0.0, 0.0]
    for finger in push.FINGERS.values():
        pair = spec.add_pair(geomname1=finger, geomname2=geom, condim=3, friction=friction, margin=fingers)
        pair.solimp = push.RUBBER


def real_scenes(
    simulated: Scene,
    variant: str,
    *,
    height: float,
    build: Callable[[dict[str, float]], mujoco.MjSpec],
    initial: Callable[..., PhysicsState],
    place: Callable[[Array], Array],
    lie: Callable[[Array], Array],
    dress: Callable[[mujoco.MjSpec], None],
) -> dict[str, Scene]:
    """The real counterpart of a simulated scene, by name.

    place, lie: see `push.falling`; it lies undeformed. dress(spec): adds the skin that a viewer sees. height: m, of the
    hand above the table.
    """

    def dressed(spec: mujoco.MjSpec) -> None:
        simulated.dress(spec)
        dress(spec)

    real = simulated._replace(
        variant=variant,
        build=build,
        initial=initial,
        settled=None,  # four numbers do not tell how a soft body lies
        target=functools.partial(push.target, height=height),
        observe=lambda params, state: push.seen(state.qpos, place(state.qpos)),
        event=push.falling(place, lie),
        dress=dressed,
    )
    return {variant: real}


def add_skin(
    spec: mujoco.MjSpec,
    vertices: np.ndarray,
    faces: np.ndarray,
    weights: np.ndarray,
    bones: Sequence[tuple[str, np.ndarray]],
    *,
    texture: np.ndarray,
    name: str,
    repeat: Sequence[float],
    colours: Sequence[Sequence[float]],
    inflate: float = 0.0,
) -> None:
    """A surface that follows the bodies of an object, in place of their geoms and springs: for the eye only.

    vertices: [v, 3] m at rest. faces: [f, 3]. weights: [v, bones], rows sum to 1. bones: body name and place [3] at
    rest. texture: [v, 2] of a checkerboard of two `colours` [3], `repeat` [2] times across and along. name: of its
    material. inflate: m, along the normals.
    """
    names = {name for name, _ in bones}
    for body in spec.bodies:
        for geom in body.geoms if body.name in names else ():
            geom.rgba = INVISIBLE
    look = {"type": mujoco.mjtTexture.mjTEXTURE_2D, "builtin": mujoco.mjtBuiltin.mjBUILTIN_CHECKER}
    spec.add_texture(name=name, rgb1=list(colours[0]), rgb2=list(colours[1]), width=128, height=128, **look)
    material = spec.add_material(name=name, texrepeat=list(repeat), specular=0.1, shininess=0.1)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name
    moved = [np.flatnonzero(column) for column in weights.T]
    spec.add_skin(
        vert=vertices.ravel().tolist(),
        face=faces.ravel().tolist(),
        texcoord=texture.ravel().tolist(),
        bodyname=[name for name, _ in bones],
        bindpos=np.concatenate([place for _, place in bones]).tolist(),
        bindquat=np.tile([1.0, 0.0, 0.0, 0.0], len(bones)).tolist(),
        vertid=[index.tolist() for index in moved],
        vertweight=[weights[index, i].tolist() for i, index in enumerate(moved)],
        material=name,
        inflate=inflate,
    )
