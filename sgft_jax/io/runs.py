"""Impure: the life of a run folder: made once, resumed or replaced on request, with its configuration and origin."""

import contextlib
import importlib.metadata
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Literal, TypedDict

from msgspec import Meta

from envs.files import Schema, read_object
from envs.types import UserError
from sgft_jax.files.disk import ASIDE, InUseError, Lock, differences, empty, in_use, write_json

CONFIG, PROVENANCE = "config.json", "provenance.json"
ROOT = Path(__file__).parents[2]  # of the repository, in a checkout
_MARK = "sgft_jax"
FORMAT = 3  # of run folders; a state saved by another format does not fit the code of this one
# What a start has to show for itself; one that has failed before any of it is there can be forgotten.
_STEPS = ("checkpoints/[0-9]*", f"checkpoints/{ASIDE}[0-9]*")
_RESULTS = (*_STEPS, "real/*.npz", "evaluation/*/real/*.npz", "prior/*", "policy/*", "summary.json")
_OPEN: list[Path] = []  # the run folders in which this process works, or has been ended
_PACKAGES = ("sgft-jax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "orbax-checkpoint", "numpy")
NO_DATA, NO_SIMULATOR = "no-data", "no-simulator"  # what stands for them in the folders of runs without


class Options(TypedDict, total=False):
    """What readers ask of the options of a run, whatever command it is of."""

    task: str
    seed: Annotated[int, Meta(ge=0, le=2**31 - 1)]
    method: str
    real: str | None
    set: list[str]
    prior: str | None
    preset: str | None
    variant: str | None
    impl: Literal["auto", "jax", "warp", "c"]


class _Git(TypedDict):
    commit: str


class _Start(TypedDict, total=False):
    started: str
    git: _Git | None
    versions: dict[str, str]
    device: dict[str, Any]
    priors: list[str]


@contextlib.contextmanager
def opened(
    configs: Mapping[Path, Mapping[str, Any]],
    *,
    kind: str,
    resume: bool = False,
    overwrite: bool = False,
    volatile: tuple[str, ...] = ("resume", "overwrite"),
    inputs: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = print,
) -> Iterator[list[Path]]:
    """Create or reopen run folders, say where they are, and record configuration and provenance: all of them or none.

    They are locked against other processes inside the `with` block. configs: the configuration of each folder as JSON
    data. kind: what writes there ("pretrain", "finetune"). volatile: dotted names of fields that may differ on a
    resume. inputs: JSON data that says what the runs begin with, such as digests of files, by name; it is recorded with
    the provenance and must be the same on a resume.
    Raises UserError if a folder holds something already and neither `resume` nor `overwrite` is set, if it is not a run
    folder, if the stored configuration differs, or if another process has it open. What is wrong with one folder is
    found before anything is written to any.
    """
    inputs = inputs or {}
    for folder in configs:
        say(f"run folder: {folder}")
    begun = [check_start(folder, resume=resume, overwrite=overwrite) for folder in configs]
    with contextlib.ExitStack() as locks:
        for (folder, config), earlier in zip(configs.items(), begun, strict=True):
            folder.mkdir(parents=True, exist_ok=True)
            locks.callback(lambda lock: lock.release(), Lock(folder))  # a lock that nobody holds is released
            if earlier and resume:
                check_same(folder, kind, config, volatile)
                _check_inputs(folder, inputs)
        for (folder, config), earlier in zip(configs.items(), begun, strict=True):
            if earlier and not resume:
                empty(folder, last=CONFIG)
            if not (earlier and resume):
                first = {_MARK: _version("sgft-jax"), "format": FORMAT, "kind": kind, "config": config}
                write_json(folder / CONFIG, first)
            write_json(folder / PROVENANCE, {"starts": [*read_starts(folder), {**provenance(), **inputs}]})
        _OPEN[:] = configs
        yield list(configs)
        _OPEN.clear()


def outlook() -> list[str]:
    """What is worth saying to a user who ends the runs of this process; [] where none has begun."""
    if not _OPEN:
        return []
    if all(map(_has_results, _OPEN)):
        return ["the same command with --resume continues from what is saved"]
    return ["nothing is saved yet, the same command begins again"]


def provenance() -> dict[str, Any]:
    """Where results come from: command, time, code, versions, device. Names no host, no user and no home folder."""
    import jax

    device = jax.devices()[0]
    words = [plain_path(word, [Path.cwd(), ROOT]) for word in sys.argv[1:]]
    command, started = shlex.join([Path(sys.argv[0]).name, *words]), datetime.now(UTC).isoformat(timespec="seconds")
    devices = {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count()}
    code = {"git": _git_state(ROOT), "python": platform.python_version(), "versions": versions()}
    return {"command": command, "started": started, **code, "device": devices}


def plain_path(word: str, bases: Sequence[Path]) -> str:
    """A word of a command line, or any text, without the folders of the machine that it was written on.

    An absolute path, alone or behind `option=`, becomes relative to the first of the folders `bases` that it lies in;
    of one that lies in none `.../` and the last name are left. Everything else stays as it is.
    """
    absolute = re.fullmatch(r"([\w.-]+=)?(~?/.*)", word, re.DOTALL)
    if absolute is None:
        return word
    option, path = absolute[1] or "", Path(absolute[2])
    inside = [path.relative_to(base) for base in bases if path.is_relative_to(base)]
    return option + (str(inside[0]) if inside else f".../{path.name}")


def versions() -> dict[str, str]:
    """Of this package and of those that decide its numbers."""
    return {name: _version(name) for name in _PACKAGES}


def _version(package: str) -> str:
    """Its version; a source tree on the path is not an installed package, and runs all the same."""
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def _git_state(root: Path) -> dict[str, Any] | None:
    """Commit, whether files differ from it, and by how much; None outside a git checkout of this project."""

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(root), *arguments]
        return subprocess.run(command, capture_output=True, text=True, check=True, timeout=10).stdout.strip()

    if not (root / ".git").exists():
        return None
    try:
        changed = git("diff", "HEAD", "--stat")
        return {"commit": git("rev-parse", "HEAD"), "dirty": bool(changed), "changed": changed.splitlines()}
    except (OSError, subprocess.SubprocessError):
        return None


