"""What tasks there are; of one task: observation, action, parameters, effects, gaps, with units."""

import ast
import importlib.util
import inspect
import json
import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

import envs
from envs import gaps
from envs.base import Effects, Value
from experiments.runner import cli
from experiments.runner.cli import Json, columns


@dataclass(frozen=True)
class TasksArgs:
    """Lists all tasks, or describes one."""

    task: Annotated[str | None, tyro.conf.Positional] = None
    """One of them, or a Python file with a task of your own (docs/extending.md); default: a list of all."""
    json: Json = False


def main(args: TasksArgs) -> None:
    """Prints what is asked for."""
    facts = listing() if args.task is None else describe(args.task)
    lines = _list_lines if args.task is None else _task_lines
    print(json.dumps(facts) if args.json else "\n".join(lines(facts)))


def listing() -> dict[str, Any]:
    """All tasks with what they are about and their gaps. Imports none of them."""
    return {
        name: {"about": _first_line(module), "gaps": list(gaps.presets(name))} for name, module in envs.TASKS.items()
    }


def describe(task: str) -> dict[str, Any]:
    """One task as JSON data. A task in MuJoCo is not compiled for it."""
    name = envs.name_of(task)
    env: Any = envs.scene(task) or envs.make(task)  # both have the fields below
    sizes = {"act_dim": sum(e.size for e in env.action), "measured_dim": sum(e.size for e in env.observation)}
    return {
        "name": name,
        "about": _first_line(envs.TASKS[name]),
        **{field: [e._asdict() for e in getattr(env, field)] for field in ("observation", "action")},
        **{field: getattr(env, field) for field in ("control_dt", "episode_length", "score", "success_anytime")},
        # JSON has no infinity: no bound is null.
        "parameters": [
            {k: None if x in (math.inf, -math.inf) else x for k, x in p._asdict().items()} for p in env.parameters
        ],
        "effects": _effects(env.training, sizes, cartesian=env.cartesian),
        "gaps": {
            name: {k: x for k, x in gap.table.items() if x and k != "name"} for name, gap in gaps.presets(name).items()
        },
    }


def _effects(training: Any, sizes: dict[str, int], *, cartesian: bool) -> list[dict[str, Any]]:
    """Every effect of that task, in the words of `Effects`, and its value in the simulator, None for no effect."""
    doc = inspect.getdoc(Effects) or ""
    effects = []
    for name in Effects._fields if cartesian else [x for x in Effects._fields if x != "action_rotation"]:
        match = re.search(rf"^{name}: \[(\w*)\] (.*(?:\n    .*)*)", doc, re.M)
        assert match is not None  # tested: all of them explain themselves
        about = " ".join(match[2].split()).split(". ")[0].rstrip(".")
        effects.append({"name": name, "size": sizes.get(match[1], 1), "about": about, "simulator": training.get(name)})
    return effects


def _first_line(module: str) -> str:
    """The first sentence of a module's docstring, read without running it."""
    spec = None if module.endswith(".py") else importlib.util.find_spec(module)
    path = module if spec is None else spec.origin
    doc = ast.get_docstring(ast.parse(Path(path or "").read_text())) or "no description."
    return doc.split("\n\n")[0].replace("\n", " ").split(". ")[0].rstrip(".") + "."


# --- for people -----------------------------------------------------------------------------------------------------


def _list_lines(tasks: dict[str, Any]) -> list[str]:
    rows = [("task", "what it is", "gaps")]
    rows += [(name, task["about"], ", ".join(task["gaps"]) or "none") for name, task in tasks.items()]
    return [*columns(rows), "", cli.as_typed("one of them in full: python -m experiments.tasks push")]


def _task_lines(facts: dict[str, Any]) -> list[str]:
    seconds = facts["episode_length"] * facts["control_dt"]
    when = "at any step" if facts["success_anytime"] else "at the last step"
    score = f"success {when}" if facts["score"] == "success" else "return, the sum of rewards"
    parameters = [("parameter", "unit", "nominal", "training range", "bounds")]
    for p in facts["parameters"]:
        drawn = "fixed" if p["low"] == p["high"] else _range(p["low"], p["high"])
        parameters.append((p["name"], p["unit"], f"{p['nominal']:.4g}", drawn, _range(p["minimum"], p["maximum"])))
    effects = [("effect", "numbers", "simulator", "what it does")]
    for e in facts["effects"]:
        effects.append((e["name"], str(e["size"]), _value(e["simulator"]), e["about"]))
    reals = [("gap", "what differs from the simulator")]
    for name, gap in facts["gaps"].items():
        scene = [f"scene {gap['scene']}"] if "scene" in gap else []
        values = {**gap.get("params", {}), **gap.get("effects", {}), **gap.get("commands", {})}
        reals.append((name, "; ".join([*scene, *(f"{k} {_value(v)}" for k, v in values.items())])))
    length = f"{facts['episode_length']} steps of {facts['control_dt']:g} s = {seconds:g} s"
    head = [(part, _entries(facts[part])) for part in ("observation", "action")]
    head += [("episode", length), ("judged by", score)]
    last = columns(reals) if facts["gaps"] else ["no gaps come with this task; write one: docs/extending.md"]
    parts = ([f"{facts['name']}: {facts['about']}"], columns(head), columns(parameters), columns(effects), last)
    return [line for part in parts for line in ("", *part)][1:]


def _entries(entries: Iterable[dict[str, Any]]) -> str:
    return ", ".join(f"{e['name']} [{e['size']}]{f' in {e["unit"]}' if e['unit'] else ''}" for e in entries)


def _range(low: float | None, high: float | None) -> str:
    if low is None:
        return "any" if high is None else f"at most {high:.4g}"
    return f"at least {low:.4g}" if high is None else f"{low:.4g} to {high:.4g}"


def _value(value: Value | None) -> str:
    if value is None:
        return "-"
    if isinstance(value, Mapping):
        return ", ".join(f"{entry} {_value(part)}" for entry, part in value.items())
    return str(value) if isinstance(value, list) else f"{value:g}"


if __name__ == "__main__":
    cli.run_main(main, TasksArgs, __doc__ or "")
