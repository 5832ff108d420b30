"""What the parts of SGFT do and how far it carries, from runs on disk: transforms, horizon, severity of the gap.

The horizon is that of Figure 5 of the SGFT paper.
"""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from envs import gaps
from experiments import tables
from experiments.comparison import (
    DEFAULT,
    ORDER,
    Comparison,
    Part,
    beside_its_method,
    is_sgft,
    on_default,
    same_seeds,
    split,
)
from experiments.finetune_args import arguments
from experiments.results import LEVELS, Curve, area, reached
from sgft_jax.analysis import plot
from sgft_jax.analysis.stats import difference_interval
from sgft_jax.io.config import config_to_json
from sgft_jax.methods import METHODS, Method, finetune_config

# Methods whose horizon is an option: one searches by learning an actor, the other by planning.
HORIZON_METHODS = ("sgft-sac", "sgft-mpc")
# Settings beside the options that are equal where horizons are compared.
_BESIDE = ("preset", "prior", "initial_rollouts", "utd")
AFTER = 20  # rollouts at which severities are drawn: enough for SGFT on push, not for SAC (docs/findings.md)
_OTHER_KINDS = ("camera",)  # gaps that are not the others made worse: that one breaks what V_sim sees
# A method takes the models from the prior exactly if it branches, V_sim exactly if it shapes.
_TRANSFORMS = {"branch": "uses_dynamics", "shape": "uses_value", "shorten": "finite_horizon"}
# What comes with shortening: more than one step, and a critic that V_sim protects from its own first steps.
_WITH_SHORTENING = {"horizon", "branches", "lr_warmup"}
_TRANSFORMS_LEGEND = (
    "The methods that are SAC but for the transforms of its batches, for the critic that they begin with and, where "
    "the horizon is short, for what it is (docs/methods.md). "
    "Shortening without shaping is none of them: a return over H steps without a value at its end is blind to all that "
    "comes later."
)


# ---------------------------------------------------------------- branch, shape, shorten


def transforms(comparisons: Sequence[Comparison]) -> Part:
    """A table per task with runs of at least two of the methods on the default real system."""
    grid = [name for name in ORDER if _is_sac(METHODS[name])]
    texts, missing = [], []
    for task, comparison in on_default(comparisons).items():
        curves = {name: comparison.curves[name] for name in grid if name in comparison.curves}
        if len(curves) < 2:
            missing.append(f"{task}/{DEFAULT}: no table of transforms, which takes two of {', '.join(grid)}")
        else:
            texts.append(f"### Transforms on {task}\n\n{_transforms_table(curves)}")
    return Part([f"## The three transforms\n\n{_TRANSFORMS_LEGEND}", *texts] if texts else [], missing)


def marks(method: Method) -> list[str]:
    """A check mark or nothing for each transform: branch, shape, shorten."""
    return ["✓" if getattr(method, has) else "" for has in _TRANSFORMS.values()]


def _is_sac(method: Method) -> bool:
    """Whether nothing but its transforms, with what they bring, and its first critic make a method differ from SAC."""
    return method.agent == "sac" and not method.fresh and set(method.options) <= _WITH_SHORTENING


def _transforms_table(curves: Mapping[str, Curve]) -> str:
    common = min(int(curve.rollouts[-1]) for curve in curves.values())
    head = ["method", *_TRANSFORMS, "critic", "seeds", f"transitions to {LEVELS[0]} %", "at the end (rollouts)",
            f"area to {common} rollouts", "seeds behind"]  # fmt: skip
    rows = [
        [
            name, *marks(METHODS[name]), "new" if METHODS[name].reset_critic else "kept", tables.seeds(curve),
            tables.transitions(curve, LEVELS[0]), tables.end(curve), tables.area_to(curve, common),
            tables.behind(curve),
        ]
        for name, curve in curves.items()
    ]  # fmt: skip
    return tables.markdown(head, rows)


# ---------------------------------------------------------------- horizon


class Setting(NamedTuple):
    """What an ablation of the horizon may change; sorts by the horizon. More steps leave room for fewer branches."""

    horizon: int
    branches: int

    def text(self, method: str) -> str:
        """Such as H = 4, with the branches if they are not the usual ones of a method."""
        usual = finetune_config(METHODS[method]).branches
        return f"H = {self.horizon}" + (f", {self.branches} branches" if self.branches != usual else "")


