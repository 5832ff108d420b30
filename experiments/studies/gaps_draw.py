"""Draw gaps from a distribution, write them to a file, measure and sort them, and choose a frozen set of them.

Solved by the simulator's policy (80 % and more), partial, or failed (below 20 %); trivial where identifying commands
(scale, rotation, bias) and constant errors of sensors from one rollout suffices (90 %). What the table beside the file
holds already is not measured again.
"""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from envs import gaps
from envs.files import read_toml
from envs.gaps import SIM, Gap
from envs.types import UserError
from experiments.gaps import PLAIN, MeasureArgs, check_episodes, folders_of_priors
from experiments.runner import cli
from experiments.runner.options import at_least_one, check_task, seed_list
from sgft_jax.io.runs import check_folder
from sgft_jax.presets import PRESETS

STRATA = ("solved", "partial", "failed")
_EVEN = 1  # counts of families that differ by no more than this are as even as whole numbers may have to be

Lines = Mapping[str, Mapping[str, Any]]


@dataclass(frozen=True, kw_only=True)
class DrawArgs(MeasureArgs):
    """One table: a line per drawn gap of a task."""

    count: int
    """How many gaps; they go to <out>/gaps/<task>/seed-<seed>.toml. Gap i of a seed is always the same."""
    distribution: Path | None = None
    """A .toml file of families to draw from; default: the one that comes with the task."""
    plan: bool = False
    """Also measure what sgft-mpc does at its start, plans by the prior's models."""
    judge: bool = False
    """Also train policies that see their previous actions, in one program, on every gap that nothing measured so far
    masters (90 %): a gap counts only if something does."""
    judge_preset: str = PLAIN
    """Pretraining preset of that training; --config.* changes it."""
    choose: int = 0
    """Choose so many of the measured gaps for a frozen set, evenly over strata and families; where gaps have one family
    each, as many of every family, at most a quarter solved if the others suffice. A gap that a policy trained there
    (--judge) did not master is never chosen."""
    to: Path | None = None
    """With --choose: the .toml file of the frozen set; one that holds other gaps is never replaced."""
    overwrite: bool = False
    """Measure again what the table holds with other settings; default: refuse."""
    preset: str = PLAIN
    """Pretraining preset of the priors."""
    seed: int = 0
    """What is drawn; also the first seed of the training on real systems."""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    cli.run_main(draw, DrawArgs, __doc__ or "", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> DrawArgs:
    """The defaults of the preset; `draw` refuses a preset that does not exist."""
    judge_preset = cli.preview(argv, judge_preset=PLAIN).judge_preset
    return DrawArgs(count=tyro.MISSING, judge_preset=judge_preset, config=PRESETS.get(judge_preset, PRESETS[PLAIN]))


def draw(args: DrawArgs) -> dict[str, Any]:
    """Draws, measures, prints a table, writes and returns it. Raises UserError for what is wrong with the options."""
    seeds, folders = check(args)
    from experiments.studies import gaps_drawn

    drawn, table = gaps_drawn.run(args, seeds, folders)
    if args.to:
        marks = {name: gaps_drawn.marks(line) for name, line in table["gaps"].items()}
        _freeze(args, args.to, drawn, table["gaps"], marks)
    return table


def check(args: DrawArgs) -> tuple[list[int], list[Path]]:
    """The seeds and the folders of the priors; raises UserError for what is wrong with the options."""
    cli.choose("--judge-preset", args.judge_preset, PRESETS)
    at_least_one(args, "count")
    check_episodes(args)
    if not 0 <= args.choose <= args.count:
        raise UserError(f"--choose is {args.choose}: must be from 1 to the {args.count} of --count")
    if bool(args.choose) != bool(args.to):
        raise UserError("--choose N and --to FILE.toml: give both, the number of gaps and where they go")
    if args.to and args.to.suffix != ".toml":
        raise UserError(f"--to {args.to}: must end in .toml")
    if args.to:
        check_folder(args.to.parent, "--to")
    if args.distribution is not None:
        read_toml(args.distribution)
    check_folder(args.out / "gaps")
    seeds = seed_list(args.seed, args.seeds)
    check_task(args.task)
    return seeds, folders_of_priors(args)


# --- a frozen set -----------------------------------------------------------------------------------------------------


def _freeze(args: DrawArgs, path: Path, drawn: Sequence[Gap], known: Lines, marks: Mapping[str, list[str]]) -> None:
    """Writes a frozen set of the gaps that were asked for and says what is to know of it."""
    by_name = {gap.name: gap for gap in drawn}
    lines = {name: known[name] for name in by_name}
    alone = all(len(gap.families) == 1 for gap in drawn)
    names = choose_alone(lines, args.choose) if alone else choose(lines, args.choose)
    words = [", ".join([f"zero-shot {100 * lines[n]['zero_shot']['success']:.0f} %", *marks[n]]) for n in names]
    chosen = [by_name[name]._replace(stratum=lines[name]["stratum"]) for name in names]
    write(path, chosen, words, _command(args))
    print("\n".join([*remarks(lines, names), f"chosen: {path}"]))


def _command(args: DrawArgs) -> str:
    """What draws and chooses the same gaps, where the same priors are."""
    families = [f"--distribution {args.distribution}"] if args.distribution else []
    flags = [f"--{name}" for name in ("plan", "judge") if getattr(args, name)]
    options = [f"--task {args.task} --count {args.count} --seed {args.seed}", *families, *flags]
    return f"python -m experiments.studies.gaps_draw {' '.join(options)} --choose {args.choose} --to {args.to}"


def choose(lines: Lines, n: int) -> list[str]:
    """Names of n gaps of a table, in its order; the same table gives the same names.

    lines: {name: line of `experiments.studies.gaps_drawn.Table`}. The strata take turns, and one that has no gap
    left passes its turn on. In its turn a stratum gives the gap that keeps the numbers of gaps per family closest to
    each other, of several such gaps the first. Never chosen: SIM, a gap without a stratum, a gap that a policy trained
    there did not master. Raises UserError if fewer than n gaps are left.
    """
    strata = _by_stratum(lines)
    if (most := sum(map(len, strata.values()))) < n:
        raise UserError(f"--choose {n}: only {most} of the gaps may be chosen; draw more with --count")
    families = {name: lines[name]["gap"]["families"] for names in strata.values() for name in names}
    counts = dict.fromkeys(itertools.chain.from_iterable(families.values()), 0)
    chosen: set[str] = set()
    while len(chosen) < n:
        for names in list(filter(None, strata.values()))[: n - len(chosen)]:
            best = min(names, key=lambda name: _spread(counts, families[name]))
            names.remove(best)
            chosen.add(best)
            for family in families[best]:
                counts[family] += 1
    return [name for name in lines if name in chosen]


def choose_alone(lines: Lines, n: int) -> list[str]:
    """The same of gaps that have one family each: as many of every family, of these a quarter solved, if there are
    enough others, else more; the first ones. Raises UserError if a family has too few gaps.
    """
    may = [name for names in _by_stratum(lines).values() for name in names]
    of = {name: lines[name]["gap"]["families"][0] for name in lines if name in may}
    share, chosen = n // max(len(set(of.values())), 1), set[str]()
    for family in sorted(set(of.values())):
        solved, open_ = (
            [x for x in of if of[x] == family and (lines[x]["stratum"] == "solved") is s] for s in (True, False)
        )
        least = share - share // 4
        order = [*open_[:least], *solved[: share // 4], *open_[least:], *solved[share // 4 :]]
        if len(order) < share:
            raise UserError(f"--choose {n}: {family} has {len(order)} gaps of {share}; draw more with --count")
        chosen |= set(order[:share])
    return [name for name in lines if name in chosen]


def remarks(lines: Lines, chosen: Sequence[str]) -> list[str]:
    """What people should know of a choice: strata that have too few gaps, and gaps that may be beyond anybody."""
    left, notes = _by_stratum(lines), []
    shares = {s: len(chosen) // len(STRATA) + (i < len(chosen) % len(STRATA)) for i, s in enumerate(STRATA)}
    if few := [f"{s} has {len(left[s])} of {shares[s]}" for s in STRATA if len(left[s]) < shares[s]]:
        notes.append(f"too few gaps: {', '.join(few)}; other strata give the rest")
    if open_ := [name for name in chosen if lines[name]["admitted"] is None]:
        notes.append(f"nobody checked that these gaps can be mastered, --judge does: {', '.join(open_)}")
    return notes


def write(path: Path, chosen: Sequence[Gap], words: Sequence[str], command: str) -> None:
    """Writes a frozen set as TOML. Raises UserError if the file holds other gaps.

    words: a comment for each gap. command: how the set was made, for the head of the file.
    """
    if path.exists() and list(gaps.read_file(path).values()) != list(chosen):
        raise UserError(f"{path}: holds other gaps; a frozen set is never replaced, choose another --to")
    tables = [f"# {comment}\n{gaps.to_toml([gap])}" for gap, comment in zip(chosen, words, strict=True)]
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join([f"# Chosen by {command}\n", *tables]))


def _by_stratum(lines: Lines) -> dict[str, list[str]]:
    """The names of the gaps that may be chosen."""
    may = [name for name, line in lines.items() if name != SIM and line["admitted"] is not False]
    return {stratum: [name for name in may if lines[name]["stratum"] == stratum] for stratum in STRATA}


def _spread(counts: Mapping[str, int], families: Sequence[str]) -> int:
    """How far the numbers of gaps per family lie apart once a gap with these families is added."""
    then = [count + (family in families) for family, count in counts.items()]
    return max(_EVEN, max(then, default=0) - min(then, default=0))


if __name__ == "__main__":
    main()
