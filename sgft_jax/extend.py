"""Impure: tasks and methods of the user's own, named by a Python file or a module instead of a name of ours."""

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from sgft_jax.types import UserError


def is_source(name: str) -> bool:
    """Whether a name means a file (`path/to/mine.py`) or a module (`package.mine`): ours have no dots."""
    return "." in name


def name_of(source: str) -> str:
    """`mine` for `path/to/mine.py` and for `package.mine`; a name without dots is its own."""
    return Path(source).stem if source.endswith(".py") else source.rpartition(".")[2]


def load(kind: str, source: str, attribute: str) -> ModuleType:
    """The module of a file or of a dotted name, executed once per process; it must define `attribute`.

    kind: what it should hold, for messages. Raises UserError if there is no such file or module, if it fails, or if it
    lacks the attribute.
    """
    module = guard(kind, source, _from_file if source.endswith(".py") else _module)(source)
    if not hasattr(module, attribute):
        raise UserError(f"{kind} {source}: does not define `{attribute}`; see docs/extending.md")
    return module


def guard[T](kind: str, source: str, function: Callable[..., T]) -> Callable[..., T]:
    """The same function of the user's file or module; whatever it raises is a UserError that names file and line.

    Under `jax.jit` this holds while it is traced. The traceback stays as the error's cause.
    """

    def guarded(*args: Any) -> T:
        try:
            return function(*args)
        except UserError:
            raise
        except SyntaxError as error:
            raise UserError(f"{kind} {source}: {error.msg} in line {error.lineno} of {error.filename}") from error
        except Exception as error:
            if isinstance(error, OSError) and error.filename == str(Path(source).resolve()):
                raise UserError(f"{kind} {source}: {error.strerror}") from None
            said = (str(error).strip() or "no message").splitlines()[0]
            raise UserError(f"{kind} {source}: {_place(source, error)}: {type(error).__name__}: {said}") from error

    return guarded


def _place(source: str, error: Exception) -> str:
    """Where it failed: the line of the user's file, or file and line of what it called."""
    own = str(Path(source).resolve()) if source.endswith(".py") else getattr(sys.modules.get(source), "__file__", None)
    frames = traceback.extract_tb(error.__traceback__)
    if lines := [frame.lineno for frame in frames if frame.filename == own]:
        return f"line {lines[-1]}"
    return f"{frames[-1].filename}, line {frames[-1].lineno}"


def _module(source: str) -> ModuleType:
    try:
        return importlib.import_module(source)
    except ModuleNotFoundError as error:
        if source != error.name and not source.startswith(f"{error.name}."):
            raise  # it is there, what it imports is not
        raise UserError(f"there is no module {error.name!r}; a file is named with its .py") from None


def _from_file(source: str) -> ModuleType:
    name = str(Path(source).resolve())  # no other module can be called that
    if name in sys.modules:
        return sys.modules[name]
    spec = importlib.util.spec_from_file_location(name, name)
    assert spec is not None and spec.loader is not None  # as for any name that ends in .py
    sys.modules[name] = module = importlib.util.module_from_spec(spec)
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module
