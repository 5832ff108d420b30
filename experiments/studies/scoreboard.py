"""How methods did on a frozen set of gaps: a line for each method and stratum, and the reference against the others.

The prior is the random factor: member i of a curve began from prior i, on every gap, and intervals draw members.

Reads what fine-tuning has left in <out>/finetune for the gaps of these files, and for the control `sim` beside them, or
released tables.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from envs import gaps
from envs.gaps import SIM
from envs.types import UserError, unknown
from experiments.runner import cli
from experiments.runner.options import at_least_one
from experiments.studies.gaps_draw import STRATA
from sgft_jax.analysis.curves import (
    LEVEL,
    Curve,
    area,
    at,
    common_grid,
    deepest_fall,
    improvement_of_pairs,
    transitions_until_held,
    zero_shot,
)
from sgft_jax.analysis.release import read
from sgft_jax.analysis.tables import NONE, markdown, number, plain
from sgft_jax.io.runs import check_folder
from sgft_jax.math.stats import bootstrap_interval, mean
from sgft_jax.methods import DEFAULT

Played = Mapping[str, Curve]  # by "task/gap"
Board = dict[str, dict[str, dict[str, Curve]]]  # by METHOD or METHOD:VARIANT, stratum and "task/gap"

CONTROL = "no gap"
ORDER = (CONTROL, *STRATA)
HEAD = ("stratum", "method", "gaps", "start", "area", "end", "90 % held at the end")
HEAD += ("90 % held ever, after transitions", "deepest fall: zero-shot / own start", "loss at the end", "training")
_EACH = "Start: area / end / deepest fall of the mean below the start, for each gap:"


@dataclass(frozen=True)
class ScoreboardArgs:
    """Gaps and methods to compare."""

    gaps: tuple[Path, ...]
    """Frozen sets, as `experiments.studies.gaps_draw` writes them."""
    reference: str = DEFAULT
    """Compare the others with METHOD or METHOD:VARIANT."""
    tasks: tuple[str, ...] = ()
    """Only these tasks; default: all that ran on these gaps."""
    priors: tuple[str, ...] = ()
    """Only runs from these sets of priors, as released tables name them; default: all."""
    seeds: int | None = None
    """Only the first so many seeds of each run: methods that ran with fewer are then compared from the same priors."""
    each: bool = False
    """Also a table with a line for each gap."""
    data: Path | None = None
    """Folder of released tables to read instead of runs, such as docs/data."""
    out: Path = Path("runs")
    """Parent of all run folders; the table also goes to <out>/scoreboard.md, a picture to <out>/scoreboard.png."""


def main(args: ScoreboardArgs) -> None:
    """Prints the tables, writes them, and draws every method on the gaps of each stratum."""
    if args.seeds is not None:
        at_least_one(args, "seeds")
    check_folder(args.out)
    played = played_on(args)
    text = _tables(args, played)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "scoreboard.md").write_text(text + "\n")
    picture = _draw(args, played)
    print(f"{text}\n\nwritten: {args.out / 'scoreboard.md'}, {picture}")


def board(args: ScoreboardArgs) -> str:
    """The tables; raises UserError where nobody ran on these gaps, or the reference did not."""
    return _tables(args, played_on(args))


def _tables(args: ScoreboardArgs, played: Board) -> str:
    curves = [curve for strata in played.values() for runs in strata.values() for curve in runs.values()]
    rows = [
        row(method, stratum, strata[stratum], curves)
        for stratum in ORDER
        for method, strata in played.items()
        if stratum in strata
    ]
    texts = ["Success in per cent, mean over gaps.", markdown(HEAD, rows)]
    hard = {method: strata.get("partial", {}) | strata.get("failed", {}) for method, strata in played.items()}
    if len(played) > 1 and (reference := hard.pop(args.reference)):
        duels = [duel(reference, method, runs) for method, runs in hard.items()]
        head = (f"{args.reference} against", "gaps with at least its area", "P(better), per cent")
        texts += ["On gaps that are not solved:", markdown(head, [cells for cells in duels if cells])]
    if args.each:
        texts += [_EACH, markdown(("gap", "stratum", *played), _gap_by_gap(played))]
    return "\n\n".join(texts)


def _gap_by_gap(played: Board) -> Iterator[list[str]]:
    """A line for each gap, a column for each method, empty where it did not run."""
    for stratum in ORDER:
        columns = [strata.get(stratum, {}) for strata in played.values()]
        for gap in sorted({gap for runs in columns for gap in runs}):
            yield [gap, stratum, *(brief(runs.get(gap)) for runs in columns)]


def _draw(args: ScoreboardArgs, played: Board) -> Path:
    """The picture of those methods that ran on all gaps of a stratum that the reference ran on: a panel a stratum."""
    from sgft_jax.analysis import figures  # brings Matplotlib

    panels = {}
    for stratum in ORDER:
        if gaps := played[args.reference].get(stratum, {}).keys():
            runs = [strata.get(stratum, {}) for strata in played.values()]
            words = f"{stratum}, {len(gaps)} {'tasks' if stratum == CONTROL else 'gaps'}"
            panels[words] = [pooled(curves) for curves in runs if curves.keys() >= gaps]
    return figures.learning_curves(args.out / "scoreboard.png", panels, title="Mean over the gaps of a stratum")


def strata_of(files: tuple[Path, ...]) -> dict[str, str]:
    """The stratum of every gap by name, the control first; raises UserError for a gap that has none."""
    strata = {SIM: CONTROL}
    for file in files:
        for gap in gaps.read_file(file).values():
            if not gap.stratum:
                raise UserError(f"{file} [{gap.name}]: has no 'stratum'; experiments.studies.gaps_draw writes sets")
            strata[gap.name] = gap.stratum
    return strata


def played_on(args: ScoreboardArgs) -> Board:
    """All that ran on these gaps, not on the control alone; UserError where nobody did, or the reference did not."""
    runs = _runs_on(args, strata_of(args.gaps))
    played = {method: strata for method, strata in runs.items() if set(strata) - {CONTROL}}
    if not played:
        raise UserError(f"{args.data or args.out / 'finetune'}: holds no evaluated run on these gaps")
    if args.reference not in played:
        raise UserError(f"--reference {args.reference}: did not run on these gaps; there are: {', '.join(played)}")
    return played


def _runs_on(args: ScoreboardArgs, strata: Mapping[str, str]) -> Board:
    curves = [curve for curve in read(args.out, args.data).curves if curve.gap in strata]
    for option, field, wanted in (("--tasks", "task", args.tasks), ("--priors", "priors", args.priors)):
        names = {getattr(curve, field) for curve in curves}
        if names and (odd := [name for name in wanted if name not in names]):
            raise UserError(unknown(option, odd[0], names))
        curves = [curve for curve in curves if not wanted or getattr(curve, field) in wanted]
    played: Board = {}
    for curve in curves:
        runs = played.setdefault(curve.spec, {}).setdefault(strata[curve.gap], {})
        if (name := f"{curve.task}/{curve.gap}") in runs:
            several = f"{curve.spec} ran on {name} with several sets of seeds or priors"
            raise UserError(f"{args.data or args.out}: {several}; keep one, or choose with --priors")
        runs[name] = curve if args.seeds is None else curve.first(args.seeds)
    return played


# --- lines of the tables ----------------------------------------------------------------------------------------------


def row(method: str, stratum: str, played: Played, others: Sequence[Curve]) -> list[str]:
    """The line of a method on the gaps of one stratum, a cell for each of HEAD.

    Start, area and end: mean score over gaps, with its interval. Held at the end: gaps whose mean was at least 90 % at
    the last two evaluations. Held ever: gaps whose mean was at any two evaluations in a row, and the median over these
    gaps of the real transitions until the first of the two. Deepest fall: how far the mean of any gap ever was below
    the simulator's policy, where that was evaluated from these priors, and below its start, with the gap. Loss: how far
    the mean of any gap ended below its start. Training: mean score of the training rollouts, if anybody kept them.

    others: curves of other methods, in which the simulator's policy is looked up where this method begins with plans or
    with another policy. Raises UserError where gaps have different numbers of members.
    """
    curves = list(played.values())
    if len(sizes := sorted({len(curve.seeds) for curve in curves})) > 1:
        raise UserError(f"{method}: ran with {sizes[0]} seeds on some gaps and with {sizes[-1]} on others")
    means = {gap: curve.values.mean(0) for gap, curve in played.items()}
    falls = {gap: float(values[0] - values.min()) for gap, values in means.items()}
    worst = max(falls, key=lambda gap: falls[gap])
    held = sum(bool((values[-2:] >= LEVEL).all()) for values in means.values())
    taken = [n for curve in curves if (n := transitions_until_held(curve)) is not None]
    below = max(_policy_fall(curve, others) for curve in curves)
    loss = max(float(values[0] - values[-1]) for values in means.values())
    trained = [np.nanmean(curve.training) for curve in curves if curve.training is not None]
    starts, ends = ([curve.values[:, i] for curve in curves] for i in (0, -1))
    scores = (starts, _areas(played, list(played), common_grid(curves)), ends)
    return [
        stratum,
        method,
        str(len(curves)),
        *(number(bootstrap_interval(np.mean(members, axis=0), statistic=mean)) for members in scores),
        f"{held} of {len(curves)}",
        f"{len(taken)} of {len(curves)}" + (f", {np.median(taken):.0f}" if taken else ""),
        f"{NONE if np.isnan(below) else _percent(below)} / {_percent(falls[worst])}"
        + (f" ({worst})" if falls[worst] >= 0.005 else ""),
        _percent(max(loss, 0)),
        _percent(np.mean(trained)) if trained else "",
    ]


def _percent(share: float | np.floating) -> str:
    return f"{100 * share:.0f}"


def brief(curve: Curve | None) -> str:
    """A method on one gap, "start: area / end / deepest fall"; nothing where it did not run."""
    if curve is None:
        return ""
    (areas,) = _areas({curve.gap: curve}, [curve.gap], common_grid([curve]))
    scores = (curve.values[:, 0].mean(), areas.mean(), curve.values[:, -1].mean(), deepest_fall(curve))
    start, *others = (plain(float(score), curve.score) for score in scores)
    return f"{start}: {' / '.join(others)}"


def _policy_fall(curve: Curve, others: Sequence[Curve]) -> float:
    """How far the mean ever was below the simulator's policy; nan where that was not evaluated."""
    begun = (curve.task, curve.gap, curve.priors)
    same = [other for other in (curve, *others) if (other.task, other.gap, other.priors) == begun]
    before = zero_shot(curve, same)
    return np.nan if before is None else deepest_fall(curve, before)


