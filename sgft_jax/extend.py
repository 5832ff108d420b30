"""Impure: tasks and methods of the user's own, named by a Python file or a module instead of a name of ours."""

import importlib
import importlib.util
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

from sgft_jax.types import UserError


def is_source(name: str) -> bool:
    """Whether a name means a file (`path/to/mine.py`) or a module (`package.mine`): ours have no dots."""
    return "." in name


def name_of(source: str) -> str:
    """`mine` for `path/to/mine.py` and for `package.mine`; a name without dots is its own."""
    return Path(source).stem if source.endswith(".py") else source.rpartition(".")[2]


def load(kind: str, source: str, attribute: str) -> ModuleType:
    """The module of a file or of a dotted name, executed once per process; it must define `attribute`.

    kind: what it should hold, for messages. Raises UserError if there is no such file or module, if it fails (naming
    file and line, the traceback as its cause), or if it lacks the attribute.
    """
    module = run(kind, source, lambda: _from_file(Path(source)) if source.endswith(".py") else _module(kind, source))
    if not hasattr(module, attribute):
        raise UserError(f"{kind} {source}: does not define `{attribute}`; see docs/extending.md")
    return module


def run[T](kind: str, source: str, function: Callable[[], T]) -> T:
    """What a function of the user's file or module returns; a UserError, one line, for whatever it raises.

    A name of ours keeps its traceback.
    """
    try:
        return function()
    except UserError:
        raise
    except SyntaxError as error:
        raise UserError(f"{kind} {source}: {error.msg} in line {error.lineno} of {error.filename}") from error
    except Exception as error:
        if not is_source(source):
            raise
        if isinstance(error, OSError) and error.filename == source:
            raise UserError(f"{kind} {source}: {error.strerror}") from None
        said = (str(error).strip() or "no message").splitlines()[0]
        raise UserError(f"{kind} {source}: {_place(source, error)}{type(error).__name__}: {said}") from error


def _place(source: str, error: Exception) -> str:
    """Where it failed: the line of the user's file, or the file and line of what it imports."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if source.endswith(".py") and Path(frame.filename) == Path(source).resolve()]
    if own:
        return f"line {own[-1].lineno}: "
    return f"{frames[-1].filename}, line {frames[-1].lineno}: "


def _module(kind: str, source: str) -> ModuleType:
    try:
        return importlib.import_module(source)
    except ModuleNotFoundError as error:
        if source != error.name and not source.startswith(f"{error.name}."):
            raise  # it is there, what it imports is not
        raise UserError(f"{kind} {source}: there is no module {error.name!r}; a file is named with its .py") from None


def _from_file(path: Path) -> ModuleType:
    name = str(path.resolve())  # no other module can be called that
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
