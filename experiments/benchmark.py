"""Measure speed, each number next to its reference from the same run.

physics: the step that training takes, with its own domain parameters in every world, controller, observation, reward
and automatic reset, against the bare engine under it, which repeats the same physics.
updates: SAC updates of pretraining, with all its networks, against the same update written by hand in bare JAX.
plain: updates of plain SAC, against Stable-Baselines3 and SBX where they are installed.
values: V_sim of priors and the rewards that it shapes in each precision, against float32.
pretrain, finetune: seconds of the whole commands, with what the time goes into.
devices: pretraining on several devices with as many times the environments and batches (weak scaling), against as many
times one device.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

from rich.console import Console
from rich.table import Table

import envs
from envs.mujoco.worlds import Impl, choose_impl
from experiments import cli
from experiments.bench import physics, training, updates, values
from sgft_jax.analysis import figures
from sgft_jax.io import runs
from sgft_jax.io.log import write_summary
from sgft_jax.models.networks import Precision
from sgft_jax.presets import PRESETS
from sgft_jax.types import UserError

type Part = Literal["physics", "updates", "plain", "values", "pretrain", "finetune", "devices"]


@dataclass(frozen=True)
class BenchmarkConfig:
    """What to measure."""

    parts: tuple[Part, ...] = ("physics", "updates", "plain")
    """Kinds of measurements."""
    tasks: tuple[str, ...] = ("push", "hammer", "insert")
    """Tasks, of all but updates and plain."""
    worlds: tuple[int, ...] = (1024,)
    """Worlds stepped together; in devices, by each device."""
    impls: tuple[Impl, ...] = ("auto",)
    """Engines of physics."""
    control_steps: int = 10
    """Control steps (of 0.2 s) per timed call; at most half an episode."""
    batches: tuple[int, ...] = (256,)
    """Batch sizes of the updates; in devices, of each device."""
    seeds: tuple[int, ...] = (1,)
    """Agents updated, pretrained or fine-tuned together."""
    precisions: tuple[Precision, ...] = ("default",)
    """Precisions of matrix products on GPUs, of updates and values."""
    width: int = 256
    """Units of both hidden layers of the updates' networks; critics and values of pretraining have LayerNorm."""
    updates: int = 200
    """Updates per timed call."""
    repeats: int = 3
    """Timed calls; the fastest counts."""
    preset: str = "fast"
    """Of pretrain and devices."""
    env_steps: int | None = None
    """Of pretrain, and of each device in devices; default: the preset's."""
    devices: tuple[int, ...] = (1,)
    """Numbers of devices; the smallest is what the others are compared with."""
    prior: Path | None = None
    """Folder of the priors that finetune starts from and values evaluates."""
    rollouts: int = 30
    """Of finetune."""
    out: Path = Path("runs")
    """The numbers go to <out>/benchmark/summary.json, figures beside them."""


def main(config: BenchmarkConfig) -> dict[str, list[dict[str, Any]]]:
    """Measures, prints tables, writes the numbers and returns them by kind of measurement."""
    _check(config)
    measured: dict[str, list[dict[str, Any]]] = {}
    for part in config.parts:
        measured[part] = []
        for line in _PARTS[part](config):
            measured[part].append(line)
            print("  ".join(f"{name} {_text(x)}" for name, x in line.items()), flush=True)
    folder = config.out / "benchmark"
    folder.mkdir(parents=True, exist_ok=True)
    path = write_summary(folder, {"provenance": runs.provenance(), **measured})
    for part, lines in measured.items():
        Console().print(table(part, lines))
        if figure := draw(part, lines, folder / f"{part}.png"):
            print(f"figure: {figure}")
    print(f"numbers: {path}")
    return measured


def _check(config: BenchmarkConfig) -> None:
    cli.choose("--preset", config.preset, PRESETS)
    for task in config.tasks:
        envs.name_of(task)
        if "physics" in config.parts and 2 * config.control_steps > envs.scene(task).episode_length:
            raise UserError(f"--control-steps {config.control_steps} is more than half an episode of {task}")
    for name in ("worlds", "control_steps", "batches", "seeds", "width", "updates", "repeats", "devices"):
        value = getattr(config, name)
        least = min(value, default=0) if isinstance(value, tuple) else value
        if least < 1:
            raise UserError(f"--{name.replace('_', '-')} is {least}: must be at least 1")
    for part in ("finetune", "values"):
        if part in config.parts and config.prior is None:
            raise UserError(f"--parts {part} needs --prior FOLDER, as made by python -m experiments.pretrain")


def _physics(config: BenchmarkConfig) -> Iterator[dict[str, Any]]:
    for task in config.tasks:
        for impl in map(choose_impl, config.impls):
            for n in config.worlds:
                yield physics.speed(task, impl, n, control_steps=config.control_steps, repeats=config.repeats)


def _updates(config: BenchmarkConfig) -> Iterator[dict[str, Any]]:
    size = {"width": config.width, "updates": config.updates, "repeats": config.repeats}
    for exact in config.precisions:
        for batch in config.batches:
            for seeds in config.seeds:
                yield updates.speed(batch, seeds, exact=exact, **size)


