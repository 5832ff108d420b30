"""Copy what runs say, without what they learned, to a folder that can be committed.

Of every run, the trials of tuning included, the configuration, its origin, the evaluations, times and final numbers:
texts of some kilobytes, no checkpoints, policies, rollouts or videos; and what tuning chose. `python -m
experiments.figures --out docs/data` draws from the copy. Absolute paths become relative (`runs.plain_path`).
The command, given again, copies what is new.
"""

import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from experiments import cli, tuned
from sgft_jax.io.jsonfile import read_json, write_json
from sgft_jax.io.log import EVAL, SUMMARY, read_jsonl
from sgft_jax.io.runs import CONFIG, PROVENANCE, ROOT, plain_path
from sgft_jax.types import UserError

_WHERE = {"finetune": "*/*/*/*", "pretrain": "*/*/*", "tune/finetune": "*/*/*/*"}  # run folders below <out>/<kind>
_JSON = (CONFIG, PROVENANCE, SUMMARY)
_LOGS = (EVAL, "timing.jsonl")  # not metrics.jsonl, which is ten times as long and in no table


@dataclass(frozen=True)
class ExportArgs:
    """Reads <out>/finetune, pretrain, tune and tuned, writes folders of the same names."""

    out: Path = Path("runs")
    """Parent of all run folders."""
    to: Path = Path("docs/data")
    """Where the copy goes."""
    unfinished: bool = False
    """Also runs that have evaluations but did not come to their end."""
    overwrite: bool = False
    """Also replace a run there that is longer than the one here."""


class Texts(NamedTuple):
    """What a run says, by file name: json data and logs. length: env steps or real transitions of the last evaluation;
    0 without one.
    """

    json: dict[str, Any]
    logs: dict[str, str]
    length: int


def main(args: ExportArgs) -> None:
    """Copies, and says what was new, replaced, left out and changed."""
    print("\n".join(export(args)))


def export(args: ExportArgs) -> list[str]:
    """Copies; returns a line for each run that is not there as it was before, and for each path that was changed."""
    said, changed, copied, same = [], {}, 0, 0
    for folder in _folders(args.out):
        name, there = folder.relative_to(args.out), args.to / folder.relative_to(args.out)
        texts, before = read_texts(folder), read_texts(there)
        if problem := _problem(texts, before, args):
            said.append(f"{name}: {problem}")
            continue
        texts = texts._replace(json=_made_relative(texts.json, _bases(texts.json[CONFIG]), changed))
        if before == texts:
            same += 1
            continue
        _write(there, texts)
        copied += 1
        said.append(f"{name}: {f'replaced one of {before.length:,} steps' if before.json else 'new'}")
    if not (said or same):
        raise UserError(f"{args.out}: holds no run; --out names the parent of finetune/ and pretrain/")
    said += _export_chosen(args, changed)
    said += [f"made relative: {old} -> {new}" for old, new in sorted(changed.items())]
    return [*said, f"{args.to}: {copied} runs copied, {same} were there already"]


def _export_chosen(args: ExportArgs, changed: dict[str, str]) -> list[str]:
    """Copies what tuning chose; returns a line for each file that is not there as it was before."""
    said = []
    for path in sorted((args.out / tuned.VARIANT).glob("*/*.json")):
        name = path.relative_to(args.out)
        there, chosen = args.to / name, _made_relative(read_json(path), _bases({}), changed)
        before = read_json(there) if there.exists() else None
        if chosen != before:
            there.parent.mkdir(parents=True, exist_ok=True)
            write_json(there, chosen)
            said.append(f"{name}: {'replaced another choice' if before else 'new'}")
    return said


def read_texts(folder: Path) -> Texts:
    """What a run folder, or the copy of one, holds; what is missing is left out."""
    there = lambda names: [name for name in names if (folder / name).exists()]  # noqa: E731
    evaluations = read_jsonl(folder / EVAL) if there([EVAL]) else []
    return Texts(
        {name: read_json(folder / name) for name in there(_JSON)},
        {name: _whole_lines(folder / name) for name in there(_LOGS)},
        evaluations[-1]["step"] if evaluations else 0,
    )


def _folders(out: Path) -> Iterator[Path]:
    for kind, pattern in _WHERE.items():
        yield from sorted(path.parent for path in (out / kind).glob(f"{pattern}/{CONFIG}"))


def _problem(texts: Texts, there: Texts, args: ExportArgs) -> str | None:
    """Why a run is not copied."""
    if not texts.length:
        return "left out, it has not learned from anything yet"
    if not (_finished(texts) or args.unfinished):
        return "left out, it is unfinished (go on with --resume, or add --unfinished)"
    if there.length > texts.length and not args.overwrite:
        return f"kept the one of {there.length:,} steps, this one has {texts.length:,} (--overwrite replaces it)"
    return None


def _finished(texts: Texts) -> bool:
    """Whether there are final numbers, and no evaluations of a later start after them."""
    return (
        SUMMARY in texts.json and texts.json[SUMMARY].get("final", {}).get("transitions", texts.length) == texts.length
    )


def _whole_lines(path: Path) -> str:
    """The log without a last line that a kill has torn."""
    text = path.read_text()
    return text[: text.rfind("\n") + 1]


def _bases(config: Mapping[str, Any]) -> list[Path]:
    """Folders that absolute paths of a run may lie in: those here and, if it comes from elsewhere, that of its own."""
    out = Path(config.get("config", {}).get("out", ""))
    return [ROOT, Path.cwd(), *([out.parent] if out.is_absolute() else [])]


def _made_relative(data: Mapping[str, Any], bases: Sequence[Path], changed: dict[str, str]) -> dict[str, Any]:
    """JSON data without absolute paths; adds each of these and what became of it to `changed`."""

    def word(text: str) -> str:
        new = plain_path(text, bases)
        if new != text:
            changed[text] = new
        return new

    def visit(value: Any, key: str = "") -> Any:
        if isinstance(value, dict):
            return {k: visit(v, k) for k, v in value.items()}
        if isinstance(value, list):
            return [visit(v) for v in value]
        if not isinstance(value, str):
            return value
        return shlex.join(map(word, shlex.split(value))) if key == "command" else word(value)

    return visit(data)


def _write(folder: Path, texts: Texts) -> None:
    """The files of `texts` and none that another run has left of these names."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in [name for name in (*_JSON, *_LOGS) if name not in (*texts.json, *texts.logs)]:
        (folder / name).unlink(missing_ok=True)
    for name, content in texts.json.items():
        write_json(folder / name, content)
    for name, content in texts.logs.items():
        (folder / name).write_text(content)


if __name__ == "__main__":
    cli.run_main(main, ExportArgs, __doc__ or "")
