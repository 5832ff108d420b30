"""Impure: what every command shares: parsing, error messages, exit codes, caches, quiet logs. Imports nothing heavy."""

import contextlib
import dataclasses
import difflib
import errno
import io
import itertools
import logging
import os
import re
import select
import signal
import sys
import threading
import traceback
import types
import typing
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Annotated, Any, NoReturn, cast

import tyro

# What went wrong, as data. Not yet a public part of tyro (pyproject.toml keeps to versions that have it); the
# alternative is to read the frames that it draws.
from tyro import _errors

from envs.types import UserError, unknown
from experiments.runner import progress
from sgft_jax.io import runs

Json = Annotated[bool, tyro.conf.arg(help="Print one JSON object and nothing else.")]

BROKEN_PIPE, USER_ERROR = 1, 2
_SIGNALS: dict[int, str] = {signal.SIGINT: "interrupted", signal.SIGTERM: "terminated", signal.SIGHUP: "hung up"}
_IN_ORDER: list[str] = []  # what must come to an end before the process does
# Lets XLA use Triton for any matrix product, and run kernels of a CUDA graph beside each other.
_FLAGS = ("--xla_gpu_triton_gemm_any=true", "--xla_gpu_command_buffer_scheduling_mode=CONCURRENT")
_CPU_FLAGS = ("--xla_backend_optimization_level=1",)  # compiles in two thirds of the time and runs as fast
_NO_SPACE = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
_BAD_PATH = (errno.EEXIST, errno.ENOTDIR, errno.EISDIR, errno.ENAMETOOLONG, errno.ELOOP)
_ON_DISK = (*_NO_SPACE, *_BAD_PATH, errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.EMFILE, errno.ENFILE)


class Stopped(KeyboardInterrupt):
    """A signal that asks the process to end: handled as Ctrl-C is. number: of the signal."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number


def run_main[T](
    main: Callable[[T], object],
    config_type: type[T],
    description: str,
    *,
    argv: Sequence[str] | None = None,
    default: Callable[[Sequence[str]], T] | None = None,
) -> None:
    """Parse the command line into `config_type` and call `main` with it.

    default(argv) -> the defaults of the options where some decide those of others, see `preview`.
    Exits with code 2 and one line `error: ...` on stderr for anything the user can mend (`UserError`, unknown options
    or choices, a device without room), with 130 after Ctrl-C, 143 after SIGTERM and 129 after SIGHUP, as shells count,
    with 1 and no message if the reader of its output has gone, as after `| head`. Other exceptions are bugs and keep
    their traceback.
    """
    with may_lose_its_reader(), _stopped_by_signals(config_type) as signals:
        try:
            words = list(sys.argv[1:] if argv is None else argv)
            start = None if default is None else default(words)
            config = parse(config_type, description, words, default=start)  # a dataclass may refuse its values
            set_up()
            _quiet_threads()
            if isinstance(sys.stdout, io.TextIOWrapper):
                sys.stdout.reconfigure(line_buffering=True)  # a log shows at once what a terminal would
            with progress.never_silent():
                main(config)
        except KeyboardInterrupt as stopped:
            _stop(getattr(stopped, "number", signal.SIGINT), config_type)
        except UserError as error:
            fail(str(error))
        except Exception as error:
            if signals:  # raised in a function that JAX called, which makes an error of its own of it
                _stop(signals[0], config_type)
            if reason := _disk_trouble(error):
                again = _has_resume(config_type) and _in_a_run(error)
                fail(f"{reason}; mend that, then {'the same command with --resume goes on' if again else 'try again'}")
            if _in_renderer_choice(error):
                chosen = f"MUJOCO_GL={os.environ['MUJOCO_GL']}"
                fail(f"{chosen}: MuJoCo cannot use that here ({error}); unset it, or set it to disable")
            if isinstance(error, ValueError) and " for environment 'JAX_" in str(error):  # as JAX is imported
                fail(f"{error}; unset it")
            if not isinstance(error, MemoryError) and "RESOURCE_EXHAUSTED" not in str(error):  # JAX's word for it
                raise
            reason = (str(error).strip() or "MemoryError").splitlines()[0]
            fail(f"out of memory ({reason}): lower the batch size, the number of environments or of seeds")


def _stop(number: int, config_type: type) -> NoReturn:
    """Ends the process after a signal."""
    if progress.compiling():  # in threads that Python would wait for
        _end_now(number, _farewell(number, config_type))
    progress.say(_farewell(number, config_type))
    sys.exit(128 + number)


def _disk_trouble(error: BaseException | None) -> str | None:
    """What is wrong where a file could not be read or written; also as the cause of another error. Else None."""
    if isinstance(error, OSError) and error.errno in _ON_DISK:
        return f"{error.filename or 'a file of the run'}: {(error.strerror or 'cannot be written').lower()}"
    full = map(os.strerror, _NO_SPACE)  # "No space left on device"
    if words := [text for text in full if text in str(error)]:  # Orbax has another type for it
        return f"a file of the run: {words[0].lower()}"
    return None if error is None else _disk_trouble(error.__cause__)


def _has_resume(config_type: type) -> bool:
    return any(field.name == "resume" for field in dataclasses.fields(config_type))


def _in_a_run(error: Exception) -> bool:
    """Whether what went wrong with a file lies in a run folder, as far as the error says where."""
    if (place := getattr(error, "filename", None)) is None:
        return True
    return any(os.path.exists(folder / "config.json") for folder in Path(str(place)).absolute().parents)


def _in_renderer_choice(error: Exception) -> bool:
    """Whether MuJoCo could not even be imported with the renderer that the user's MUJOCO_GL names."""
    frames = traceback.extract_tb(error.__traceback__)
    return bool(os.environ.get("MUJOCO_GL")) and any(frame.filename.endswith("gl_context.py") for frame in frames)


