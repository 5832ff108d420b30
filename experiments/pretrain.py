"""Pretrain in randomised simulation (or on a "real" system): leaves one prior per seed.

The prior of a seed is the agent at the best of its late evaluations (success, then return) on held-out worlds; the
numbers in its card and in summary.json come from fresh episodes in other held-out worlds, so the choice does not
flatter them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from experiments import cli
from experiments.options import Impl, seed_list
from sgft_jax.presets import PRESETS, PretrainConfig

DEFAULT_PRESET = "fast"


@dataclass(frozen=True)
class PretrainArgs:
    """One run of pretraining."""

    task: str = "push"
    """push, push-towel, push-ball, hammer or insert; or a Python file with a task of your own (docs/extending.md)."""
    preset: str = DEFAULT_PRESET
    """Named settings, see experiments/presets.py; --config.* changes single ones."""
    config: PretrainConfig = field(default_factory=lambda: PRESETS[DEFAULT_PRESET])
    """The settings themselves."""
    seed: int = 0
    """First seed."""
    seeds: int = 1
    """Number of seeds, trained together."""
    real: str | None = None
    """Train on a "real" system instead of the simulator's domain: the name of a gap, or a .toml/.json file."""
    set: tuple[str, ...] = ()
    """Changes to that system, e.g. --set latency=0.05 action_scale=[1,0.5]."""
    impl: Impl = "auto"
    devices: int | None = None
    """Devices that share the environments, the replay and every batch; 0: all there are; default: one, or all of
    several hosts. Results stay the same but for rounding, and a run may be resumed on another number."""
    hosts: str | None = None
    """Several hosts together, which see the same files: `auto` asks the cluster (SLURM, Open MPI, Kubernetes),
    ADDRESS:PORT,COUNT,INDEX says where the first one listens, how many there are, and which one this is."""
    report: bool = True
    """Also measure V_sim against returns and the models against the simulator: numbers on the card, a figure."""
    video: bool = True
    """Render an episode of the first prior, where MuJoCo can render."""
    out: Path = Path("runs")
    """Parent of all run folders."""
    resume: bool = False
    """Continue from the last checkpoint."""
    overwrite: bool = False
    """Replace an earlier run of the same name."""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    cli.run_main(pretrain, PretrainArgs, __doc__ or "", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> PretrainArgs:
    """Those of the preset; of one that does not exist `pretrain` complains."""
    preset = cli.preview(argv, preset=DEFAULT_PRESET).preset
    return PretrainArgs(preset=preset, config=PRESETS.get(preset, PRESETS[DEFAULT_PRESET]))


def pretrain(args: PretrainArgs) -> dict[str, Any]:
    """One run from (or back) to disk; returns its summary."""
    cli.choose("--preset", args.preset, PRESETS)
    seeds = seed_list(args.seed, args.seeds)
    import envs

    envs.name_of(args.task)  # complains if there is none
    from experiments.pretrain_run import run

    return run(args, seeds)


if __name__ == "__main__":
    main()
