"""Measure speed, each number next to its reference from the same run.

physics: the step that training takes, with its own domain parameters in every world, controller, observation, reward
and automatic reset, against the bare engine under it, which repeats the same physics.
updates: SAC updates of pretraining, with all its networks, against the same update written by hand in bare JAX.
hybrid: updates of a hybrid run (H2O+ with its simulators), against its update written by hand in bare JAX, alone.
plain: updates of plain SAC, against Stable-Baselines3 and SBX where they are installed.
startup: seconds from the start of a pretraining process to its priors, with empty caches and with filled ones.
finetune: seconds of the whole command, with what the time goes into.
system: a rollout of fine-tuning with its updates, against the same in one compiled program.
devices: pretraining on several devices with as many times the environments and batches (weak scaling), against as many
times one device.
"""

import importlib
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product
from pathlib import Path
from typing import Any, Literal, NamedTuple

from envs.types import UserError
from experiments.runner import cli
from experiments.runner.options import Impl, at_least_one, check_task, each_once, prior_folders, task_of_priors
from experiments.runner.progress import doing
from sgft_jax.io.log import write_summary
from sgft_jax.io.runs import check_folder, provenance
from sgft_jax.methods import get_method
from sgft_jax.models.config import Precision
from sgft_jax.presets import PRESETS

type Part = Literal["physics", "updates", "plain", "hybrid", "startup", "finetune", "system", "devices"]


@dataclass(frozen=True)
class BenchmarkConfig:
    """What to measure."""

    parts: tuple[Part, ...] = ("physics", "updates", "plain")
    """Kinds of measurements."""
    tasks: tuple[str, ...] = ("push", "hammer", "insert")
    """Tasks to measure on, for all parts but updates and plain."""
    worlds: tuple[int, ...] = (1024,)
    """Worlds stepped together; for devices, on each device."""
    impls: tuple[Impl, ...] = ("auto",)
    """Physics engines."""
    control_steps: int = 10
    """Control steps (of 0.2 s) per timed call; at most half an episode."""
    batches: tuple[int, ...] = (256,)
    """Batch sizes of the updates; for devices, on each device."""
    seeds: tuple[int, ...] = (1,)
    """Agents updated, pretrained or fine-tuned together; for hybrid, pairs of a seed and a gap."""
    precisions: tuple[Precision, ...] = ("default",)
    """Precisions of the updates' matrix products on GPUs."""
    width: int = 256
    """Units of both hidden layers of the updates' networks; critics and values of pretraining have LayerNorm."""
    updates: int = 200
    """Updates per timed call."""
    repeats: int = 3
    """Timed calls; the fastest counts."""
    preset: str = "fast"
    """Pretraining preset, for startup and devices."""
    env_steps: int | None = None
    """Environment steps, for startup and for each device in devices; default: the preset's."""
    devices: tuple[int, ...] = (1,)
    """Numbers of devices; all are compared with the smallest."""
    prior: Path | None = None
    """Folder of the priors that finetune and system start from."""
    rollouts: int = 30
    """Real rollouts, for finetune."""
    method: str = "sgft-sac"
    """Method, for finetune."""
    out: Path = Path("runs")
    """The numbers go to <out>/benchmark/summary.json."""


def main(config: BenchmarkConfig) -> dict[Part, list[dict[str, Any]]]:
    """Measures, prints tables, writes the numbers and returns them by kind of measurement."""
    _check(config)
    measured: dict[Part, list[dict[str, Any]]] = {}
    for part in config.parts:
        measured[part] = []
        if part == "physics":
            _check_steps(config)
        for line in _lines(_KINDS[part], config):
            measured[part].append(line)
            print("  ".join(f"{name} {_text(x)}" for name, x in line.items()), flush=True)
    folder = config.out / "benchmark"
    folder.mkdir(parents=True, exist_ok=True)
    path = write_summary(folder, {"provenance": provenance(), **measured})
    for part, lines in measured.items():
        print(f"\n{table(part, lines)}")
    print(f"numbers: {path}")
    return measured