@contextlib.contextmanager
def _stopped_by_signals(config_type: type) -> Iterator[list[int]]:
    """Ctrl-C, SIGTERM and SIGHUP raise `Stopped`, where nobody has said otherwise (as `nohup` does).

    Yields the numbers of those that have come.

    The main thread hears nothing while it compiles or while a compiled program runs. The process then ends all the same
    after a second, unless a robot is at work; with a second signal it ends at once.
    """
    heard, numbers = threading.Event(), list[int]()

    def stop(number: int, frame: object) -> NoReturn:
        heard.set()
        numbers.append(number)
        raise Stopped(number)

    before = {number: signal.getsignal(number) for number in _SIGNALS}
    asked = [number for number, handler in before.items() if handler in (signal.SIG_DFL, signal.default_int_handler)]
    if not asked or threading.current_thread() is not threading.main_thread():  # no other may handle signals
        yield numbers
        return
    pipe, tell = os.pipe()
    os.set_blocking(tell, False)
    threading.Thread(target=_end_in_time, args=(pipe, asked, heard, config_type), daemon=True).start()
    wakeup = signal.set_wakeup_fd(tell, warn_on_full_buffer=False)
    for number in asked:
        signal.signal(number, stop)
    try:
        yield numbers
    finally:
        for number in asked:
            signal.signal(number, before[number])
        signal.set_wakeup_fd(wakeup)
        os.close(tell)


def _end_in_time(pipe: int, asked: Sequence[int], heard: threading.Event, config_type: type) -> None:
    """Ends the process at the second of these signals, or a second after the first that the main thread has not heard.

    Nothing of a run is lost: what is on disk is whole, and what is not would be given up all the same.
    """
    with open(pipe, "rb", buffering=0) as signals:
        numbers = (byte[0] for byte in iter(lambda: signals.read(1), b"") if byte[0] in asked)
        first = next(numbers, None)
        if first is not None and not heard.wait(1.0):
            if not _IN_ORDER:
                _end_now(first, _farewell(first, config_type))
            waits = f"waiting for {_IN_ORDER[-1]} until this is done: {progress.phase()}"
            progress.say(f"\n{_SIGNALS[first]}: {waits}; a second signal ends the process at once")
        if (second := next(numbers, None)) is not None:
            _end_now(second)


def in_order(what: str) -> None:
    """From now on a signal ends the process only when Python is able to bring this to an end, such as a robot."""
    _IN_ORDER.append(what)


def _end_now(number: int, words: str = "") -> NoReturn:
    """Ends the process whatever it does, and those that would end with it."""
    progress.leave_terminal()
    if (processes := sys.modules.get("multiprocessing")) is not None:
        for process in processes.active_children():
            process.kill()
    progress.say(words or f"\n{_SIGNALS[number]}")
    os._exit(128 + number)


