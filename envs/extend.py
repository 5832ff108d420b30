"""Impure: tasks and methods of the user's own, named by a Python file or a module instead of a name of ours."""

import ast
import importlib
import importlib.util
import os
import re
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

from envs.types import UserError, brief

_LONGEST = 200  # bytes; file systems allow names of 255
_RESERVED = re.compile(r"(con|prn|aux|nul|com\d|lpt\d)(\..*)?", re.IGNORECASE)  # names of devices on Windows


def is_source(name: str) -> bool:
    """Whether a name means a file (`path/to/mine.py`) or a module (`package.mine`): ours have no dots."""
    return "." in name


def name_of(source: str) -> str:
    """`mine` for `path/to/mine.py` and for `package.mine`; a name without dots is its own."""
    return Path(source).stem if source.endswith(".py") else source.rpartition(".")[2]


def folder_name(what: str, name: str) -> str:
    """The name, if a folder can have it: what comes from outside must not lead out of the folder that it is for.

    what: is called so, for messages. Raises UserError for anything else.
    """
    size = len(name.encode(errors="surrogatepass"))
    if size > _LONGEST:
        raise UserError(f"{what} has {size} bytes: choose a shorter word, it names a folder")
    blank, inside = name != name.strip() or not name, not name.startswith(".") and not set(name) & {"/", "\\"}
    if blank or not inside or not name.isprintable() or _RESERVED.fullmatch(name):
        raise UserError(f"{what} {name!r} cannot name a folder; take letters, digits, '.', '_' and '-', no '.' first")
    return name


def load(kind: str, source: str, attribute: str) -> ModuleType:
    """The module of a file or of a dotted name, executed once per process; it must define `attribute`.

    kind: what it should hold, for messages. Raises UserError if there is no such file or module, if it fails, or if it
    lacks the attribute.
    """
    folder_name(f"{kind} {source}: the name", name_of(source))
    if source.endswith(".py") and os.path.lexists(source) and not Path(source).is_file():
        raise UserError(f"{kind} {source}: is no plain file")
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
        except (UserError, KeyboardInterrupt):
            raise
        except SyntaxError as error:
            place = f" in line {error.lineno} of {error.filename}" if error.lineno else ""
            raise UserError(f"{kind} {source}: {error.msg}{place}") from error
        except BaseException as error:  # `sys.exit` too: a file that is read must not end the command
            if isinstance(error, OSError) and error.filename == str(Path(source).resolve()):
                raise UserError(f"{kind} {source}: {error.strerror}") from None
            where = f"{kind} {source}: {_place(source, error)}"
            raise UserError(f"{where}: {type(error).__name__}: {brief(error)}") from error

    return guarded


def line_of(module: ModuleType, attribute: str) -> str:
    """Where the file of a module defines an attribute, "line 3", "" where that cannot be seen."""
    try:
        nodes = ast.parse(Path(module.__file__ or "").read_bytes()).body
    except (OSError, SyntaxError, ValueError):
        return ""
    lines = [
        node.lineno
        for node in nodes
        for target in (node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)])
        if isinstance(target, ast.Name) and target.id == attribute
    ]
    return f"line {lines[-1]}" if lines else ""


def _place(source: str, error: BaseException) -> str:
    """Where it failed: the line of the user's file, or file and line of what it called."""
    file = str(Path(source).resolve()) if source.endswith(".py") else getattr(sys.modules.get(source), "__file__", None)
    frames = traceback.extract_tb(error.__traceback__)
    if lines := [frame.lineno for frame in frames if frame.filename == file]:
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
