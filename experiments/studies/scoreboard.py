"""How methods did on a frozen set of gaps: a line for each method and stratum, and the reference against the others.

Reads what fine-tuning has left in <out>/finetune for the gaps of these files, and for the control `sim` beside them, or
released tables.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from envs import gaps
from envs.gaps import SIM
from envs.types import UserError, unknown
from experiments.runner import cli
from experiments.runner.options import at_least_one
from experiments.studies.gaps_draw import STRATA
from sgft_jax.io.runs import check_folder
from sgft_jax.methods import DEFAULT

if TYPE_CHECKING:
    from sgft_jax.analysis.curves import Curve

    Played = dict[str, dict[str, dict[str, Curve]]]  # by METHOD or METHOD:VARIANT, stratum and "task/gap"

CONTROL = "no gap"
ORDER = (CONTROL, *STRATA)
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


def _tables(args: ScoreboardArgs, played: "Played") -> str:
    from sgft_jax.analysis import scoreboard
    from sgft_jax.analysis.tables import markdown

    curves = [curve for strata in played.values() for runs in strata.values() for curve in runs.values()]
    rows = [
        scoreboard.row(method, stratum, strata[stratum], curves)
        for stratum in ORDER
        for method, strata in played.items()
        if stratum in strata
    ]
    texts = ["Success in per cent, mean over gaps.", markdown(scoreboard.HEAD, rows)]
    hard = {method: strata.get("partial", {}) | strata.get("failed", {}) for method, strata in played.items()}
    if len(played) > 1 and (reference := hard.pop(args.reference)):
        duels = [scoreboard.duel(reference, method, runs) for method, runs in hard.items()]
        head = (f"{args.reference} against", "gaps with at least its area", "P(better), per cent")
        texts += ["On gaps that are not solved:", markdown(head, [cells for cells in duels if cells])]
    if args.each:
        texts += [_EACH, markdown(("gap", "stratum", *played), _gap_by_gap(played))]
    return "\n\n".join(texts)


def _gap_by_gap(played: "Played") -> Iterator[list[str]]:
    """A line for each gap, a column for each method, empty where it did not run."""
    from sgft_jax.analysis.scoreboard import brief

    for stratum in ORDER:
        columns = [strata.get(stratum, {}) for strata in played.values()]
        for gap in sorted({gap for runs in columns for gap in runs}):
            yield [gap, stratum, *(brief(runs.get(gap)) for runs in columns)]


def _draw(args: ScoreboardArgs, played: "Played") -> Path:
    """The picture of those methods that ran on all gaps of a stratum that the reference ran on: a panel a stratum."""
    from sgft_jax.analysis import figures, scoreboard

    panels = {}
    for stratum in ORDER:
        if gaps := played[args.reference].get(stratum, {}).keys():
            runs = [strata.get(stratum, {}) for strata in played.values()]
            words = f"{stratum}, {len(gaps)} {'tasks' if stratum == CONTROL else 'gaps'}"
            panels[words] = [scoreboard.pooled(curves) for curves in runs if curves.keys() >= gaps]
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


def played_on(args: ScoreboardArgs) -> "Played":
    """All that ran on these gaps, not on the control alone; UserError where nobody did, or the reference did not."""
    runs = _runs_on(args, strata_of(args.gaps))
    played = {method: strata for method, strata in runs.items() if set(strata) - {CONTROL}}
    if not played:
        raise UserError(f"{args.data or args.out / 'finetune'}: holds no evaluated run on these gaps")
    if args.reference not in played:
        raise UserError(f"--reference {args.reference}: did not run on these gaps; there are: {', '.join(played)}")
    return played


def _runs_on(args: ScoreboardArgs, strata: Mapping[str, str]) -> "Played":
    from sgft_jax.analysis.release import read

    curves = [curve for curve in read(args.out, args.data).curves if curve.gap in strata]
    for option, field, wanted in (("--tasks", "task", args.tasks), ("--priors", "priors", args.priors)):
        names = {getattr(curve, field) for curve in curves}
        if names and (odd := [name for name in wanted if name not in names]):
            raise UserError(unknown(option, odd[0], names))
        curves = [curve for curve in curves if not wanted or getattr(curve, field) in wanted]
    played: Played = {}
    for curve in curves:
        runs = played.setdefault(curve.spec, {}).setdefault(strata[curve.gap], {})
        if (name := f"{curve.task}/{curve.gap}") in runs:
            several = f"{curve.spec} ran on {name} with several sets of seeds or priors"
            raise UserError(f"{args.data or args.out}: {several}; keep one, or choose with --priors")
        runs[name] = curve if args.seeds is None else curve.first(args.seeds)
    return played


if __name__ == "__main__":
    cli.run_main(main, ScoreboardArgs, __doc__ or "")
