"""Runs command lines one after another in this process, as `python -m experiments.<command>` would; no test itself.

stdin: JSON rows {"words": [command, ...], "files": {path: text}}. stdout: for every row a line of
JSON, what it did. The current
folder is watched: what a command made, changed or removed in it is reported.
"""

import contextlib
import json
import os
import runpy
import signal
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

PATIENCE = 30  # seconds for a row: what waits for ever is reported, too
HEAVY = ("jax", "flax", "mujoco", "matplotlib", "scipy", "orbax")


def run(words, files):
    for name, text in files.items():
        Path(name).parent.mkdir(parents=True, exist_ok=True)
        Path(name).write_bytes(text.encode("utf-8", "surrogateescape"))
    before, heavy = contents(), loaded()
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        with standing_for(out, err):
            code = call(words)
        out.seek(0), err.seek(0)
        said = {"out": out.read().decode(errors="replace"), "err": err.read().decode(errors="replace")}
    changed = sorted(name for name, _ in before ^ contents())
    for name in files:
        Path(name).unlink(missing_ok=True)
    return {"code": code, **said, "changed": changed, "heavy": sorted(loaded() - heavy)}


def call(words):
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


def loaded():
    return {name for name in HEAVY if name in sys.modules}


def give_up(*_):
    raise TimeoutError(f"no answer within {PATIENCE} s")


if __name__ == "__main__":
    signal.signal(signal.SIGALRM, give_up)
    for row in json.load(sys.stdin):
        print(json.dumps(run(**row)), flush=True)  # at once: a row that kills the process is then the next one