def _plain(config: BenchmarkConfig) -> Iterator[dict[str, Any]]:
    for batch in config.batches:
        yield updates.plain_speed(batch, width=config.width, updates=config.updates, repeats=config.repeats)


def _values(config: BenchmarkConfig) -> Iterator[dict[str, Any]]:
    for task in config.tasks:
        for impl in config.impls:
            assert config.prior is not None  # checked before
            yield from values.errors(task, impl, config.prior, config.precisions)


def _pretrain(config: BenchmarkConfig) -> Iterator[dict[str, Any]]:
    for task in config.tasks:
        for impl in config.impls:
            for seeds in config.seeds:
                yield training.pretraining(task, impl, seeds, preset=config.preset, env_steps=config.env_steps)


def _finetune(config: BenchmarkConfig) -> Iterator[dict[str, Any]]:
    for task in config.tasks:
        for impl in config.impls:
            for seeds in config.seeds:
                assert config.prior is not None  # checked before
                yield training.fine_tuning(task, impl, seeds, prior=config.prior, rollouts=config.rollouts)


def _devices(config: BenchmarkConfig) -> Iterator[dict[str, Any]]:
    for task in config.tasks:
        for impl in config.impls:
            for worlds in config.worlds:
                for batch in config.batches:
                    size = {"worlds": worlds, "batch": batch, "preset": config.preset, "env_steps": config.env_steps}
                    yield from training.weak_scaling(task, impl, config.devices, **size)


class Growth(NamedTuple):
    """What a figure shows of a part. sizes: columns of which the one with the most values becomes the x axis; the other
    ones and `by` tell lines apart. y: the column drawn, called `label`. reference: the column drawn dashed.
    """

    sizes: tuple[str, ...]
    y: str
    label: str
    by: tuple[str, ...] = ()
    reference: str | None = None


_GROWTH = {
    "physics": Growth(("worlds",), "env_per_s", "physics steps per second", ("task", "impl"), "bare_per_s"),
    "updates": Growth(("batch", "seeds"), "updates_per_s", "updates per second", ("precision",), "bare_per_s"),
    "plain": Growth(("batch",), "updates_per_s", "updates per second"),
    "pretrain": Growth(("seeds",), "seconds", "seconds", ("task", "impl")),
    "finetune": Growth(("seeds",), "seconds", "seconds", ("task", "impl")),
    "devices": Growth(
        ("devices", "worlds", "batch"), "env_per_s", "environment steps per second", ("task", "impl"), "ideal_per_s"
    ),
}


def draw(part: str, lines: list[dict[str, Any]], path: Path) -> Path | None:
    """How a part grows with worlds, batch, seeds or devices; no figure of a single size."""
    if part not in _GROWTH:
        return None
    growth = _GROWTH[part]
    x = max(growth.sizes, key=lambda name: len({line[name] for line in lines}))
    if len({line[x] for line in lines}) < 2:
        return None
    apart = [*growth.by, *(name for name in growth.sizes if name != x)]

    def curves(column: str) -> dict[str, tuple[list[float], list[float]]]:
        found: dict[str, tuple[list[float], list[float]]] = {}
        for line in sorted(lines, key=lambda line: line[x]):
            words = [str(line[name]) if name in growth.by else f"{name} {line[name]:,}" for name in apart]
            xs, ys = found.setdefault(", ".join(words) or "sgft_jax", ([], []))
            xs.append(line[x])
            ys.append(line[column])
        return found

    references = curves(growth.reference) if growth.reference else {}
    return figures.scaling(path, curves(growth.y), references, title=_TITLES[part], x=x, y=growth.label)


_PARTS: dict[Part, Callable[[BenchmarkConfig], Iterator[dict[str, Any]]]] = {
    "physics": _physics,
    "updates": _updates,
    "plain": _plain,
    "values": _values,
    "pretrain": _pretrain,
    "finetune": _finetune,
    "devices": _devices,
}
_TITLES = {
    "physics": "environments",
    "updates": "updates of pretraining",
    "plain": "updates of plain SAC",
    "values": "V_sim by precision",
    "pretrain": "pretraining",
    "finetune": "fine-tuning with SGFT-SAC",
    "devices": "pretraining on several devices",
}


def table(part: str, lines: list[dict[str, Any]]) -> Table:
    """The lines of one kind as a table."""
    made = Table(title=_TITLES[part])
    names = list(dict.fromkeys(name for line in lines for name in line))
    for name in names:
        heading = name.replace("_", " ").replace("/", " / ")
        made.add_column(heading, justify="left" if name in ("task", "impl") else "right")
    for line in lines:
        made.add_row(*(_text(line[name]) if name in line else "-" for name in names))
    return made


def _text(x: Any) -> str:
    if isinstance(x, float):
        return f"{x:,.0f}" if x >= 1000 else f"{x:.3g}"
    return f"{x:,}" if isinstance(x, int) else str(x)


if __name__ == "__main__":
    cli.run_main(main, BenchmarkConfig, __doc__ or "")
