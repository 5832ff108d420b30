"""Impure: what every command shares: parsing, error messages, exit codes, caches, quiet logs. Imports nothing heavy."""

import contextlib
import importlib
import io
import logging
import os
import re
import select
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NoReturn, cast

import tyro

BROKEN_PIPE, USER_ERROR, INTERRUPTED = 1, 2, 130
_CACHE_VARIABLE = "SGFT_CACHE_DIR"
_RENDER_PROBE = "import mujoco; c = mujoco.GLContext(16, 16); c.make_current(); c.free()"


def run_main[T](
    main: Callable[[T], object],
    config_type: type[T],
    description: str,
    *,
    argv: Sequence[str] | None = None,
    default: T | None = None,
) -> None:
    """Parse the command line into `config_type`, starting from `default`, and call `main` with it.

    Exits with code 2 and one line `error: ...` on stderr for anything the user can mend (`UserError`, unknown options
    or choices), with 130 after an interrupt, with 1 and no word where nobody reads its output any more, as after
    `| head`. Other exceptions are bugs and keep their traceback.
    """
    with _may_lose_its_reader():
        try:
            config = parse(config_type, description, argv, default=default)  # a dataclass may refuse its values
            set_up()
            main(config)
        except KeyboardInterrupt:
            print("\ninterrupted; the same command with --resume continues from the last checkpoint", file=sys.stderr)
            sys.exit(INTERRUPTED)
        except Exception as error:
            from sgft_jax.types import UserError

            if not isinstance(error, UserError):
                raise
            fail(str(error))


@contextlib.contextmanager
def _may_lose_its_reader() -> Iterator[None]:
    """Ends the process without a traceback if stdout is a pipe that is read no more."""
    try:
        try:
            yield
        except SystemExit:
            sys.stdout.flush()  # what Python would do when it exits, where nobody could catch it
            raise
        sys.stdout.flush()
    except BrokenPipeError:
        poll = select.poll()
        poll.register(sys.stdout, 0)
        if not poll.poll(0):
            raise  # it was another pipe: that to a program which writes videos, say
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # for the rest, which is flushed at the exit
        sys.exit(BROKEN_PIPE)


def parse[T](
    config_type: type[T], description: str, argv: Sequence[str] | None = None, *, default: T | None = None
) -> T:
    """A frozen dataclass from the command line; a bad one ends the process with one line and code 2."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return cast(T, tyro.cli(config_type, description=description, args=argv, default=default))
    except SystemExit as stopped:
        if stopped.code not in (None, 0):
            fail(one_line(complaint.getvalue()))
        raise


def fail(message: str) -> NoReturn:
    """End the process as every user error does."""
    print(f"error: {message}", file=sys.stderr)
    sys.exit(USER_ERROR)


def one_line(boxed: str) -> str:
    """The gist of tyro's framed complaint: its first paragraph, with the closest match where it offers some."""
    paragraphs = _paragraphs(boxed)
    from sgft_jax.types import unknown

    message = paragraphs[0] if paragraphs else "bad command line"
    if match := re.search(r"invalid choice '(.*?)' for argument '(.*?)'\. Expected one of \((.*)\)", message):
        value, option, listed = match.groups()
        return unknown(option, value, re.findall(r"'(.*?)'", listed))
    if match := re.search(r"Perhaps you meant:\s*(--[\w.-]+)", " ".join(paragraphs)):
        return f"{message}; did you mean {match.group(1)}?"
    return message


def _paragraphs(boxed: str) -> list[str]:
    """Tyro's complaint, each part on one line and without title and frame, which is not drawn where stdout is ASCII."""
    lines = [line.strip("│ \t") for line in boxed.splitlines() if line.strip() and line[0] not in "╭╰"]
    parts = [[]]
    for line in lines:
        if set(line) <= set("─-"):
            parts.append([])
        else:
            parts[-1].append(line)
    return [" ".join(part) for part in (parts if boxed.startswith("╭") else parts[1:])]


def choose[V](kind: str, name: str, options: dict[str, V]) -> V:
    """`options[name]`; raises UserError with the closest match and the list of what exists."""
    if name in options:
        return options[name]
    from sgft_jax.types import UserError, unknown

    raise UserError(unknown(kind, name, options))


def set_up() -> None:
    """Compilation cache, GPU flags and quiet logs; before JAX starts. What the user has set stays."""
    if cache := cache_folder():
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "1")
        if (jax := sys.modules.get("jax")) and jax.config.jax_compilation_cache_dir is None:
            jax.config.update("jax_compilation_cache_dir", str(cache))  # it was imported before the environment was set
    # Lets XLA use Triton for any matrix product; without effect on a CPU.
    flags = os.environ.get("XLA_FLAGS", "")
    if "xla_gpu_triton_gemm_any" not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} --xla_gpu_triton_gemm_any=true".strip()
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # the C++ logs of XLA
    for name in ("absl", "jax", "orbax", "tensorboardX"):
        logging.getLogger(name).setLevel(logging.ERROR)


def cache_folder() -> Path | None:
    """Where compiled programs are kept: $SGFT_CACHE_DIR, by default ~/.cache/sgft_jax/jax; None if it is "off"."""
    chosen = os.environ.get(_CACHE_VARIABLE, "")
    if chosen.lower() in ("off", "none", "0"):
        return None
    return Path(chosen) if chosen else Path.home() / ".cache" / "sgft_jax" / "jax"


def select_renderer() -> str | None:
    """Make MuJoCo able to render without a screen by setting MUJOCO_GL; None on success, else one line why not.

    Call it only if pictures are wanted: it tries egl and osmesa, each in a process of its own, because a failed attempt
    cannot be undone. A value that the user has set is tried alone.
    """
    chosen = os.environ.get("MUJOCO_GL")
    reasons = []
    for backend in [chosen] if chosen else ["egl", "osmesa"]:
        reason = _probe(backend)
        if reason is None:
            os.environ["MUJOCO_GL"] = backend
            if module := sys.modules.get("mujoco.rendering.classic.gl_context"):
                importlib.reload(module)  # MuJoCo was imported already and has read the old value
            return None
        reasons.append(f"{backend}: {reason}")
    return f"MuJoCo cannot render here ({'; '.join(reasons)}); install libegl1 or libosmesa6"


def _probe(backend: str) -> str | None:
    """None if MuJoCo makes an off-screen context with this backend, else the last line it said."""
    command, environment = [sys.executable, "-c", _RENDER_PROBE], {**os.environ, "MUJOCO_GL": backend}
    try:
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=60)
    except subprocess.TimeoutExpired:
        return "no answer within 60 s"
    if done.returncode == 0:
        return None
    said = [line for line in done.stderr.splitlines() if line.strip()]
    return said[-1].strip()[:120] if said else f"exit code {done.returncode}"
