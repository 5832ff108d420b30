"""Chooses the gaps of a frozen set from a table of drawn ones, by rules that know no results of any method."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from envs import gaps
from envs.gaps import SIM, Gap
from envs.types import UserError

STRATA = ("solved", "partial", "failed")
_EVEN = 1  # counts of families that differ by no more than this are as even as whole numbers may have to be

Lines = Mapping[str, Mapping[str, Any]]


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
    counts = dict.fromkeys((family for names in strata.values() for name in names for family in _of(lines, name)), 0)
    chosen: set[str] = set()
    while len(chosen) < n:
        for names in list(filter(None, strata.values()))[: n - len(chosen)]:
            best = min(names, key=lambda name: _spread(counts, _of(lines, name)))
            names.remove(best)
            chosen.add(best)
            for family in _of(lines, best):
                counts[family] += 1
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


def _of(lines: Lines, name: str) -> Sequence[str]:
    return lines[name]["gap"]["families"]


def _spread(counts: Mapping[str, int], families: Sequence[str]) -> int:
    """How far the numbers of gaps per family lie apart once a gap with these families is added."""
    then = [count + (family in families) for family, count in counts.items()]
    return max(_EVEN, max(then, default=0) - min(then, default=0))