def _check(config: BenchmarkConfig) -> None:
    cli.choose("--preset", config.preset, PRESETS)
    each_once(config, "parts", "tasks", "impls", "precisions")
    for task in config.tasks:
        check_task(task)
    at_least_one(
        config, "control_steps", "width", "updates", "repeats", "worlds", "batches", "seeds", "devices", "rollouts"
    )
    if config.env_steps is not None:
        at_least_one(config, "env_steps")
    check_folder(config.out / "benchmark")
    if "finetune" in config.parts:
        get_method(config.method)
    for part in {"finetune", "system"} & {*config.parts}:
        if config.prior is None:
            raise UserError(f"--parts {part} needs --prior FOLDER, as made by python -m experiments.pretrain")
        for task in config.tasks:
            task_of_priors(prior_folders(config.prior, out=config.out, task=task, preset=config.preset), task)


class _Kind(NamedTuple):
    """A kind of measurements. title: of its table. function: what measures one line or several, in `experiments.bench`.

    axes: argument -> option, all of whose values are combined. options: passed on as they are, by name.
    """

    title: str
    function: str
    axes: dict[str, str]
    options: tuple[str, ...]


_UPDATES = ("width", "updates", "repeats")
_TASK = {"task": "tasks", "impl": "impls"}
_SEEDS = {**_TASK, "seeds": "seeds"}
_DEVICES = {**_TASK, "worlds": "worlds", "batch": "batches"}
_NETWORKS = {"exact": "precisions", "batch": "batches", "seeds": "seeds"}
_KINDS: dict[Part, _Kind] = {
    "physics": _Kind("environments", "physics.speed", {**_TASK, "worlds": "worlds"}, ("control_steps", "repeats")),
    "updates": _Kind("updates of pretraining", "updates.speed", _NETWORKS, _UPDATES),
    "plain": _Kind("updates of plain SAC", "updates.plain_speed", {"batch": "batches"}, _UPDATES),
    "hybrid": _Kind("updates of hybrid runs", "updates.hybrid_speed", {**_TASK, "members": "seeds"}, _UPDATES),
    "startup": _Kind("from command to priors", "startup.to_priors", _SEEDS, ("preset", "env_steps")),
    "finetune": _Kind("fine-tuning", "training.fine_tuning", _SEEDS, ("prior", "rollouts", "method")),
    "system": _Kind("fine-tuning through a real system", "training.through_system", _SEEDS, ("prior", "repeats")),
    "devices": _Kind(
        "pretraining on several devices", "training.weak_scaling", _DEVICES, ("devices", "preset", "env_steps")
    ),
}


def _lines(kind: _Kind, config: BenchmarkConfig) -> Iterator[dict[str, Any]]:
    """The measurements of one kind, one after another."""
    module, _, name = kind.function.partition(".")
    function = getattr(importlib.import_module(f"experiments.bench.{module}"), name)
    options = {option: getattr(config, option) for option in kind.options}
    for values in product(*(getattr(config, option) for option in kind.axes.values())):
        with doing(f"measuring {kind.title}: {', '.join(map(str, values))}"):
            measured = function(**dict(zip(kind.axes, values, strict=True)), **options)
        yield from measured if isinstance(measured, list) else [measured]


def _check_steps(config: BenchmarkConfig) -> None:
    """Raises UserError for timed calls that are longer than half an episode of a task."""
    import envs

    for task in config.tasks:
        if 2 * config.control_steps > envs.scene(task).episode_length:
            raise UserError(f"--control-steps {config.control_steps} is more than half an episode of {task}")


def table(part: Part, lines: list[dict[str, Any]]) -> str:
    """The lines of one kind as a table."""
    from sgft_jax.analysis import tables

    names = list(dict.fromkeys(name for line in lines for name in line))
    rows = [[_text(line.get(name, "-")) for name in names] for line in lines]
    return f"{_KINDS[part].title}\n\n{tables.markdown([name.replace('_', ' ') for name in names], rows)}\n"


def _text(x: Any) -> str:
    if isinstance(x, float):
        return f"{x:,.0f}" if x >= 1000 else f"{x:.3g}"
    return f"{x:,}" if isinstance(x, int) else str(x)


if __name__ == "__main__":
    cli.run_main(main, BenchmarkConfig, __doc__ or "")
