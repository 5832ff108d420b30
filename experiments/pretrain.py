"""Pretrain in randomised simulation (or on a "real" system): leaves one prior per seed.

The prior of a seed is the agent at the best of its late evaluations (success, then return) on held-out worlds; the
numbers in its card and in summary.json come from fresh episodes in other held-out worlds, so the choice does not
flatter them.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar

from envs import extend, gaps
from envs.gaps import SIM
from envs.types import UserError
from experiments.runner import ahead, cli
from experiments.runner.options import Impl, Out, Task, check_task, hosts_of, not_negative, seed_list, seeds_name
from sgft_jax.io.runs import check_start
from sgft_jax.presets import DEFAULT_PRESET, PRESETS, PretrainConfig


@dataclass(frozen=True)
class PretrainArgs:
    """One run of pretraining."""

    # May differ when a run goes on.
    volatile: ClassVar = ("resume", "overwrite", "devices", "hosts", "report", "video", "out")

    task: Task = "push"
    preset: str = DEFAULT_PRESET
    """Named settings: robust (one GPU, minutes; actuators and sensors differ between episodes), fast (the task's own
    domain), cpu (two cores, minutes), paper, or robust-tdmpc2, recurrent and informed (sysid) for the methods that need
    their priors. --config.* changes single ones."""
    seed: int = 0
    """First seed."""
    seeds: int = 1
    """Number of seeds, trained together. Each leaves a prior."""
    out: Out = Path("runs")
    resume: bool = False
    """Continue from the last checkpoint."""
    overwrite: bool = False
    """Replace an earlier run of the same name."""
    video: bool = True
    """Render an episode of the first prior, where MuJoCo can render."""
    real: str | None = None
    """Expert: train in the system of a gap, by name or as a .toml/.json file, instead of the task's own domain: as in a
    simulator that is wrong (fine-tune with --real sim), or on the "real" system to see what can be had there."""
    set: tuple[str, ...] = ()
    """Expert: changes to that system, e.g. --set latency=0.05 action_scale=[1,0.5]."""
    report: bool = True
    """Expert: also measure V_sim against returns and the models against the simulator, for the card and a figure."""
    impl: Impl = "auto"
    devices: int | None = None
    """Expert: devices that share the environments, the replay and every batch; 0: all there are; default: one, or all
    of several hosts. Results stay the same but for rounding, and a run may be resumed on another number."""
    hosts: str | None = None
    """Expert: several hosts together, which see the same files: `auto` asks the cluster (SLURM, Open MPI, Kubernetes),
    ADDRESS:PORT,COUNT,INDEX says where the first one listens, how many there are, and which one this is."""
    config: PretrainConfig = field(default_factory=lambda: PRESETS[DEFAULT_PRESET])
    """Expert: single settings; the defaults are those of the preset."""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line."""
    cli.run_main(pretrain, PretrainArgs, __doc__ or "", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> PretrainArgs:
    """The defaults of the preset; `pretrain` refuses a preset that does not exist."""
    preset = cli.preview(argv, preset=DEFAULT_PRESET).preset
    return PretrainArgs(preset=preset, config=PRESETS.get(preset, PRESETS[DEFAULT_PRESET]))


def pretrain(args: PretrainArgs) -> dict[str, Any]:
    """One run from (or back) to disk; returns its summary."""
    seeds = check(args)
    ahead.start(args.config.worlds * args.seeds, devices=args.hosts is None)
    from experiments.runner.pretrain_run import run

    return run(args, seeds, run_folder(args))


def check(args: PretrainArgs) -> list[int]:
    """The seeds; raises UserError for what is wrong in the arguments and on disk."""
    cli.choose("--preset", args.preset, PRESETS)
    seeds, real = seed_list(args.seed, args.seeds), args.real not in (None, SIM)
    if args.set and not real:
        raise UserError(f"--set {args.set[0]}: changes a real system; name one with --real")
    if real and args.config.doraemon:
        raise UserError(f"--real {args.real}: has a domain of its own; leave doraemon off")
    not_negative(args, "devices")
    check_task(args.task, [str(args.real)] if real else [], args.set)
    if args.hosts not in (None, "auto"):
        hosts_of(args.hosts)
    # Of several hosts every one sees what is there now: the first changes nothing before it has met the others.
    check_start(run_folder(args), resume=args.resume, overwrite=args.overwrite)
    return seeds


def run_folder(args: PretrainArgs) -> Path:
    """Where the run of these arguments lives; the seeds of one call share a folder."""
    where, seeds = args.preset, seeds_name(seed_list(args.seed, args.seeds))
    if args.real not in (None, SIM):
        changes = ["=".join(word.strip() for word in change.partition("=")[::2]) for change in args.set]
        where += "-on-" + "+".join([gaps.title(str(args.real)), *changes]).replace("/", "")
    extend.folder_name("--set", where)
    return args.out / "pretrain" / extend.name_of(args.task) / where / seeds


if __name__ == "__main__":
    main()