def horizons(comparisons: Sequence[Comparison], target: Path) -> Part:
    """A figure and a table for each method that ran with several horizons on a default real system."""
    tasks = on_default(comparisons)
    found = {method: {task: by_horizon(c, method) for task, c in tasks.items()} for method in HORIZON_METHODS}
    several = {
        method: {task: runs for task, runs in those.items() if len({setting.horizon for setting in runs}) > 1}
        for method, those in found.items()
    }
    texts = [_horizon_section(method, those, target) for method, those in several.items() if those]
    missing = []
    for task in tasks:
        if lacking := [method for method in HORIZON_METHODS if task not in several[method]]:
            missing.append(f"{task}/{DEFAULT}: no two horizons of {' or '.join(lacking)} with all else equal")
    return Part(["## The horizon", *texts] if texts else [], missing)


def by_horizon(comparison: Comparison, method: str) -> dict[Setting, tuple[str, Curve]]:
    """Name and curve of the runs of a method that differ in horizon and branches alone, by these.

    Those like the one with the defaults or, where they all have one horizon, like the first run that others differ from
    in nothing else; of several with one setting the first.
    """
    names = [name for name in comparison.curves if split(name)[0] == method and "options" in comparison.configs[name]]
    found: dict[Setting, tuple[str, Curve]] = {}
    for usual in (config_to_json(arguments(method)), *(comparison.configs[name] for name in names)):
        those = _like(comparison, names, usual)
        found = found or those
        if len({setting.horizon for setting in those}) > 1:
            return those
    return found


def _like(comparison: Comparison, names: Sequence[str], usual: Mapping[str, Any]) -> dict[Setting, tuple[str, Curve]]:
    found: dict[Setting, tuple[str, Curve]] = {}
    for name in names:
        config = comparison.configs[name]
        if _alike(config, usual):
            setting = Setting(config["options"]["horizon"], config["options"]["branches"])
            found.setdefault(setting, (name, comparison.curves[name]))
    return dict(sorted(found.items()))


def _horizon_section(method: str, tasks: Mapping[str, Mapping[Setting, tuple[str, Curve]]], target: Path) -> str:
    title = f"{method} by its horizon"
    path = plot.curve_panels(
        target / f"horizon-{method}.png",
        {t: {s.text(method): (x.rollouts, x.success) for s, (_, x) in runs.items()} for t, runs in tasks.items()},
        over={task: tables.rollouts_axis(x for _, x in runs.values()) for task, runs in tasks.items()},
        title=title,
        order=[s.text(method) for s in sorted({s for runs in tasks.values() for s in runs})],
    )
    head = ["task", "horizon", "run", "seeds", *(f"transitions to {level} %" for level in LEVELS),
            "at the end (rollouts)", "seeds behind"]  # fmt: skip
    rows = [
        [
            task, setting.text(method), name, tables.seeds(curve),
            *(tables.transitions(curve, level) for level in LEVELS), tables.end(curve), tables.behind(curve),
        ]
        for task, runs in tasks.items()
        for setting, (name, curve) in runs.items()
    ]  # fmt: skip
    return f"### {title}\n\n![{title}]({path.name})\n\n{tables.markdown(head, rows)}"