def _farewell(number: int, config_type: type) -> str:
    """What is said of a command that a signal has ended."""
    return "; ".join([f"\n{_SIGNALS[number]}", *(runs.outlook() if _has_resume(config_type) else ())])


class _Quiet:
    """What Python calls with an error that nobody catches, but for a disk that is full: the main thread says that."""

    def __init__(self, hook: Callable[..., object]) -> None:
        self.hook = hook

    def __call__(self, failed: Any) -> None:
        """failed: one object that begins with type and error."""
        _, error, *_ = failed
        # The second one is a checkpoint's writer that reports to a loop which has given up; it goes on after `main`.
        if _disk_trouble(error) is None and str(error) != "Event loop is closed":
            self.hook(failed)


def _quiet_threads() -> None:
    """Libraries write in threads of their own, each of which would print its own traceback."""
    if not isinstance(threading.excepthook, _Quiet):
        threading.excepthook = _Quiet(threading.excepthook)
    if not isinstance(sys.unraisablehook, _Quiet):
        sys.unraisablehook = _Quiet(sys.unraisablehook)


@contextlib.contextmanager
def may_lose_its_reader() -> Iterator[None]:
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
    """A frozen dataclass from the command line; raises UserError for a bad one."""
    words = list(sys.argv[1:] if argv is None else argv)
    with _errors.on_parse_error(lambda event: _refuse(event, words, config_type, default)):
        return cast(
            T,
            tyro.cli(config_type, prog=_program(words), description=as_typed(description), args=words, default=default),
        )


def _program(words: Sequence[str]) -> str | None:
    """What a user types before `words`: `sgft NAME` where that script was started; None for tyro's own guess."""
    if (spec := getattr(sys.modules["__main__"], "__spec__", None)) is None:
        return None
    command = as_typed(f"python -m {spec.name}")
    before = len(sys.argv) - len(words)
    kind = sys.argv[1:before] if sys.argv[before:] == list(words) else []  # such as `hybrid` of `compare hybrid`
    return " ".join([command, *kind])


def as_typed(text: str) -> str:
    """The text with its commands as a user types them: `sgft NAME` where that script was started."""
    by_script = any(Path(word).stem == "sgft" for word in sys.orig_argv[1:3])  # the second one behind an option
    return re.sub(r"python -m experiments\.(?!studies\b)", "sgft ", text) if by_script else text


def preview(argv: Sequence[str], **defaults: Any) -> SimpleNamespace:
    """The values of the options that decide the defaults of all others; what else is in `argv` is left to `parse`.

    defaults: by name with underscores, e.g. preset="fast". Raises UserError for a bad value.
    """
    fields = [(name, type(value), dataclasses.field(default=value)) for name, value in defaults.items()]
    chosen = dataclasses.make_dataclass("Options", fields)
    with _errors.on_parse_error(lambda event: _refuse(event, argv, chosen, None)):
        values, _ = tyro.cli(chosen, args=list(argv), return_unknown_args=True, add_help=False)
    return SimpleNamespace(**vars(values))


def _refuse(event: _errors.ParseErrorEvent, argv: Sequence[str], config_type: type, default: Any) -> None:
    """Raise UserError with what is wrong in one line; other kinds of mistakes in tyro's words."""
    match event:
        case _errors.UnrecognizedArgs(tokens=[first, *_]) | _errors.MissingArgs(unrecognized_tokens=[first, *_]):
            raise UserError(_unexpected(first, option_names(config_type, default)))
        case _errors.MissingArgs():
            missing = [one.arg.display_name() for one in event.missing_arguments]
            raise UserError(f"{' and '.join(missing)} {'are' if len(missing) > 1 else 'is'} missing; see --help")
        case _errors.InvalidChoice():
            raise UserError(unknown(event.argument.display_name(), event.value, event.choices))
        case _errors.BadValue(reason="too_few_values"):
            raise UserError(f"{event.argument.display_name()}: needs a value")
        case _errors.InstantiationFailure():
            raise UserError(_bad_value(event, argv))


