"""How methods did on a frozen set of gaps: a line for each method and stratum, and the reference against the others.

Reads what fine-tuning has left in <out>/finetune for the gaps of these files, and for the control `sim` beside them, or
released tables.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from envs import gaps
from envs.gaps import SIM
from envs.types import UserError, unknown
from experiments.runner import cli
from experiments.runner.options import at_least_one
from experiments.studies.gaps_choose import STRATA
from sgft_jax.io.runs import check_folder
from sgft_jax.methods import DEFAULT

if TYPE_CHECKING:
    from sgft_jax.analysis.curves import Curve
    from sgft_jax.analysis.scoreboard import Row

    Played = dict[str, dict[str, dict[str, Curve]]]  # by METHOD or METHOD:VARIANT, stratum and "task/gap"

CONTROL = "no gap"
_EACH = "Start: area / end / deepest fall of the mean below the start, for each gap:"
_HEAD = (
    "stratum", "method", "gaps", "start", "area", "end", "90 % held at the end", "90 % held ever, after transitions",
    "deepest fall: zero-shot / own start", "loss at the end", "training",
)  # fmt: skip


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
    from sgft_jax.analysis import scoreboard, tables

    curves = [curve for each in played.values() for own in each.values() for curve in own.values()]
    rows = [
        scoreboard.row(method, stratum, each[stratum], curves)
        for stratum in (CONTROL, *STRATA)
        for method, each in played.items()
        if stratum in each
    ]
    said = ["Success in per cent, mean over gaps.", "", tables.markdown(_HEAD, [_line(row) for row in rows]), ""]
    hard = {method: {**each.get("partial", {}), **each.get("failed", {})} for method, each in played.items()}
    if len(played) > 1 and (own := hard.pop(args.reference)):
        found = [scoreboard.duel(own, method, each) for method, each in hard.items() if set(own) & set(each)]
        lines = [[d.other, f"{d.ahead} of {d.gaps}", tables.number(d.better)] for d in found]
        head = (f"{args.reference} against", "gaps with at least its area", "P(better), per cent")
        said += ["On gaps that are not solved:", "", tables.markdown(head, lines), ""]
    if args.each:
        said += [_EACH, "", _gap_by_gap(played), ""]
    return "\n".join(said).rstrip()


def _gap_by_gap(played: "Played") -> str:
    """A line for each gap, a column for each method, empty where it did not run."""
    from sgft_jax.analysis import tables

    lines = []
    for stratum in (CONTROL, *STRATA):
        runs = {method: each.get(stratum, {}) for method, each in played.items()}
        for gap in sorted({gap for each in runs.values() for gap in each}):
            lines.append([gap, stratum, *(_cell(each.get(gap)) for each in runs.values())])
    return tables.markdown(("gap", "stratum", *played), lines)


def _cell(curve: "Curve | None") -> str:
    from sgft_jax.analysis import scoreboard, tables

    if curve is None:
        return ""
    row = scoreboard.row(curve.method, "", {curve.gap: curve})
    start, area, end = (tables.plain(float(band.estimate), curve.score) for band in (row.start, row.area, row.end))
    return f"{start}: {area} / {end} / {tables.plain(row.fall, curve.score)}"


def _draw(args: ScoreboardArgs, played: "Played") -> Path:
    """The picture of those methods that ran on all gaps of a stratum that the reference ran on: a panel a stratum."""
    from sgft_jax.analysis import figures, scoreboard

    reference = played[args.reference]
    panels = {
        f"{stratum}, {len(own)} {'tasks' if stratum == CONTROL else 'gaps'}": [
            scoreboard.pooled(each[stratum]) for each in played.values() if set(each.get(stratum, ())) >= set(own)
        ]
        for stratum in (CONTROL, *STRATA)
        if (own := reference.get(stratum))
    }
    return figures.learning_curves(args.out / "scoreboard.png", panels, title="Mean over the gaps of a stratum")


def strata_of(files: tuple[Path, ...]) -> dict[str, str]:
    """The stratum of every gap by name, the control first; raises UserError for a gap that has none."""
    found = {SIM: CONTROL}
    for file in files:
        for gap in gaps.read_file(file).values():
            if not gap.stratum:
                raise UserError(f"{file} [{gap.name}]: has no 'stratum'; experiments.studies.gaps_draw writes sets")
            found[gap.name] = gap.stratum
    return found


def played_on(args: ScoreboardArgs) -> "Played":
    """All that ran on these gaps, not on the control alone; UserError where nobody did, or the reference did not."""
    found = _runs_on(args, strata_of(args.gaps))
    played = {method: each for method, each in found.items() if set(each) - {CONTROL}}
    if not played:
        raise UserError(f"{args.data or args.out / 'finetune'}: holds no evaluated run on these gaps")
    if args.reference not in played:
        raise UserError(f"--reference {args.reference}: did not run on these gaps; there are: {', '.join(played)}")
    return played


def _runs_on(args: ScoreboardArgs, strata: Mapping[str, str]) -> "Played":
    from sgft_jax.analysis.reading import read_runs
    from sgft_jax.analysis.release import read_data

    curves = [c for c in (read_data(args.data) if args.data else read_runs(args.out)).curves if c.gap in strata]
    for option, field, wanted in (("--tasks", "task", args.tasks), ("--priors", "priors", args.priors)):
        there = {getattr(curve, field) for curve in curves}
        if there and (odd := [name for name in wanted if name not in there]):
            raise UserError(unknown(option, odd[0], there))
        curves = [curve for curve in curves if not wanted or getattr(curve, field) in wanted]
    found: Played = {}
    for curve in curves:
        own = found.setdefault(curve.spec, {}).setdefault(strata[curve.gap], {})
        if (name := f"{curve.task}/{curve.gap}") in own:
            raise UserError(
                f"{args.data or args.out}: {curve.spec} ran on {name} with several sets of seeds or priors; keep "
                "one, or choose with --priors"
            )
        own[name] = curve if args.seeds is None else curve.first(args.seeds)
    return found


def _line(row: "Row") -> list[str]:
    from sgft_jax.analysis import tables

    scores = [tables.number(band) for band in (row.start, row.area, row.end)]
    policy = tables.NONE if row.policy_fall != row.policy_fall else f"{100 * row.policy_fall:.0f}"
    worst = f"{policy} / {100 * row.fall:.0f}" + (f" ({row.worst})" if row.fall >= 0.005 else "")
    training = "" if row.training != row.training else f"{100 * row.training:.0f}"
    held = f"{row.held} of {row.gaps}"
    ever = f"{row.reached} of {row.gaps}" + (f", {row.transitions:.0f}" if row.reached else "")
    return [
        row.stratum,
        row.method,
        str(row.gaps),
        *scores,
        held,
        ever,
        worst,
        f"{100 * max(row.loss, 0):.0f}",
        training,
    ]


if __name__ == "__main__":
    cli.run_main(main, ScoreboardArgs, __doc__ or "")
