"""Impure: the life of a run folder: made once, resumed or replaced on request, with its configuration and origin."""

import dataclasses
import fcntl
import importlib.metadata
import os
import platform
import re
import shlex
import shutil
import subprocess
import sys
import weakref
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypedDict

from envs.files import Count, read_json, read_object
from sgft_jax.io.jsonfile import differences, write_json
from sgft_jax.types import UserError

CONFIG, PROVENANCE = "config.json", "provenance.json"
ROOT = Path(__file__).parents[2]  # of the repository, in a checkout
_LOCK = ".lock"
_MARK = "sgft_jax"
FORMAT = 2  # of run folders; a state saved by another format does not fit the code of this one
# What a start has to show for itself; one that has failed before any of it is there can be forgotten.
_RESULTS = ("checkpoints/[0-9]*", "real/*.npz", "evaluation/*/real/*.npz", "prior/*", "policy/*", "summary.json")
_PACKAGES = ("sgft-jax", "jax", "jaxlib", "mujoco", "mujoco-mjx", "flax", "optax", "orbax-checkpoint", "numpy")


class InUseError(UserError):
    """Another process has the run folder open."""


class Lock:
    """An exclusive lock on a folder, held until `release()`, collection or the end of the process, however it ends.

    Raises InUseError if another process, or another Run of this one, holds it.
    """

    def __init__(self, folder: Path) -> None:
        handle = os.open(folder / _LOCK, os.O_RDWR | os.O_CREAT, 0o644)
        self.release = weakref.finalize(self, os.close, handle)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.release()
            raise InUseError(f"{folder}: another process is writing to it") from None


def in_use(folder: Path) -> bool:
    """Whether somebody holds the lock of a run folder."""
    if not (folder / _LOCK).exists():
        return False
    try:
        Lock(folder).release()
    except InUseError:
        return True
    return False


@dataclasses.dataclass(frozen=True)
class Run:
    """An open run folder, locked against other processes; `resumed`: it holds an earlier start of the same run."""

    folder: Path
    resumed: bool
    lock: Lock = dataclasses.field(repr=False)

    def close(self) -> None:
        """Let other processes open the folder."""
        self.lock.release()


def open_runs(
    configs: Mapping[Path, Mapping[str, Any]],
    *,
    kind: str,
    resume: bool = False,
    overwrite: bool = False,
    volatile: tuple[str, ...] = ("resume", "overwrite"),
    inputs: Mapping[str, Any] | None = None,
    say: Callable[[str], None] = print,
) -> list[Run]:
    """Create or reopen run folders, say where they are, and record configuration and provenance: all of them or none.

    configs: the configuration of each folder as JSON data. kind: what writes there ("pretrain", "finetune"). volatile:
    dotted names of fields that may differ on a resume. inputs: JSON data that says what the runs begin with, such as
    digests of files, by name; it is recorded with the provenance and must be the same on a resume.
    Raises UserError if a folder holds something already and neither `resume` nor `overwrite` is set, if it is not a run
    folder, if the stored configuration differs, or if another process has it open. What is wrong with one folder is
    found before anything is written to any.
    """
    inputs = inputs or {}
    for folder in configs:
        say(f"run folder: {folder}")
    existing = [check_start(folder, resume=resume, overwrite=overwrite) for folder in configs]
    runs: list[Run] = []
    try:
        for (folder, config), there in zip(configs.items(), existing, strict=True):
            folder.mkdir(parents=True, exist_ok=True)
            runs.append(Run(folder, resumed=there and resume, lock=Lock(folder)))
            if there and resume:
                check_same(folder, kind, config, volatile)
                _check_inputs(folder, inputs)
    except UserError:
        for run in runs:
            run.close()  # the traceback would keep the locks alive
        raise
    for run, config, there in zip(runs, configs.values(), existing, strict=True):
        if there and not resume:
            _empty(run.folder)
        _record(run, kind, config, inputs)
    return runs


def provenance() -> dict[str, Any]:
    """Where results come from: command, time, code, versions, device. Names no host, no user and no home folder."""
    import jax

    device = jax.devices()[0]
    words = [plain_path(word, [Path.cwd(), ROOT]) for word in sys.argv[1:]]
    return {
        "command": shlex.join([Path(sys.argv[0]).name, *words]),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "git": _git_state(ROOT),
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in _PACKAGES},
        "device": {"platform": device.platform, "kind": device.device_kind, "count": jax.device_count()},
    }


def plain_path(word: str, bases: Sequence[Path]) -> str:
    """A word of a command line, or any text, without the folders of the machine that it was written on.

    An absolute path, alone or behind `option=`, becomes relative to the first of the folders `bases` that it lies in;
    of one that lies in none `.../` and the last name are left. Everything else stays as it is.
    """
    found = re.fullmatch(r"([\w.-]+=)?(~?/.*)", word, re.DOTALL)
    if found is None:
        return word
    option, path = found[1] or "", Path(found[2])
    inside = [path.relative_to(base) for base in bases if path.is_relative_to(base)]
    return option + (str(inside[0]) if inside else f".../{path.name}")


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
        _check_ours(folder, resume=resume, overwrite=overwrite)
    elif resume and not folder.exists():
        raise UserError(f"{folder}: nothing to resume there; leave --resume out to start it")
    return existing


