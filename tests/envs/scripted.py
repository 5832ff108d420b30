"""Scripted controllers that solve the rigid tasks, and what a scene's time step costs in accuracy when they play.

A script plays episodes in C MuJoCo with a fine reference (a quarter of the scene's step, 100 iterations). From every
state of the reference one control period is repeated with the settings under test: their error is the difference in the
nail's height, the puck's place or the leg's tip after 0.2 s of the same command. Restarting at every step keeps the
chaos of contacts from growing one early micrometre into centimetres. docs/physics.md has the numbers.
"""

from collections.abc import Callable
from typing import NamedTuple

import c_reference
import jax
import jax.numpy as jnp
import numpy as np

from envs.franka import arm, hammer, insert, push
from envs.mujoco.scene import Scene
from envs.mujoco.worlds import PhysicsState
from envs.types import Array

REFERENCE_REFINE, REFERENCE_ITERATIONS = 4, 100
MOVING = 1.0  # mm: control periods in which the object moved less say little about relative error


class Probe(NamedTuple):
    """script(params, state, t) -> action in [-1, 1]; place(params, state) -> [k] m, what the task is about."""

    scene: Scene
    script: Callable[[Array, PhysicsState, int], Array]
    place: Callable[[Array, PhysicsState], Array]


class Step(NamedTuple):
    """One control period of the reference, between two states."""

    theta: dict[str, float]
    before: PhysicsState
    action: Array
    after: PhysicsState


class Errors(NamedTuple):
    """What a setting does in one control period, in mm and fractions.

    travel: mean of the reference's moving periods. mean, p95, worst: error in them. relative: sum of errors over sum of
    travels. bias: the same with the error's component along the travel, signed: positive = moves too far.
    """

    travel: float
    mean: float
    p95: float
    worst: float
    relative: float
    bias: float


def drive_nail(params: Array, state: PhysicsState, t: int) -> Array:
    """[3]: swing the hammer over the nail, then press it down, lifting it for a blow at every fourth step."""
    joints, obs = state.qpos[: arm.N_JOINTS], hammer.observe(params, state)
    tool = jnp.asarray(hammer.TOOL, jnp.float32)
    turn = arm.forward(joints, tool).rotation
    jac = arm.jacobian(joints, tool)[jnp.array([0, 2, 4])][:, hammer.JOINTS]
    across = obs[10] - obs[0]
    aligned = jnp.clip((0.03 - jnp.abs(across)) / 0.02, 0.0, 1.0)
    hover = jnp.maximum(obs[9] + 0.05 - obs[2], 0.0)
    down = jnp.where(t % 4 == 3, 0.06, -0.08)
    upright = arm.rotation_error(turn, jnp.asarray(arm.DOWN, jnp.float32))[1]
    move = jnp.stack([across, aligned * down + (1 - aligned) * hover, upright])
    steps = jnp.linalg.solve(jac.T @ jac + 1e-4 * jnp.eye(3), jac.T @ move) / hammer.STEP
    return steps / jnp.maximum(1.0, jnp.abs(steps).max())


def push_puck(params: Array, state: PhysicsState, t: int) -> Array:
    """[2]: line up behind the puck, then push it to the middle of the goal."""
    obs = push.observe(params, state)
    hand, puck = obs[:2], obs[2:]
    ahead = jnp.where(jnp.abs(puck[1] - hand[1]) > 0.01, 0.0, push.EDGE - push.TOLERANCE / 2 - puck[0])
    return jnp.clip(jnp.stack([ahead, puck[1] - hand[1]]) / push.STEP, -1.0, 1.0)


def insert_leg(params: Array, state: PhysicsState, t: int) -> Array:
    """[3]: stay 5 mm above the table top until the leg is over the hole, then go down."""
    obs = insert.observe(params, state)
    tip, goal = obs[3:6], obs[6:9]
    off = jnp.linalg.norm(goal[:2] - tip[:2])
    height = jnp.where(off > 0.002, insert.TOP + 0.005, goal[2])
    return jnp.clip((goal.at[2].set(height) - tip) / insert.STEP, -1.0, 1.0)


PROBES = {
    "hammer": Probe(hammer.SCENE, drive_nail, lambda params, state: hammer.observe(params, state)[9:10]),
    "push": Probe(push.SCENE, push_puck, lambda params, state: push.observe(params, state)[2:4]),
    "insert": Probe(insert.SCENE, insert_leg, lambda params, state: insert.observe(params, state)[3:6]),
}


def sample_theta(scene: Scene, rng: np.random.Generator) -> dict[str, float]:
    """Domain parameters by name, uniform in the scene's ranges."""
    return {p.name: float(rng.uniform(p.low, p.high)) for p in scene.parameters}


def play_script(
    probe: Probe, theta: dict[str, float], start: PhysicsState, *, steps: int, refine: int = 1, iterations: int = 0
) -> list[Step]:
    """An episode of the scripted controller in C MuJoCo. refine, iterations: see `c_reference.play`."""
    script, params = jax.jit(probe.script), as_params(theta)
    state, episode = start, []
    for t in range(steps):
        action = script(params, state, t)
        after = c_reference.play(probe.scene, theta, state, [action], refine=refine, iterations=iterations)[0]
        episode.append(Step(theta, state, action, after))
        state = after
    return episode


def reference_steps(probe: Probe, *, thetas: int, steps: int, seed: int) -> list[Step]:
    """Control periods of the fine reference, over random domain parameters and starts."""
    rng, initial = np.random.default_rng(seed), jax.jit(probe.scene.initial)
    collected = []
    for key in jax.random.split(jax.random.key(seed), thetas):
        theta = sample_theta(probe.scene, rng)
        start = initial(as_params(theta), key)
        collected += play_script(
            probe, theta, start, steps=steps, refine=REFERENCE_REFINE, iterations=REFERENCE_ITERATIONS
        )
    return collected


def measure(probe: Probe, reference: list[Step], *, substeps: int, iterations: int) -> Errors:
    """Repeats every control period of the reference with the settings under test."""
    scene, place = probe.scene._replace(substeps=substeps), jax.jit(probe.place)
    travels, errors = [], []
    for step in reference:
        tested = c_reference.play(scene, step.theta, step.before, [step.action], iterations=iterations)[0]
        before, after, reached = (place(as_params(step.theta), s) for s in (step.before, step.after, tested))
        travels.append(1000 * np.asarray(after - before))
        errors.append(1000 * np.asarray(reached - after))
    return summarise(np.array(travels), np.array(errors))


def summarise(travels: np.ndarray, errors: np.ndarray) -> Errors:
    """travels, errors: [n, k] mm per control period."""
    distance = np.linalg.norm(travels, axis=1)
    moving = distance > MOVING
    if not moving.any():
        return Errors(0.0, 0.0, 0.0, float(np.linalg.norm(errors, axis=1).max()), 0.0, 0.0)
    travels, errors, distance = travels[moving], errors[moving], distance[moving]
    size = np.linalg.norm(errors, axis=1)
    along = (errors * travels).sum(1) / distance
    total = distance.sum()
    values = distance.mean(), size.mean(), np.percentile(size, 95), size.max(), size.sum() / total, along.sum() / total
    return Errors(*map(float, values))


def as_params(theta: dict[str, float]) -> Array:
    """World.params of a theta in the scene's order."""
    return jnp.asarray(list(theta.values()), jnp.float32)
