"""Cheetah-run of the DeepMind Control Suite, one of SGFT's sim-to-sim tasks (section 6.3): run at up to 10 m/s.

Facts from dm_control (suite/cheetah, Tassa et al. 2018): frames of 10 ms, 1,000 to an episode that begins at rest and
never ends early. Beside `envs.locomotion.halfcheetah` the ground has more grip, links touch each other, legs swing
further and the front one is weaker. An action lasts four frames and earns the rewards of all, as in Du et al. The real
cheetah has other masses, see `envs.control.suite`.
"""

import functools
from itertools import combinations
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.control.suite import runner
from envs.locomotion import halfcheetah, planar
from envs.locomotion.halfcheetah import ARMATURE, HEAD, HEIGHT, MASS, TORSO
from envs.locomotion.planar import NV, Capsule
from envs.mujoco.parts import add_pair
from envs.mujoco.scene import Scene
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key

FRAME, REPEAT = 0.01, 4  # s; frames per action
CONTROL_DT = FRAME * REPEAT
ALIKE = 6.3603134  # kg of every link in Du et al., the torso's in MuJoCo of their day
GROUND, LINKS_TOUCH = 1.0, 0.4  # friction of feet on the ground, and of link on link
SPEED = 10.0  # m/s that earn all
REST = 200  # frames in which a start comes to rest
_STARTS = 256
# degrees of a joint; N m at full action; degrees of the capsule about +y
_OTHERWISE = {
    "bthigh": ((-30, 60), 120, -218),
    "bshin": ((-50, 50), 90, -116),
    "bfoot": ((-230, 50), 60, -15),
    "fthigh": ((-57, 0.4), 90, 30),
    "fshin": ((-70, 50), 60, -34),
    "ffoot": ((-28, 28), 30, -34),
}
LINKS = tuple(
    link._replace(
        range=tuple(np.radians(_OTHERWISE[link.name][0])),
        gear=float(_OTHERWISE[link.name][1]),
        capsule=link.capsule._replace(turn=np.radians(_OTHERWISE[link.name][2])),
    )
    for link in halfcheetah.LINKS
)
TRUNK: dict[str, Capsule] = {"torso": TORSO, "head": HEAD._replace(turn=np.radians(50))}


def draw() -> mujoco.MjSpec:
    """The suite's scene."""
    euler = mujoco.mjtIntegrator.mjINT_EULER
    spec, torso = planar.stage(timestep=FRAME, integrator=euler, gravity=1.0, height=HEIGHT, ref=0.0)
    volume = sum(capsule.volume for capsule in (*TRUNK.values(), *(link.capsule for link in LINKS)))
    geom: dict[str, Any] = {"density": MASS / volume, "friction": GROUND}
    for name, capsule in TRUNK.items():
        planar.add_capsule(spec, torso, name, capsule, **geom)
    for link in LINKS:
        planar.add_link(spec, link, axis=1, armature=ARMATURE, geom=geom)
    parents = {link.name: link.parent for link in LINKS} | {"torso": "", "head": ""}
    for one, other in combinations(parents, 2):
        bodies = {"torso" if name == "head" else name for name in (one, other)}
        if len(bodies) == 2 and not bodies & {parents[name] for name in bodies}:
            add_pair(spec, one, other, LINKS_TOUCH)
    return spec


@functools.cache
def _starts() -> tuple[np.ndarray, np.ndarray]:
    """Positions and speeds [starts, 9] that cheetahs with the suite's masses come to rest in, from random joints."""
    model, rng, rows = draw().compile(), np.random.default_rng(0), []
    data, limited = mujoco.MjData(model), model.jnt_limited.astype(bool)
    for _ in range(_STARTS):
        mujoco.mj_resetData(model, data)
        data.qpos[limited] = rng.uniform(*model.jnt_range[limited].T)
        mujoco.mj_step(model, data, REST)
        rows.append(np.stack([data.qpos, data.qvel]))
    positions, speeds = np.stack(rows, axis=1)
    return positions, speeds


def initial(params: Array, key: Key) -> PhysicsState:
    """At rest, in one of 256 postures that random ones end in."""
    which = jax.random.randint(key, (), 0, _STARTS)
    return planar.start(*(jnp.asarray(rows, jnp.float32)[which] for rows in _starts()))


def observe(params: Array, state: PhysicsState) -> Array:
    """[17]: everything but x."""
    return jnp.concatenate([state.qpos[1:], state.qvel])


def frame_reward(masses: Array, obs: Array) -> Array:
    """[] from 0 to 1: the whole moves ahead. masses: [7] kg."""
    speed = planar.speed(tuple(TRUNK.values()), LINKS, 1, masses, obs[1 : NV - 1], obs[NV - 1 :])
    return jnp.clip(speed / SPEED, 0.0, 1.0)


def scene(name: str = "cheetah-run", **masses: Any) -> Scene:
    """The task. masses: see `envs.control.suite.runner`."""
    return runner(
        draw,
        frame_reward,
        frames=REPEAT,
        observe=observe,
        alike=ALIKE,
        name=name,
        observation=planar.OBSERVATION,
        episode_length=250,
        control_dt=CONTROL_DT,
        substeps=REPEAT,
        initial=initial,
        settled=planar.settled,
        view=planar.VIEW,
        **masses,
    )


SCENE = scene()
