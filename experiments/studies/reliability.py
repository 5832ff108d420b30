"""What becomes of a run on a simulated robot with a real-time clock when things go wrong around it.

kills: kill -9 at random moments of the process that plays, of its learner and of the robot's, then the run goes on.
network: a proxy that drops, delays and damages messages in both directions.
strangers: random and truncated frames, and connections with a wrong token, at the learner's port.
disk: a disk that is full, and one that cannot be written to (mounts small file systems; needs the right to do so).
clock: the control period at 5 Hz and at 200 Hz, with the learner busy on the same cores.

The robot writes down what it really does. `missing` of its steps are not in the store: at most one for each kill.
`alien` ones are in the store and were never made, or twice: there must be none.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from envs.types import UserError
from experiments.runner import cli
from experiments.runner.options import at_least_one, seed_list, without_repeats
from sgft_jax.io.runs import check_folder

type Part = Literal["kills", "network", "strangers", "disk", "clock"]


@dataclass(frozen=True)
class ReliabilityArgs:
    """Which kinds of failure to cause, and how often."""

    parts: tuple[Part, ...] = ("kills", "network", "strangers", "disk", "clock")
    """Kinds of failure; the head of this help explains them."""
    runs: int = 10
    """Runs with kills."""
    kills: int = 10
    """Kills in each of these runs."""
    rollouts: int = 10
    """Rollouts of the other runs."""
    seed: int = 0
    """Seed of all random choices."""
    out: Path = Path("runs")
    """The numbers go to <out>/reliability/summary.json, what the processes said beside it."""


def main(args: ReliabilityArgs) -> dict[str, list[dict[str, Any]]]:
    """Tries, prints a line for each run, writes the numbers and returns them by part."""
    at_least_one(args, "runs", "kills", "rollouts")
    seed_list(args.seed, args.runs)
    if not args.parts:
        raise UserError("--parts: name at least one")
    without_repeats("--parts", args.parts)
    check_folder(args.out / "reliability")
    from sgft_jax.io import runs
    from sgft_jax.io.log import write_summary

    home, lines = (args.out / "reliability").resolve(), {part: [] for part in args.parts}
    for part in args.parts:
        for line in _tries(args, part, home / part):
            lines[part].append(line)
            print(f"{part}: " + ", ".join(f"{name} {_text(x)}" for name, x in line.items()), flush=True)
    print(f"numbers: {write_summary(home, {'provenance': runs.provenance(), **lines})}")
    return lines


def _tries(args: ReliabilityArgs, part: Part, home: Path) -> Iterator[dict[str, Any]]:
    """Causes one kind of failure; yields what became of each run."""
    from experiments.studies.reliable import disk, kills, network, timing

    match part:
        case "kills":
            for i in range(args.runs):
                yield {"run": i, **kills.run(home / f"run-{i}", kills=args.kills, seed=args.seed + i)}
        case "network":
            yield network.bad_network(home, seed=args.seed, rollouts=args.rollouts)
        case "strangers":
            yield network.strangers(home, seed=args.seed, rollouts=args.rollouts)
        case "disk":
            yield disk.full(home)
            yield disk.read_only(home)
        case "clock":
            wheels = {"task": "wheel-legged", "sizes": timing.WHEEL_LEGGED}
            yield timing.kept_clock(home / "slow", period=0.2, rollouts=args.rollouts, utd=400)
            yield timing.kept_clock(home / "fast", period=0.005, rollouts=args.rollouts, utd=2, **wheels)


def _text(value: Any) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)


if __name__ == "__main__":
    cli.run_main(main, ReliabilityArgs, __doc__ or "")