def check_folder(folder: Path, option: str = "--out") -> None:
    """Raises UserError, which names the option, where no folder can be made or written; makes nothing itself."""
    try:
        there = next(path for path in (folder, *folder.absolute().parents) if os.path.lexists(path))
    except OSError as error:  # such as a name that is too long
        raise UserError(
            f"{folder}: cannot be made ({(error.strerror or '').lower()}); choose another {option}"
        ) from error
    if not there.is_dir():
        what = "a file" if there.exists() else "a link that leads nowhere"
        raise UserError(f"{folder}: cannot be made, {there} is {what}; choose another {option}")
    if not os.access(there, os.W_OK | os.X_OK):
        raise UserError(f"{folder}: cannot be written, you may not write to {there}; choose another {option}")


class Options(TypedDict, total=False):
    """What those who read a run know of its options; there are more."""

    task: str
    method: str
    variant: str
    preset: str
    prior: str | None
    seed: Count


def read_own(path: Path, needed: Mapping[str, type] | None = None, *, otherwise: str = "") -> dict[str, Any]:
    """The JSON object that a run has written to a file, {} where there is no such file.

    needed: as of `read_object`. otherwise: what else than putting the file back mends it. Raises UserError where it is
    no such object.
    """
    if not path.exists():
        return {}
    return read_object(path, needed or {}, f"put back the file that the run has written{otherwise}")


def _record(run: Run, kind: str, config: Mapping[str, Any], inputs: Mapping[str, Any]) -> None:
    """Write down the start with what it begins with, and the configuration if it is the first one."""
    if not run.resumed:
        write_json(run.folder / CONFIG, {_MARK: _version("sgft-jax"), "format": FORMAT, "kind": kind, "config": config})
    write_json(run.folder / PROVENANCE, {"starts": [*_starts(run.folder), {**provenance(), **inputs}]})


def _starts(folder: Path) -> list[dict[str, Any]]:
    found = read_own(folder / PROVENANCE, {"starts": list}, otherwise=", or begin again with --overwrite")
    return found.get("starts", [])


def _check_inputs(folder: Path, inputs: Mapping[str, Any]) -> None:
    """Raises UserError if the run began with others; runs of earlier versions do not say."""
    for start in _starts(folder):
        for name, now in inputs.items():
            if (before := start.get(name, now)) != now:
                raise UserError(
                    f"{folder}: cannot resume with other {name}: they were {before}, now {now}; put the first ones "
                    "back, or begin again with --overwrite"
                )


def _check_ours(folder: Path, *, resume: bool, overwrite: bool) -> None:
    stored = _stored(folder) if (folder / CONFIG).exists() else {}
    if _MARK not in stored:
        raise UserError(f"{folder}: is not a run folder (it has no {CONFIG} of ours); choose another one")
    if not (resume or overwrite) and any(path for pattern in _RESULTS for path in folder.glob(pattern)):
        raise UserError(f"{folder}: exists already; continue it with --resume or replace it with --overwrite")


def _stored(folder: Path) -> dict[str, Any]:
    stored = read_json(folder / CONFIG)
    if not isinstance(stored, dict) or not {_MARK, "kind", "config"} <= set(stored):
        raise UserError(f"{folder / CONFIG}: was not written by this project")
    return stored


def check_same(folder: Path, kind: str, wanted: Mapping[str, Any], volatile: tuple[str, ...]) -> None:
    """Raises UserError, which names the differences, unless a run folder is of that kind and configuration.

    wanted: JSON data. volatile: dotted names that may differ.
    """
    stored = _stored(folder)
    if (found := stored.get("format", 1)) != FORMAT:
        raise UserError(
            f"{folder}: is a run of sgft_jax {stored[_MARK]} in format {found}; this version continues format {FORMAT} "
            "alone. Begin again with --overwrite"
        )
    if stored["kind"] != kind:
        raise UserError(f"{folder}: is a {stored['kind']} run, not a {kind} run")
    differing = [d for d in differences(stored["config"], wanted) if d[0] not in volatile]
    if differing:
        listed = "; ".join(f"{name} was {old!r}, now {new!r}" for name, old, new in differing)
        raise UserError(f"{folder}: cannot resume with another configuration: {listed}")


def _empty(folder: Path) -> None:
    """Delete the content of a folder that `_check_ours` accepted, its mark last; links are removed, never followed."""
    for path in sorted(folder.iterdir(), key=lambda p: p.name == CONFIG):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        elif path.name != _LOCK:
            path.unlink()