# ---------------------------------------------------------------- the folder


def check_start(folder: Path, *, resume: bool, overwrite: bool) -> bool:
    """Whether a run folder holds an earlier start; raises UserError if that is not what was asked for.

    Commands call it before anything slow. A start that failed before it left a checkpoint, a real rollout or a result
    does not count and is replaced.
    """
    if resume and overwrite:
        raise UserError("--resume and --overwrite exclude each other: keep the run or replace it")
    check_folder(folder)
    # A process killed while it made the folder leaves hidden files at most: nothing started yet.
    existing = folder.exists() and any(not p.name.startswith(".") for p in folder.iterdir())
    if existing:
        stored = _stored(folder) if (folder / CONFIG).exists() else {}
        if _MARK not in stored:
            raise UserError(f"{folder}: is not a run folder (it has no {CONFIG} of ours); choose another one")
        if in_use(folder):
            raise InUseError(f"{folder}: another process is writing to it")
        if not (resume or overwrite) and _has_results(folder):
            raise UserError(f"{folder}: exists already; continue it with --resume or replace it with --overwrite")
    elif resume and not folder.exists():
        raise UserError(f"{folder}: nothing to resume there; leave --resume out to start it")
    return existing


def _has_results(folder: Path) -> bool:
    return any(path for pattern in _RESULTS for path in folder.glob(pattern))


def check_folder(folder: Path, option: str = "--out") -> None:
    """Raises UserError, which names the option, where no folder can be made or written; makes nothing itself."""
    try:
        base = next(path for path in (folder, *folder.absolute().parents) if path.is_symlink() or path.exists())
        kind = "" if base.is_dir() else "a file" if base.exists() else "a link that leads nowhere"
    except OSError as error:  # such as a name that is too long
        reason = (error.strerror or "").lower()
        raise UserError(f"{folder}: cannot be made ({reason}); choose another {option}") from error
    if kind:
        raise UserError(f"{folder}: cannot be made, {base} is {kind}; choose another {option}")
    if not os.access(base, os.W_OK | os.X_OK):
        raise UserError(f"{folder}: cannot be written, you may not write to {base}; choose another {option}")


def read_own(path: Path, needed: Schema | None = None, *, otherwise: str = "") -> dict[str, Any]:
    """The JSON object that a run has written to a file, {} where there is no such file.

    needed: the schema of `read_object`. otherwise: what else than putting the file back mends it. Raises UserError
    where it is no such object.
    """
    if not path.exists():
        return {}
    return read_object(path, needed or {}, f"put back the file that the run has written{otherwise}")


def read_config(folder: Path) -> dict[str, Any]:
    """The options of the run in a folder, checked as `Options`; {} where a robot has recorded without a run."""
    return read_own(folder / CONFIG, {"config": Options}).get("config", {})


def read_starts(folder: Path) -> list[dict[str, Any]]:
    """What the provenance of a run says of its starts; [] where there is none."""
    begin = ", or begin again with --overwrite"
    return read_own(folder / PROVENANCE, {"starts": list[_Start]}, otherwise=begin).get("starts", [])


def _check_inputs(folder: Path, inputs: Mapping[str, Any]) -> None:
    """Raises UserError if the run began with others; runs of earlier versions do not say."""
    for start in read_starts(folder):
        for name, now in inputs.items():
            if (before := start.get(name, now)) != now:
                advice = "put the first ones back, or begin again with --overwrite"
                raise UserError(f"{folder}: cannot resume with other {name}: they were {before}, now {now}; {advice}")


def _stored(folder: Path) -> dict[str, Any]:
    schema = {_MARK: str, "kind": str, "config": dict}
    return read_object(folder / CONFIG, schema, "it was not written by this project, or put it back")


def check_same(folder: Path, kind: str, wanted: Mapping[str, Any], volatile: tuple[str, ...]) -> None:
    """Raises UserError, which names the differences, unless a run folder is of that kind and configuration.

    wanted: JSON data. volatile: dotted names that may differ.
    """
    stored = _stored(folder)
    if (saved := stored.get("format", 1)) != FORMAT:
        advice = f"this version continues format {FORMAT} alone. Begin again with --overwrite"
        raise UserError(f"{folder}: is a run of sgft_jax {stored[_MARK]} in format {saved}; {advice}")
    if stored["kind"] != kind:
        raise UserError(f"{folder}: is a {stored['kind']} run, not a {kind} run")
    changes = [change for change in differences(stored["config"], wanted) if change[0] not in volatile]
    if changes:
        listed = "; ".join(f"{name} was {old!r}, now {new!r}" for name, old, new in changes)
        raise UserError(f"{folder}: cannot resume with another configuration: {listed}")
