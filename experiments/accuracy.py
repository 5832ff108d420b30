"""How much a scene's time step and solver settings cost in accuracy, in millimetres of what the task is about.

A scripted controller plays episodes in C MuJoCo with a fine reference (a quarter of the scene's step, 100 iterations).
From every state of the reference one control period is repeated with the settings under test: their error is the
difference in the nail's height, the puck's place or the leg's tip after 0.2 s of the same command. Restarting at every
step keeps the chaos of contacts from growing one early micrometre into centimetres.

    python -m experiments.accuracy --task hammer
    python -m experiments.accuracy --task hammer --substeps 25 32 40 80 --iterations 1 2 4
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from envs.franka import arm, hammer, insert, kinematics, push
from envs.mujoco import host
from envs.mujoco.scene import Scene
from envs.mujoco.worlds import PhysicsState
from experiments.cli import run_main
from sgft_jax.types import Array

REFERENCE_REFINE, REFERENCE_ITERATIONS = 4, 100
MOVING = 1.0  # mm: control periods in which the object moved less say little about relative error


@dataclass(frozen=True)
class AccuracyConfig:
    """task: which scene. thetas: domain parameters drawn from its ranges. steps: control steps of each episode.

    substeps: physics steps per control period to test, empty for the scene's own; the reference takes four times the
    most. iterations: solver iterations to test, 0 for the scene's own.
    """

    task: Literal["push", "hammer", "insert"] = "hammer"
    thetas: int = 20
    steps: int = 25
    substeps: tuple[int, ...] = ()
    iterations: tuple[int, ...] = (0,)
    seed: int = 0


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
    tool = jnp.asarray(hammer.tool(), jnp.float32)
    turn = kinematics.forward(joints, tool).rotation
    jac = kinematics.jacobian(joints, tool)[jnp.array([0, 2, 4])][:, hammer.JOINTS]
    across = obs[10] - obs[0]
    aligned = jnp.clip((0.03 - jnp.abs(across)) / 0.02, 0.0, 1.0)
    hover = jnp.maximum(obs[9] + 0.05 - obs[2], 0.0)
    down = jnp.where(t % 4 == 3, 0.06, -0.08)
    upright = kinematics.rotation_error(turn, jnp.asarray(kinematics.DOWN, jnp.float32))[1]
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
    """An episode of the scripted controller in C MuJoCo. refine, iterations: see `host.play`."""
    script, params = jax.jit(probe.script), as_params(theta)
    state, episode = start, []
    for t in range(steps):
        action = script(params, state, t)
        after = host.play(probe.scene, theta, state, [action], refine=refine, iterations=iterations)[0]
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
        tested = host.play(scene, step.theta, step.before, [step.action], iterations=iterations)[0]
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


def main(config: AccuracyConfig) -> None:
    """Prints one row per setting."""
    probe = PROBES[config.task]
    settings = config.substeps or (probe.scene.substeps,)
    finest = probe._replace(scene=probe.scene._replace(substeps=max(settings)))
    reference = reference_steps(finest, thetas=config.thetas, steps=config.steps, seed=config.seed)
    table = Table(title=f"{config.task}: error of one control period, mm (reference: {_describe(finest.scene)})")
    for column in ("substeps", "dt ms", "iterations", "travel", "mean", "p95", "worst", "relative", "bias"):
        table.add_column(column, justify="right")
    for substeps in settings:
        for iterations in config.iterations:
            e = measure(probe, reference, substeps=substeps, iterations=iterations)
            sizes = (f"{x:.2f}" for x in (e.travel, e.mean, e.p95, e.worst))
            shares = (f"{100 * x:.1f} %" for x in (e.relative, e.bias))
            name = str(iterations or "own")
            table.add_row(str(substeps), f"{1000 * probe.scene.control_dt / substeps:.2f}", name, *sizes, *shares)
    Console(width=100).print(table)


def _describe(scene: Scene) -> str:
    return f"{scene.substeps * REFERENCE_REFINE} substeps, {REFERENCE_ITERATIONS} iterations"


if __name__ == "__main__":
    run_main(main, AccuracyConfig, __doc__ or "")
