"""The idea in two minutes on a CPU: a policy fails on a "real" system and is fine-tuned, with and without SGFT."""

import contextlib
import multiprocessing
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from envs import extend
from envs.files import read_json
from envs.types import UserError
from experiments.figures import FiguresArgs, figures
from experiments.finetune import finetune
from experiments.runner import cli
from experiments.runner.finetune_args import FinetuneArgs, arguments, check, priors_of, run_folder
from experiments.runner.options import check_task
from experiments.runner.progress import doing
from sgft_jax.io.log import SUMMARY
from sgft_jax.methods import get_method

if TYPE_CHECKING:
    from sgft_jax.analysis.curves import Curve

METHODS = ("sgft-mpc", "sgft-sac", "sac")  # the first is filmed


@dataclass(frozen=True)
class DemoArgs:
    """Three methods from one prior on one real system; everything lands in one folder."""

    task: str = "insert"
    """A task by name."""
    prior: Path = Path("shipped:insert-cpu")
    """Folder of a prior. The default is what `pretrain --task insert --preset cpu` makes in three minutes: a weak
    one, where methods differ (docs/results.md)."""
    real: str = "default"
    """The real system, as in fine-tuning."""
    seeds: int = 2
    """Fine-tuning seeds per method."""
    rollouts: int = 10
    """Real rollouts per seed, the initial ones included."""
    video: bool = True
    """Render an episode before and after fine-tuning with sgft-mpc, where MuJoCo can render."""
    out: Path = Path("runs/demo")
    """Folder of the demo; an earlier demo in it is replaced."""


def main(args: DemoArgs) -> None:
    """Fine-tunes with each method from the same prior on the same real starts, and compares."""
    from sgft_jax.analysis.reading import read_runs

    runs = plan(args)
    started = time.monotonic()
    _finetune_all(*runs)
    summaries = {run.method: read_json(run_folder(run, args.real) / SUMMARY) for run in runs}
    results = figures(FiguresArgs(task=extend.name_of(args.task), out=args.out))
    folder = run_folder(runs[0], args.real).parent.parent
    print(f"\n{outcome([c for c in read_runs(args.out).curves if c.gap == folder.name], summaries)}\n")
    print(f"figures and tables: {results.parent}; curves, real rollouts and a video of {METHODS[0]}: {folder}")
    print(f"{(time.monotonic() - started) / 60:.1f} minutes in all")


def plan(args: DemoArgs) -> list[FinetuneArgs]:
    """What runs; raises UserError for all that is wrong with it before any of it does."""
    check_task(args.task, [args.real])
    # Smaller batches and fewer updates than on a GPU: what two cores can do; all methods get the same. All else is the
    # methods' own: larger rates of the actor cost most of them success (docs/lessons.md).
    shared = {"task": args.task, "prior": args.prior, "out": args.out, "overwrite": True, "real": (args.real,)}
    size = {"seeds": args.seeds, "rollouts": args.rollouts, "eval_every": 5, "eval_episodes": 20}
    runs = []
    for method in METHODS:
        options, video = get_method(method).config(utd=4.0, batch_size=64), args.video and method == METHODS[0]
        runs.append(arguments(method, options=options, video=video, **shared, **size))
    for run in runs:
        check(run)
        priors_of(run)
    return runs


def outcome(curves: "Sequence[Curve]", summaries: dict[str, dict[str, Any]]) -> str:
    """What came of it in a few lines: the methods wherever one was evaluated, and their best policies."""
    from sgft_jax.analysis import tables

    first, *_ = curves
    score = tables.words(first.score)
    best_scores = {name: summary["best"]["score"] for name, summary in summaries.items()}
    mean = {name: sum(scores) / len(scores) for name, scores in best_scores.items()}
    best = [f"{name} {tables.plain(score, first.score)}" for name, score in mean.items()]
    return (
        f"{score.capitalize()} on the {first.gap} real system of {first.task} without exploration, interquartile mean "
        f"over seeds with its 95 % interval where there are enough:\n\n{tables.outcome(curves)}\n\n"
        f"The last policy need not be the best. Those that did best in the real rollouts: {', '.join(best)}.\n"
        "Seeds, machines and small priors differ: a few per cent more or less between methods mean nothing here."
    )


def _finetune_all(first: FinetuneArgs, *others: FinetuneArgs) -> None:
    """On a CPU the first runs here and the others one by one in a second process: planning takes as long as they do."""
    import jax

    if jax.default_backend() != "cpu":
        for args in (first, *others):
            finetune(args)
        return
    context = multiprocessing.get_context("spawn")
    log = first.out / "beside.log"
    print(f"{' and '.join(args.method for args in others)} run beside {first.method}; what they say: {log}")
    beside = context.Process(target=_logged, args=(others, log), daemon=True)
    beside.start()
    try:
        finetune(first)
        with doing(f"waiting for {' and '.join(args.method for args in others)}"):
            beside.join()
    finally:
        beside.kill()  # it has ended, unless the run above has failed
    if beside.exitcode:
        raise UserError(f"fine-tuning with {' or '.join(args.method for args in others)} failed, see {log}")


def _logged(runs: Sequence[FinetuneArgs], log: Path) -> None:
    log.parent.mkdir(parents=True, exist_ok=True)
    with open(log, "w") as file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
        for args in runs:
            finetune(args)


if __name__ == "__main__":
    cli.run_main(main, DemoArgs, __doc__ or "")
