"""The paper's theory against the truth: bounds on random systems, and the pendulum that argues for it.

bounds: losses and bounds of Lemma 1 to Theorem 1 (Yin et al. 2025, appendix A) for H = 1 to 8, with a right model and a
wrong one. pendulum: both systems on a grid, by dynamic programming: what V_sim is worth as a guide in the real one.
"""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from envs.control import pendulum
from envs.types import Array, UserError
from experiments.runner import cli
from experiments.runner.options import Out, at_least_one, each_once
from experiments.runner.progress import doing
from sgft_jax import theory
from sgft_jax.analysis import tables
from sgft_jax.io.log import write_summary
from sgft_jax.io.runs import check_folder
from sgft_jax.theory import Measured, System

_STATES, _ACTIONS, _GAMMA = 8, 3, 0.9  # of the random systems
_MODELS = ("right", "wrong")
_CLOSE = 2e-4  # rounding, of what a policy can lose
_BROKEN = ("lemma 1", "lemma 1, printed", "lemma 2", "lemma 3", "lemma 4", "theorem 1", "without improvability")

_DISCOUNT, _TORQUES = 0.95, 81
_FRICTION = (0.5, 7.0)  # of the real pendulum, as `pendulum.PARAMETERS`: up to 10 rad/s^2
_SIMULATED = pendulum.TORQUE / 2  # rad/s^2 that the simulator's policy uses: friction leaves room for it
_START = (1.0, 0.0)  # rad, rad/s
_NEAR = 1.0  # rad and rad/s: starts
_COARSE, _FEWEST = 61, 20  # angles of the grid on which bounds are measured, and of the smallest one
_DRIFT = 0.002  # of V_sim in a step, by rounding


@dataclass(frozen=True)
class TheoryArgs:
    """One study of the theory."""

    parts: tuple[Literal["bounds", "pendulum"], ...] = ("bounds", "pendulum")
    """What to measure; the head of this help explains it."""
    systems: int = 2000
    """Random systems for each horizon."""
    horizons: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7, 8)
    """Values of H."""
    points: int = 241
    """Angles of the pendulum's grid, and half of its velocities."""
    out: Out = Path("runs")


def main(args: TheoryArgs) -> None:
    """Measures, prints tables, and leaves `theory/summary.json` and figures."""
    at_least_one(args, "systems", "horizons")
    if args.points < _FEWEST:
        raise UserError(f"--points is {args.points}: must be at least {_FEWEST}, or the grid says nothing")
    each_once(args, "parts", "horizons")
    check_folder(args.out / "theory")
    folder = args.out / "theory"
    folder.mkdir(parents=True, exist_ok=True)
    summary: dict[str, Any] = {}
    for part in args.parts:
        lines, path = {"bounds": _bounds, "pendulum": _pendulum}[part](args, folder)
        summary[part] = lines
        print(tables.markdown(list(lines[0]), [[_text(x) for x in line.values()] for line in lines]))
        print(f"\nfigure: {path}\n")
    print(f"numbers: {write_summary(folder, summary)}")


