"""The whole method at a small scale on a CPU: pretrain, meet a "real" system, fine-tune with and without SGFT."""

import contextlib
import multiprocessing
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax

import envs
from experiments import cli
from experiments.figures import FiguresArgs, figures
from experiments.finetune import finetune
from experiments.finetune_args import FinetuneArgs, run_folder
from experiments.pretrain import PretrainArgs, pretrain
from sgft_jax.analysis import tables
from sgft_jax.analysis.curves import Curve, read_runs
from sgft_jax.methods import finetune_config, get_method
from sgft_jax.presets import PRESETS
from sgft_jax.types import UserError

METHODS = ("sgft-mpc", "sgft-sac", "sac")  # the first is filmed


@dataclass(frozen=True)
class DemoArgs:
    """A few minutes of the whole pipeline; everything lands in one folder."""

    task: str = "insert"
    """push, push-towel, push-ball, hammer or insert. Of hammering and pushing, priors as small as these differ more
    than methods do (docs/results.md)."""
    real: str = "default"
    """The real system, as in fine-tuning."""
    env_steps: int | None = None
    """Environment steps of pretraining, default: those of preset `cpu`."""
    seeds: int = 3
    """Fine-tuning seeds per method."""
    rollouts: int = 20
    """Real rollouts per seed, the initial ones included."""
    video: bool = True
    """Render an episode before and after fine-tuning with sgft-mpc, where MuJoCo can render."""
    out: Path = Path("runs/demo")
    """Folder of the demo; an earlier demo in it is replaced."""


def main(args: DemoArgs) -> None:
    """Pretrains once, fine-tunes with each method from the same prior on the same real starts, and compares."""
    started = time.monotonic()
    config = PRESETS["cpu"]
    config = config if args.env_steps is None else replace(config, env_steps=args.env_steps)
    shared = {"task": args.task, "preset": "cpu", "out": args.out, "overwrite": True}
    pretrain(PretrainArgs(config=config, report=False, video=False, **shared))
    runs = [_finetune_args(args, method, shared) for method in METHODS]
    _finetune_all(*runs)
    results = figures(FiguresArgs(task=envs.name_of(args.task), out=args.out))
    folder = run_folder(runs[0], args.real).parent.parent
    print(f"\n{outcome([c for c in read_runs(args.out).curves if c.gap == folder.name])}\n")
    print(f"figure: {results.parent / f'{envs.name_of(args.task)}-{folder.name}.png'}, tables: {results}")
    print(f"{time.monotonic() - started:.0f} s in all; curves, real rollouts and a video of {METHODS[0]}: {folder}")


def outcome(curves: Sequence[Curve]) -> str:
    """What came of it in a few lines: success of the methods wherever one was evaluated."""
    first, *_ = curves
    return (
        f"{tables.words(first.score).capitalize()} on the {first.gap} real system of {first.task}, interquartile mean "
        f"over seeds with its 95 % interval where there are enough:\n\n{tables.outcome(curves)}"
    )


def _finetune_args(args: DemoArgs, method: str, shared: dict[str, Any]) -> FinetuneArgs:
    """Smaller batches and fewer updates than on a GPU: what two cores can do; all methods get the same. All else is the
    methods' own: larger rates of the actor cost most of them success (docs/small-priors.md).
    """
    return FinetuneArgs(
        real=(args.real,),
        method=method,
        seeds=args.seeds,
        rollouts=args.rollouts,
        utd=4.0,
        eval_every=5,
        eval_episodes=20,
        options=finetune_config(get_method(method), batch_size=64),
        video=args.video and method == METHODS[0],
        **shared,
    )


def _finetune_all(first: FinetuneArgs, *others: FinetuneArgs) -> None:
    """One run here, on a CPU the others in turn in a process beside it: plans cost as much as what they all learn."""
    if jax.default_backend() != "cpu":
        for args in (first, *others):
            finetune(args)
        return
    context = multiprocessing.get_context("spawn")
    log = first.out / "beside.log"
    beside = context.Process(target=_logged, args=(others, log), daemon=True)
    beside.start()
    try:
        finetune(first)
        beside.join()
    finally:
        beside.kill()  # it has ended, unless the run above has failed
    if beside.exitcode:
        raise UserError(f"fine-tuning with {' or '.join(args.method for args in others)} failed, see {log}")


def _logged(runs: Sequence[FinetuneArgs], log: Path) -> None:
    with open(log, "w") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
        for args in runs:
            finetune(args)


if __name__ == "__main__":
    cli.run_main(main, DemoArgs, __doc__ or "")