def _unexpected(word: str, options: Sequence[str]) -> str:
    """What to say of a word that is no option, or no value of one."""
    if not word.startswith("-"):
        return f"unexpected word {word!r} on the command line; options begin with --"
    option = word.partition("=")[0].replace("_", "-")
    if option in options:
        return f"{option} is no option here: give its value alone"
    close = difflib.get_close_matches(option, options, n=1)
    return f"there is no option {option}; {f'did you mean {close[0]}?' if close else '--help lists them all'}"


def _bad_value(event: _errors.InstantiationFailure, argv: Sequence[str]) -> str:
    """What is wrong with the value of an option, as far as tyro knows which."""
    message = event.message.strip().splitlines()[0]
    if event.argument is None:
        return message
    option, kind = event.argument.display_name(), _in_words(event.argument.field.type_stripped)
    return f"{' '.join([option, *_given(option, argv)])}: must be {kind or f'something else ({message})'}"


def _in_words(hint: Any) -> str:
    """What values of a type are called, "" where there is no word for them."""
    words = {int: "a whole number", float: "a number", types.NoneType: "None"}
    if typing.get_origin(hint) is tuple:
        return {int: "whole numbers", float: "numbers"}.get(typing.get_args(hint)[0], "")
    if parts := typing.get_args(hint):  # a union
        words = [_in_words(part) for part in parts]
        return " or ".join(words) if all(words) else ""
    return words.get(hint, "")


def _given(option: str, argv: Sequence[str]) -> list[str]:
    """The values of an option on a command line, of the last one if it is there several times."""
    values: list[str] = []
    for i, word in enumerate(argv):
        name, _, value = word.partition("=")
        if name.startswith("--") and name.replace("_", "-") == option:
            following = itertools.takewhile(lambda word: not word.startswith("--"), argv[i + 1 :])
            values = [*filter(None, [value]), *following]
    return values


def option_names(config_type: type, default: Any = None, *, prefix: str = "--") -> list[str]:
    """`--task`, `--config.batch-size`, ...: the options of a dataclass and of those in it."""
    hints, names = typing.get_type_hints(config_type), []
    for one in dataclasses.fields(config_type):
        value = getattr(default, one.name, None)
        kind = type(value) if dataclasses.is_dataclass(value) else hints[one.name]
        name = prefix + one.name.replace("_", "-")
        names += option_names(kind, value, prefix=f"{name}.") if dataclasses.is_dataclass(kind) else [name]
    return names


def fail(message: str) -> NoReturn:
    """End the process as every user error does."""
    print(f"error: {as_typed(message)}", file=sys.stderr)
    sys.exit(USER_ERROR)


def columns(rows: Sequence[Sequence[str]]) -> list[str]:
    """A line for each row of a table, cells of a column below each other."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def choose[V](kind: str, name: str, options: dict[str, V]) -> V:
    """`options[name]`; raises UserError with the closest match and the list of what exists."""
    if name in options:
        return options[name]
    raise UserError(unknown(kind, name, options))


def set_up() -> None:
    """Compilation cache, flags of XLA and quiet logs; before JAX starts. What the user has set stays."""
    if cache := cache_folder():
        os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(cache))
        # Small programs too: a command compiles hundreds, at 25 ms each.
        os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0")
        if (jax := sys.modules.get("jax")) and jax.config.jax_compilation_cache_dir is None:
            jax.config.update("jax_compilation_cache_dir", str(cache))  # it was imported before the environment was set
    for flag in _FLAGS if Path("/dev/nvidiactl").exists() else (*_FLAGS, *_CPU_FLAGS):
        if flag.partition("=")[0] not in os.environ.get("XLA_FLAGS", ""):
            os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} {flag}".strip()
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")  # the C++ logs of XLA
    for name in ("jax", "tensorboardX"):
        logging.getLogger(name).setLevel(logging.ERROR)
    for name in ("absl", "asyncio", "orbax"):  # they log the errors that they raise, with a traceback
        logging.getLogger(name).setLevel(logging.CRITICAL)


def cache_folder() -> Path | None:
    """Where compiled programs are kept: $SGFT_CACHE_DIR, by default ~/.cache/sgft_jax/jax; None if it is "off"."""
    chosen = os.environ.get("SGFT_CACHE_DIR", "")
    if chosen.lower() in ("off", "none", "0"):
        return None
    return Path(chosen) if chosen else Path.home() / ".cache" / "sgft_jax" / "jax"