def _text(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


# --- bounds -----------------------------------------------------------------------------------------------------------


def _bounds(args: TheoryArgs, folder: Path) -> tuple[list[dict[str, Any]], Path]:
    """A line for each kind of system, model and horizon: how many systems break a bound, or make it vacuous."""
    lines = []
    with doing("solving the pendulum of the bounds", 10, once=True):
        swung = _solve(_COARSE)
        models = {"right": swung.real, "wrong": _system(swung.axes, pendulum.TORQUE, (0.0, 0.0))}  # without friction
    for systems, gamma in (("random", _GAMMA), ("pendulum", _DISCOUNT)):
        for model in _MODELS:
            for horizon in args.horizons:
                with doing(f"solving {systems} systems with a {model} model for H = {horizon}", 10, once=True):
                    keys = jax.random.split(jax.random.key(horizon), args.systems)
                    x = _random(keys, horizon, model) if systems == "random" else _one(swung, models[model], horizon)
                about = {"systems": systems, "model": model, "H": horizon}
                lines.append(about | _judged(jax.tree.map(np.asarray, x), horizon, gamma))
    return lines, _draw_bounds(folder / "bounds.png", lines)


def _random(keys: Array, horizon: int, model: str) -> Measured:
    """[N] of random systems."""

    def one(key: Array) -> Measured:
        key_systems, key_plan = jax.random.split(key)
        sim, real, wrong = theory.draw_systems(key_systems, _STATES, _ACTIONS)
        guide = theory.lowered(real, theory.optimal(sim, _GAMMA), _GAMMA)
        return theory.measure(real, {"right": real, "wrong": wrong}[model], guide, _GAMMA, horizon, key_plan)

    return jax.jit(jax.vmap(one))(keys)


def _one(x: "_Solved", model: System, horizon: int) -> Measured:
    """[1] of the pendulum."""
    solve = jax.jit(functools.partial(theory.measure, gamma=_DISCOUNT, horizon=horizon))
    return jax.tree.map(lambda x: x[None], solve(x.real, model, x.value, key=jax.random.key(0)))


def _judged(x: Measured, horizon: int, gamma: float) -> dict[str, Any]:
    """x: [N] of systems. Vacuous is a bound above what any policy can lose."""
    c, at = x.constants, {"gamma": gamma, "horizon": horizon}
    theorem, without = theory.theorem_1(c, **at), theory.bhardwaj(c, **at)
    excess = (
        x.apart - theory.lemma_1(c, **at),
        x.apart - theory.lemma_1(c, **at, printed=True),
        x.plan - theory.lemma_2(c, **at),
        -x.growth,
        x.policy - theory.lemma_4(c, **at, loss=x.first),
        x.policy - theorem,
        x.policy - without,
    )
    most = c.reward / (1.0 - gamma)
    broken = {f"{name} broken": float((e > _CLOSE * most).mean()) for name, e in zip(_BROKEN, excess, strict=True)}
    vacuous = {"theorem 1 vacuous": theorem, "without improvability vacuous": without}
    middle = {"alpha": c.model, "loss": x.policy, "theorem 1": theorem, "without improvability": without}
    return (
        broken
        | {name: float((bound >= most).mean()) for name, bound in vacuous.items()}
        | {f"median {name}": float(np.median(value)) for name, value in middle.items()}
    )


def _draw_bounds(path: Path, lines: list[dict[str, Any]]) -> Path:
    """Medians of the loss and of both bounds over H in random systems, a panel for each model."""
    figure, axes = _figure(8.0, 3.2, 2)
    for panel, model in zip(axes, _MODELS, strict=True):
        mine = [line for line in lines if (line["systems"], line["model"]) == ("random", model)]
        for name in ("loss", "theorem 1", "without improvability"):
            panel.plot([line["H"] for line in mine], [line[f"median {name}"] for line in mine], label=name, marker="o")
        panel.set(title=f"{model} model", xlabel="H", yscale="log")
    axes[0].set_ylabel("loss of return, median")
    axes[0].legend(frameon=False, fontsize=8)
    return _saved(figure, path)


# --- pendulum ---------------------------------------------------------------------------------------------------------


class _Solved(NamedTuple):
    """The pendulum on a grid of angles and velocities. simulator, and real with as much torque or with all of it.
    value: [S] V_sim.
    """

    axes: tuple[np.ndarray, np.ndarray]
    simulator: System
    tight: System
    real: System
    value: Array


def _pendulum(args: TheoryArgs, folder: Path) -> tuple[list[dict[str, Any]], Path]:
    """A line for each policy in the real system."""
    with doing(f"solving the pendulum on {args.points} x {2 * args.points} points", 120, once=True):
        fine = _solve(args.points)
        lines = _reached(fine)
    with doing("solving it on half of them, to see how much the grid matters", 30, once=True):
        coarse = _solve(args.points // 2 + 1)
        rough = _reached(coarse)
    gap = lines[-1]["return"] - lines[0]["return"]
    for line, other in zip(lines, rough, strict=True):
        line["changes with the grid by, of the gap"] = abs(line["return"] - other["return"]) / gap
    return lines, _draw_pendulum(folder / "pendulum.png", fine)


def _solve(points: int) -> _Solved:
    axes = _axes(points)
    simulator = _system(axes, _SIMULATED, (0.0, 0.0))
    tight, real = (_system(axes, most, _FRICTION) for most in (_SIMULATED, pendulum.TORQUE))
    return _Solved(axes, simulator, tight, real, theory.optimal(simulator, _DISCOUNT))


def _axes(points: int) -> tuple[np.ndarray, np.ndarray]:
    """So many angles, and velocities."""
    angles = np.linspace(-np.pi, np.pi, points, endpoint=False)
    return angles, np.linspace(-pendulum.FASTEST, pendulum.FASTEST, 2 * points - 1)


def _system(axes: tuple[np.ndarray, np.ndarray], most: float, friction: tuple[float, float]) -> System:
    """The pendulum on a grid, with torques of at most so many rad/s^2."""

    def step(state: Array, torque: Array) -> Array:
        return pendulum.move(state, torque, jnp.array(friction))

    torques = jnp.linspace(-most, most, _TORQUES)
    return jax.jit(lambda: theory.gridded(step, pendulum.reward_of, axes, torques, wraps=(True, False)))()


def _reached(x: _Solved) -> list[dict[str, Any]]:
    """Mean return of policies in the real system, from starts near upright; how improvable V_sim is there."""
    angles, speeds = np.meshgrid(*x.axes, indexing="ij")
    near = ((np.abs(angles) <= _NEAR) & (np.abs(speeds) <= _NEAR)).ravel()

    def line(policy: str, least: np.ndarray, values: Array) -> dict[str, Any]:
        share = {"improvable states": float((least >= -_DRIFT).mean()), "at the worst state": float(least.min())}
        return {"policy": policy, "return": float(np.asarray(values)[near].mean()), **share}

    def guided(system: System, horizon: int) -> Array:
        return theory.followed(system, theory.plan(system, x.value, _DISCOUNT, horizon).actions[-1], _DISCOUNT)

    first = theory.plan(x.simulator, x.value, _DISCOUNT, 1).actions[0]
    tight, real = (np.asarray(theory.improvability(system, x.value, _DISCOUNT)) for system in (x.tight, x.real))
    return [
        line("the simulator's, as it is", tight, theory.followed(x.tight, first, _DISCOUNT)),
        line("guided by V_sim, H = 1, no more torque", tight, guided(x.tight, 1)),
        *(line(f"guided by V_sim, H = {h}", real, guided(x.real, h)) for h in (1, 4)),
        line("the best", real, theory.optimal(x.real, _DISCOUNT)),
    ]


def _draw_pendulum(path: Path, x: _Solved) -> Path:
    """V_sim and the ways of four policies, their torques, and where V_sim is improvable without more torque."""
    figure, panels = _figure(13.0, 3.6, 3)
    angles, speeds = x.axes
    shape = len(angles), len(speeds)
    mesh = panels[0].pcolormesh(angles, speeds, np.asarray(x.value).reshape(shape).T, cmap="Greys_r")
    figure.colorbar(mesh, ax=panels[0], label="V_sim")
    for name, plays, plans, colour, style in _WAYS:
        states, torques = _way(x, plays, plans)
        look = {"label": name, "color": colour, "linestyle": style, "linewidth": 2.5}
        panels[0].plot(*states.T, **look)
        panels[1].plot(pendulum.DT * np.arange(len(torques)), torques, **look)
    panels[0].set(xlabel="angle, rad", ylabel="velocity, rad/s", title="the same states ...")
    panels[0].set(xlim=(-0.5, 1.5), ylim=(-3.0, 1.5))
    panels[1].set(xlabel="time, s", ylabel="torque, rad/s²", title="... by other torques")
    panels[1].legend(frameon=False, fontsize=8)
    least = np.asarray(theory.improvability(x.tight, x.value, _DISCOUNT)).reshape(shape)
    panels[2].pcolormesh(angles, speeds, (least >= -_DRIFT).T, cmap="Greys_r", vmin=-1.0, vmax=1.0)
    panels[2].set(xlabel="angle, rad", ylabel="velocity, rad/s")
    panels[2].set_title("grey: no torque is enough")
    return _saved(figure, path)


_WAYS = (  # what they are called, the system that is played in and the one that is planned with, colour, line
    ("simulator, greedy", "simulator", "simulator", "#0072B2", "-"),
    ("real, the same torque minus e(s)", "undone", "simulator", "#E69F00", "--"),
    ("real, greedy", "real", "real", "#D55E00", "-."),
    ("real, the simulator's torque", "real", "simulator", "#009E73", ":"),
)


def _way(x: _Solved, plays: str, plans: str) -> tuple[np.ndarray, np.ndarray]:
    """States [T, 2] and torques [T] from one start, in one system, of the policy that is greedy in the other."""
    friction = {"simulator": jnp.zeros(2), "real": jnp.array(_FRICTION), "undone": jnp.array(_FRICTION)}
    most = {"simulator": _SIMULATED, "real": pendulum.TORQUE}
    torques = jnp.linspace(-most[plans], most[plans], 10 * _TORQUES)
    table = x.value.reshape(len(x.axes[0]), len(x.axes[1]))

    def promise(state: Array) -> Array:
        place = [(s - axis[0]) / (axis[1] - axis[0]) for s, axis in zip(state, x.axes, strict=True)]
        return jax.scipy.ndimage.map_coordinates(table, place, order=1, mode="nearest")

    def step(state: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        after = jax.vmap(lambda torque: promise(pendulum.move(state, torque, friction[plans])))(torques)
        torque = torques[jnp.argmax(after)]
        torque -= pendulum.friction(state, friction[plays]) if plays == "undone" else 0.0
        return pendulum.move(state, torque, friction[plays]), (state, torque)

    return jax.tree.map(np.asarray, jax.lax.scan(step, jnp.array(_START), None, length=40)[1])


def _figure(width: float, height: float, panels: int) -> tuple[Figure, Any]:
    figure = Figure(figsize=(width, height), layout="constrained", dpi=120)
    FigureCanvasAgg(figure)
    return figure, figure.subplots(1, panels)


def _saved(figure: Figure, path: Path) -> Path:
    figure.savefig(path)
    return path


if __name__ == "__main__":
    cli.run_main(main, TheoryArgs, __doc__ or "")
