"""MkDocs hook: fills the list of public names of docs/api.md in, from the docstrings."""

import importlib
import inspect
from collections.abc import Iterator
from types import ModuleType
from typing import Any

MARK = "<!-- public names -->"
PACKAGES = ("sgft_jax", "envs")


def on_page_markdown(markdown: str, **_: Any) -> str:
    """The page with the tables in the place of the mark."""
    return markdown.replace(MARK, "\n\n".join(map(table, PACKAGES))) if MARK in markdown else markdown


def table(package: str) -> str:
    """A table of the public names of a package, each with the first sentence of its docstring."""
    lines = [f"| `{package}.{name}` | {summary(thing)} |" for name, thing in public(package)]
    return "\n".join([f"### {package}", "", "| name | what it is |", "| --- | --- |", *lines])


def public(package: str) -> list[tuple[str, Any]]:
    """The public names of a package with what they stand for; of its public modules, what they define themselves."""
    return sorted(_members(importlib.import_module(package), ""))


def _members(module: ModuleType, prefix: str) -> Iterator[tuple[str, Any]]:
    package = hasattr(module, "__path__")
    names = (
        module.__all__ if package else [key for key, thing in vars(module).items() if _defined_in(key, thing, module)]
    )
    for name in names:
        thing = getattr(module, name)
        yield prefix + name, thing
        if isinstance(thing, ModuleType):
            yield from _members(thing, f"{prefix}{name}.")


def summary(thing: Any) -> str:
    """The first sentence of the docstring in one line; nothing for data."""
    if not (inspect.isroutine(thing) or inspect.isclass(thing) or isinstance(thing, ModuleType)):
        return "data"
    text = " ".join((inspect.getdoc(thing) or "").partition("\n\n")[0].split())
    return text.partition(". ")[0].rstrip(".").replace("|", "\\|")


def _defined_in(key: str, thing: Any, module: ModuleType) -> bool:
    written = inspect.isroutine(thing) or inspect.isclass(thing)
    return written and not key.startswith("_") and thing.__module__ == module.__name__
