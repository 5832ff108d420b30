"""Impure: `sgft COMMAND ...` and `python -m experiments COMMAND ...`: lists the commands, or runs one."""

import ast
import runpy
import sys
from collections.abc import Sequence
from pathlib import Path

from envs.types import unknown
from experiments.runner.cli import columns, fail, may_lose_its_reader

_RUNS = 'if __name__ == "__main__":'  # what a command ends with


def main(argv: Sequence[str] | None = None) -> None:
    """Runs the command that the first word names; without one, or with --help, prints a line for each.

    Exits with code 2 and one line on stderr where there is no such command.
    """
    name, *words = list(sys.argv[1:] if argv is None else argv) or ["--help"]
    if name in ("-h", "--help"):
        with may_lose_its_reader():
            print("usage: sgft COMMAND [OPTIONS]; sgft COMMAND --help lists the options\n")
            print("\n".join(columns(list(commands().items()))))
        return
    if name not in (known := commands()):
        fail(unknown("command", name, known))
    sys.argv = [sys.argv[0], *words]
    runpy.run_module(f"experiments.{name}", run_name="__main__", alter_sys=True)


def commands() -> dict[str, str]:
    """The first line of each command's description, by name. Nothing is imported."""
    sources = {path.stem: path.read_text(encoding="utf-8") for path in sorted(Path(__file__).parent.glob("[a-z]*.py"))}
    return {
        name: (ast.get_docstring(ast.parse(source)) or "").splitlines()[0]
        for name, source in sources.items()
        if _RUNS in source
    }


if __name__ == "__main__":
    main()