def _alike(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two runs differ in horizon and branches alone, of all that both versions of the program knew."""
    first, second = ({**c["options"], **{name: c.get(name) for name in _BESIDE}} for c in (one, other))
    return all(first[name] == second[name] for name in first.keys() & second.keys() - set(Setting._fields))


# ---------------------------------------------------------------- severity of the gap


def severity(comparisons: Sequence[Comparison], target: Path, order: Sequence[str]) -> Part:
    """A figure and a table per task for the methods that ran on several of its gaps, in the order of their file.

    The figure leaves variants of a method out that is in it itself: the table has them.
    """
    texts, missing = [], []
    for task in dict.fromkeys(c.task for c in comparisons):
        scale = [name for name in gaps.presets(task) if name not in _OTHER_KINDS]
        ran = {c.real: c for c in comparisons if c.task == task and c.real in scale and c.curves}
        steps = {real: ran[real] for real in scale if real in ran}
        lines = {n: {real: c.curves[n] for real, c in steps.items() if n in c.curves} for n in order}
        lines = {name: curves for name, curves in lines.items() if len(curves) > 1}
        if lines:
            texts.append(_severity_section(task, steps, lines, target, order))
        elif len(scale) > 1:
            missing.append(f"{task}: no method has run on more than one gap of {', '.join(scale)}")
    return Part(["## How hard the gap is", *texts] if texts else [], missing)


def _severity_section(
    task: str,
    steps: Mapping[str, Comparison],
    lines: Mapping[str, Mapping[str, Curve]],
    target: Path,
    order: Sequence[str],
) -> str:
    title = f"{task} by severity of the gap"
    drawn = {name: curves for name, curves in lines.items() if not beside_its_method(name, lines)}
    path = plot.severity(
        target / f"severity-{task}.png",
        list(steps),
        {name: [_after(curves.get(real)) for real in steps] for name, curves in drawn.items()},
        {name: [_needed(curves.get(real)) for real in steps] for name, curves in drawn.items()},
        title=title,
        success=f"success after {AFTER} rollouts",
        transitions=f"real transitions to {LEVELS[0]} %",
        order=order,
        thick=[name for name in order if is_sgft(name)],
    )
    longest = max(int(curve.rollouts[-1]) for curves in lines.values() for curve in curves.values())
    budgets = [n for n in tables.BUDGETS if n <= longest]
    head = ["method", "gap", "seeds", "zero-shot", *(f"{n} rollouts" for n in budgets),
            f"transitions to {LEVELS[0]} %", "seeds behind"]  # fmt: skip
    rows = [
        [
            name, real, tables.seeds(curve), tables.percent(curve.success[:, 0]),
            *(tables.at(curve, n) for n in budgets), tables.transitions(curve, LEVELS[0]), tables.behind(curve),
        ]
        for name, curves in lines.items()
        for real, curve in curves.items()
    ]  # fmt: skip
    parts = [f"### {title}", f"![{title}]({path.name})", tables.markdown(head, rows), _leads(steps, drawn)]
    return "\n\n".join(filter(None, parts))


def _leads(steps: Mapping[str, Comparison], lines: Mapping[str, Mapping[str, Curve]]) -> str:
    """A table of how far every SGFT method is above the best other one on each gap; empty without one of either kind.

    The best is that with runs on the most gaps, of these the one with the largest mean success over them.
    """
    overall = lambda name: np.mean([area(x, int(x.rollouts[-1])).mean() for x in lines[name].values()])  # noqa: E731
    own = [name for name in lines if is_sgft(name)]
    others = [n for n, ran in lines.items() if split(n)[0] in METHODS and not is_sgft(n) and _learned(ran.values())]
    best = max(others, key=lambda name: (len(lines[name]), overall(name)), default=None)
    if best is None or not own:
        return ""
    legend = (
        f"Mean success over the run, up to where both runs got, minus that of {best}: points, mean over seeds with its "
        "95 % bootstrap interval, which draws the seeds of both together where they are the same."
    )
    rows = [[name, *(_lead(c, name, best) for c in steps.values())] for name in own]
    return f"{legend}\n\n{tables.markdown(['method', *steps], rows)}"


def _learned(curves: Iterable[Curve]) -> bool:
    """Whether all of these runs were evaluated after they began."""
    return all(curve.rollouts[-1] > 0 for curve in curves)


def _lead(comparison: Comparison, name: str, other: str) -> str:
    """By how many points the mean success over the run of one method is above another's: "13 [6, 20]"."""
    own, best = comparison.curves.get(name), comparison.curves.get(other)
    if own is None or best is None or not _learned([own, best]):
        return tables.NONE
    common = min(int(own.rollouts[-1]), int(best.rollouts[-1]))
    paired = same_seeds(comparison, name, other)
    return tables.points(difference_interval(area(own, common), area(best, common), paired=paired))


def _after(curve: Curve | None) -> np.ndarray | None:
    """Success [seeds] at the last evaluation after at most `AFTER` rollouts; None for a run that did not get there."""
    if curve is None or curve.rollouts[-1] < AFTER:
        return None
    return curve.success[:, np.flatnonzero(curve.rollouts <= AFTER)[-1]]


def _needed(curve: Curve | None) -> tuple[int, bool] | None:
    """Transitions to 90 % or, with False, those that were not enough; None without a run."""
    if curve is None:
        return None
    n = reached(curve, LEVELS[0])
    return (int(curve.transitions[-1]), False) if n is None else (n, True)