def duel(reference: Played, other: str, played: Played) -> list[str] | None:
    """The reference against one method, on the gaps and evaluations that they share; None without such a gap.

    Its name, the number of gaps on which the reference's mean area is at least its own, and the probability that a run
    of the reference has the larger area, over all pairs of runs, mean over gaps.
    """
    gaps = [gap for gap in reference if gap in played]
    if not gaps:
        return None
    grid = common_grid([runs[gap] for runs in (reference, played) for gap in gaps])
    above, below = _areas(reference, gaps, grid), _areas(played, gaps, grid)
    ahead = int((above.mean(1) >= below.mean(1)).sum())
    return [other, f"{ahead} of {len(gaps)}", number(improvement_of_pairs(above, below))]


def pooled(played: Played) -> Curve:
    """A method on several gaps as one curve: member by member the mean over them, at the evaluations that they share.

    Tasks have rollouts of different lengths, so the curve knows neither transitions nor minutes (nan).
    """
    curves = list(played.values())
    first, grid = curves[0], common_grid(curves)
    points = [[point for n in grid if (point := at(curve, n)) is not None] for curve in curves]
    values, nothing = np.mean(points, axis=0).T, np.array(np.nan)
    return replace(first, x=grid, scores={first.score: values}, transitions=nothing, minutes=nothing, training=None)


def _areas(played: Played, gaps: Sequence[str], grid: np.ndarray) -> np.ndarray:
    """[gaps, members]"""
    areas = [values for gap in gaps if (values := area(played[gap], grid)) is not None]
    assert len(areas) == len(gaps)
    return np.stack(areas)


if __name__ == "__main__":
    cli.run_main(main, ScoreboardArgs, __doc__ or "")
