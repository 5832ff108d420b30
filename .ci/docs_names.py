"""MkDocs hook: fills the list of public names of docs/api.md in, from the docstrings."""

import inspect
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
    module = __import__(package)
    found = [(name, getattr(module, name)) for name in module.__all__]
    for name, sub in list(found):
        if isinstance(sub, ModuleType):
            found += [(f"{name}.{key}", thing) for key, thing in vars(sub).items() if _own(key, thing, sub)]
    return sorted(found)


def summary(thing: Any) -> str:
    """The first sentence of the docstring in one line; nothing for data."""
    if not (inspect.isroutine(thing) or inspect.isclass(thing) or isinstance(thing, ModuleType)):
        return "data"
    text = " ".join((inspect.getdoc(thing) or "").partition("\n\n")[0].split())
    return text.partition(". ")[0].rstrip(".").replace("|", "\\|")


def _own(key: str, thing: Any, module: ModuleType) -> bool:
    written = inspect.isroutine(thing) or inspect.isclass(thing)
    return written and not key.startswith("_") and thing.__module__ == module.__name__
