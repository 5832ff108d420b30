"""The options that tuning has chosen, one file for a task and method: read, written, and put into a run's arguments."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict, get_type_hints

from envs import extend, gaps
from envs.files import checked, read_object
from envs.types import UserError
from experiments.runner.finetune_args import FinetuneArgs, with_settings
from sgft_jax.files.disk import write_json
from sgft_jax.methods import get_method

VARIANT = "tuned"


class _Budget(TypedDict):
    reals: list[str]


def path_of(out: Path, task: str, method: str) -> Path:
    """<out>/tuned/<task>/<method>.json, described in docs/formats.md."""
    return out / VARIANT / extend.name_of(task) / f"{get_method(method).name}.json"


def write(out: Path, task: str, method: str, result: Mapping[str, Any]) -> Path:
    """Writes what tuning has found and returns where."""
    path = path_of(out, task, method)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, result)
    return path


def read(out: Path, task: str, method: str) -> dict[str, Any]:
    """What tuning has found; raises UserError, which names the command, if there is no such file."""
    _require(out, task, [method])
    path = path_of(out, task, method)
    again = f"tune again with: {_command(task, [method])}"
    result = read_object(path, {"budget": dict, "options": dict}, again)
    types = get_type_hints(get_method(method).config)
    if unknown := sorted(set(result["options"]) - set(types)):
        raise UserError(f"{path}: there is no option {unknown[0]!r}; {again}")
    checked(path, result["options"], {name: types[name] for name in result["options"]}, again)
    return checked(path, result, {"budget": _Budget}, again)


def _require(out: Path, task: str, methods: Iterable[str]) -> None:
    if absent := [method for method in methods if not path_of(out, task, method).exists()]:
        folder, again = path_of(out, task, absent[0]).parent, _command(task, absent)
        raise UserError(f"--tuned: {folder} holds no options for {', '.join(absent)}; choose them with: {again}")


def _command(task: str, methods: Iterable[str]) -> str:
    return f"python -m experiments.studies.tune --tasks {task} --methods {' '.join(methods)}"


def apply(run: FinetuneArgs) -> FinetuneArgs:
    """The run with the options that tuning has chosen for its task and method, as a variant of its own."""
    return replace(with_settings(run, read(run.out, run.task, run.method)["options"]), variant=VARIANT)


def check_fair(out: Path, task: str, methods: Sequence[str], reals: Sequence[str]) -> None:
    """Raises UserError unless all methods were tuned with the same budget, and on none of the real systems `reals`."""
    _require(out, task, methods)
    budgets = {method: read(out, task, method)["budget"] for method in methods}
    first, *others = budgets
    for other in others:
        if odd := [key for key, value in budgets[first].items() if budgets[other].get(key) != value]:
            listed = ", ".join(f"{key} {budgets[first][key]} and {budgets[other].get(key)}" for key in odd)
            again = _command(task, budgets)
            raise UserError(f"--tuned: {first} and {other} had different budgets ({listed}); tune again with: {again}")
    if seen := sorted({gaps.title(real) for real in reals} & set(budgets[first]["reals"])):
        raise UserError(f"--reals {seen[0]}: the options were tuned there; compare on another, or tune on another")
