"""Runs command lines one after another, as `python -m experiments.<command>` would; no test itself.

stdin: JSON rows {"command": text, "files": {path: text}}. stdout: for every row a line of JSON, what it did, and what
it made, changed or removed in the current folder. argv: `apart` gives every row a process of its own that may import
nothing HEAVY; without it the rows share this one.
"""

import contextlib
import gc
import json
import os
import runpy
import shlex
import signal
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

PATIENCE = 40  # seconds for a row: what waits for ever is reported, too
HEAVY = ("jax", "flax", "mujoco", "matplotlib", "scipy", "orbax")


def run(command, files):
    """What a row did."""
    for name, text in files.items():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_bytes(text.encode("utf-8", "surrogateescape"))
    before = contents()
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        with standing_for(out, err):
            code = call(shlex.split(command))
        out.seek(0), err.seek(0)
        said = {"out": out.read().decode(errors="replace"), "err": err.read().decode(errors="replace")}
    changed = sorted({name for name, _ in before ^ contents()})
    return {"code": code, **said, "changed": changed}


def run_apart(command, files):
    """The same in a process of its own."""
    if child := os.fork():
        os.waitpid(child, 0)
        return
    print(json.dumps(run(command, files)), flush=True)
    os._exit(0)


def call(words):
    """The exit code of a command."""
    sys.argv = words
    signal.alarm(PATIENCE)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # runpy wonders about modules that are imported already
            runpy.run_module(f"experiments.{words[0]}", run_name="__main__", alter_sys=True)
        return 0
    except SystemExit as stopped:
        return stopped.code or 0
    except BaseException:
        traceback.print_exc()
        return 1
    finally:
        signal.alarm(0)


@contextlib.contextmanager
def standing_for(out, err):
    """Files in place of stdout and stderr, for what is written past Python as well."""
    sys.stdout.flush(), sys.stderr.flush()
    kept = [os.dup(number) for number in (1, 2)]
    os.dup2(out.fileno(), 1), os.dup2(err.fileno(), 2)
    try:
        yield
    finally:
        sys.stdout.flush(), sys.stderr.flush()
        for number, copy in zip((1, 2), kept, strict=True):
            os.dup2(copy, number), os.close(copy)


def contents():
    """Every file and folder below the current one, with what changes when it is written."""
    return {
        (str(path), (facts.st_ino, facts.st_size, 0 if path.is_dir() else facts.st_mtime_ns))
        for path in Path().rglob("*")
        for facts in [path.lstat()]
    }


def forget(files):
    """Removes the files of a row, and the folders that were made for them."""
    for name in files:
        Path(name).unlink(missing_ok=True)
        for folder in list(Path(name).parents)[:-1]:
            with contextlib.suppress(OSError):  # it holds more
                folder.rmdir()


def give_up(*_):
    raise TimeoutError(f"no answer within {PATIENCE} s")


if __name__ == "__main__":
    sys.dont_write_bytecode = True
    signal.signal(signal.SIGALRM, give_up)
    rows, apart = json.load(sys.stdin), "apart" in sys.argv
    if apart:
        sys.modules |= dict.fromkeys(HEAVY)  # an import of one of them fails
        for name in {row["command"].split()[0] for row in rows}:
            run(f"{name} --no-such-option", {})  # what the rows then share: imports, what tyro knows of the options
        gc.freeze()
    for row in rows:
        if apart:
            run_apart(**row)
        else:
            print(json.dumps(run(**row)), flush=True)  # at once: a row that kills the process is then the next one
        forget(row["files"])
