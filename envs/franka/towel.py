"""Pushing a towel: a rigid puck in simulation, in reality a cloth that bends, buckles and hangs over the table's edge.

The cloth is a square lattice of points, each on three slides, joined by springs along the threads, weak ones across
(shear) and very weak ones over two meshes (bending). What is pushed together rises. It does not touch itself.
"""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.franka import arm, push, soft
from envs.franka.arm import at_rest
from envs.mujoco.parts import INVISIBLE, add_slide, add_sphere
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

N = 6  # points along a side
SIDE = 0.08  # m: a small towel, folded
MESH = SIDE / (N - 1)
RADIUS = 0.007  # m, of the points: half the thickness
CREASE = 0.006  # m: how high points lie at the start, at most, as in a towel that was dropped
FELT = 0.005  # m: fingers feel the cloth between two points, which a finger would slip through
# N/m by how many meshes a spring spans; explicit springs are stable here up to 30 N/m at 5 ms. Damping: s.
STIFFNESS = {(1, 0): 20.0, (0, 1): 20.0, (1, 1): 3.0, (1, -1): 3.0, (2, 0): 0.1, (0, 2): 0.1}
DAMPING_TIME = 0.003
ITERATIONS = 8
_GRID = (np.arange(N) - (N - 1) / 2) * MESH
# [N * N, 3] m, the points of the flat towel around its middle.
POINTS = np.stack([*np.meshgrid(_GRID, _GRID, indexing="ij"), np.full((N, N), RADIUS)], axis=-1).reshape(-1, 3)
NV = arm.N_JOINTS + POINTS.size


def build(theta: dict[str, float]) -> mujoco.MjSpec:
    """The real scene for one theta. Coordinates of a point are its displacement from `POINTS`."""
    spec = soft.stage(theta, height=push.HEIGHT, iterations=ITERATIONS)
    for i, place in enumerate(POINTS):
        body = spec.worldbody.add_body(name=f"towel{i}", pos=place)
        for axis in np.eye(3):
            add_slide(body, axis)
        add_sphere(body, RADIUS, name=f"towel{i}", mass=theta["object_mass"] / len(POINTS), rgba=[0.8, 0.3, 0.25, 1])
        body.add_site(name=f"towel{i}", rgba=INVISIBLE)
        soft.touch(spec, f"towel{i}", theta, fingers=FELT)
    for span, stiffness in STIFFNESS.items():
        _add_springs(spec, span, stiffness)
    return spec


def initial(params: Array, key: Key) -> PhysicsState:
    """The hand near the base, the towel spread where theta says, with creases."""
    key_hand, key_creases = jax.random.split(key)
    points = _lie(params[:2] + jnp.array([push.TABLE_ORIGIN, 0.0])).reshape(-1, 3)
    points = points.at[:, 2].set(jax.random.uniform(key_creases, (len(POINTS),), maxval=CREASE))
    return at_rest(push.ready(key_hand), points.ravel(), NV)


def dress(spec: mujoco.MjSpec) -> None:
    """A striped cloth of splines through the points."""
    spline = _spline(fine=4)
    m = len(spline)
    weights = np.einsum("ai,bj->abij", spline, spline).reshape(m * m, N * N)
    index = np.arange(m * m).reshape(m, m)
    a, b, c, d = (x.ravel() for x in (index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]))
    top = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    rim = np.concatenate([index[:-1, 0], index[-1, :-1], index[:0:-1, -1], index[0, :0:-1]])
    after, under = np.roll(rim, -1), m * m
    side = np.concatenate([np.stack([rim, rim + under, after], 1), np.stack([after, rim + under, after + under], 1)])
    faces = np.concatenate([top, top[:, ::-1] + under, side])
    at = np.linspace(0, 1, m)
    texture = np.stack(np.meshgrid(at, at, indexing="ij"), axis=-1).reshape(-1, 2)
    vertices, weights, texture = (np.concatenate([x, x]) for x in (weights @ POINTS, weights, texture))  # both faces
    bones = [(f"towel{i}", place) for i, place in enumerate(POINTS)]
    look = {"name": "towel", "texture": texture, "repeat": (4.0, 0.01), "inflate": 0.004}
    soft.add_skin(spec, vertices, faces, weights, bones, colours=((0.80, 0.27, 0.22), (0.95, 0.93, 0.9)), **look)
    for tendon in spec.tendons:
        tendon.rgba = INVISIBLE


def _add_springs(spec: mujoco.MjSpec, span: tuple[int, int], stiffness: float) -> None:
    """A spring from every point to the one that lies `span` meshes from it."""
    rest = MESH * float(np.hypot(*span))
    for i, j in np.ndindex(N, N):
        k, m = i + span[0], j + span[1]
        if not (k < N and 0 <= m < N):
            continue
        spring = spec.add_tendon(stiffness=stiffness, damping=DAMPING_TIME * stiffness, springlength=[rest, rest])
        spring.wrap_site(f"towel{i * N + j}")
        spring.wrap_site(f"towel{k * N + m}")


def _place(qpos: Array) -> Array:
    return qpos[arm.N_JOINTS :].reshape(-1, 3)[:, :2].mean(0)


def _lie(xy: Array) -> Array:
    return jnp.tile(jnp.append(xy, 0.0), len(POINTS))


def _spline(*, fine: int) -> np.ndarray:
    """[(N - 1) * fine + 1, N] weights of a Catmull-Rom spline through N values, straight at its ends."""
    rows = []
    for x in np.arange((N - 1) * fine + 1) / fine:
        i = min(int(x), N - 2)
        t = x - i
        four = 0.5 * np.array([-t + 2 * t**2 - t**3, 2 - 5 * t**2 + 3 * t**3, t + 4 * t**2 - 3 * t**3, t**3 - t**2])
        row = np.zeros(N + 2)
        row[i : i + 4] = four
        row[1:3] += row[0] * np.array([2.0, -1.0])
        row[-3:-1] += row[-1] * np.array([-1.0, 2.0])
        rows.append(row[1:-1])
    return np.array(rows)


SCENE = soft.simulated("push-towel", mass=0.06)
REAL = soft.real_scenes(
    SCENE, "towel", height=push.HEIGHT, build=build, initial=initial, place=_place, lie=_lie, dress=dress
)
