"""Methods against each other in another engine: `panda-push` on panda-gym, in Bullet, one run for each seed.

Each run is the command of a user, `experiments.finetune --real remote`, and panda-gym's driver (docs/real-robot.md).
Runs that are finished are left alone, and unfinished ones go on, so the same command continues after any interruption.
`python -m experiments.figures --out <out>` draws what there is.
"""

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from experiments import real_demo
from experiments.real_demo import HOME, PYTHON, TASK
from experiments.runner import cli, finetune_args, options
from experiments.runner.finetune_args import FinetuneArgs, run_folder
from experiments.runner.real_systems import REMOTE
from sgft_jax.io.log import SUMMARY
from sgft_jax.io.runs import check_folder
from sgft_jax.methods import get_method


@dataclass(frozen=True)
class BulletArgs:
    """Methods, seeds and evaluations. All methods meet the same starts and evaluation episodes."""

    methods: tuple[str, ...] = ("guarded", "sgft-sac", "mbpo", "sac")
    """Methods that start from priors of SAC, in the order in which they run."""
    prior: Path = Path(f"shipped:{TASK}")
    """Folder of a prior of panda-push, or of several; seed i starts from prior i modulo their number."""
    seed: int = 0
    """First seed."""
    seeds: int = 10
    """Seeds of each method."""
    rollouts: int = 20
    """Real rollouts of each run."""
    eval_at: tuple[int, ...] = (0, 1, 2, 4, 8, 16, 20)
    """Evaluate after these numbers of rollouts."""
    episodes: int = 50
    """Episodes of each evaluation, always the same ones."""
    jobs: int = 1
    """Runs at the same time; each needs a core for the learner and one for the engine."""
    minutes: float | None = None
    """Begin no new run after so many minutes."""
    out: options.Out = Path("runs/bullet")
    home: Path = HOME
    """Folder of the Python environment with panda-gym; made if it does not exist."""
    python: str = PYTHON
    """Python 3.11 that makes this environment, by default $PYTHON311 or python3.11."""


def main(args: BulletArgs) -> None:
    """Plays what is missing, and says how far it came."""
    check(args)
    python = real_demo.bullet(args.home, args.python)
    started, missing = time.monotonic(), unfinished(args)

    def play(run: FinetuneArgs) -> None:
        if args.minutes is None or time.monotonic() - started < 60 * args.minutes:
            log = args.out / f"robot-{run.method}-{run.seed}.log"
            real_demo.fine_tune(python, args.out, words_of(run), log=log)

    args.out.mkdir(parents=True, exist_ok=True)
    with ThreadPoolExecutor(args.jobs) as pool:
        list(pool.map(play, missing))  # the first error ends it
    count = len(list(runs(args)))
    print(f"{count - len(unfinished(args))} of {count} runs are finished")
    print(f"next: python -m experiments.figures --out {args.out}")


def check(args: BulletArgs) -> None:
    """Raises UserError for all that is wrong with the options before anything is made."""
    options.at_least_one(args, "seeds", "rollouts", "episodes", "jobs")
    options.not_negative(args, "minutes")
    options.seed_list(args.seed, args.seeds)
    options.each_once(args, "methods")
    check_folder(args.out)
    folders = options.prior_folders(args.prior, out=args.out, task=TASK, preset="")
    for method in map(get_method, args.methods):
        for folder in folders:
            options.check_prior(folder, method, TASK)
    for run in unfinished(args):
        finetune_args.check(run)
    real_demo.check_driver()


def runs(args: BulletArgs) -> Iterator[FinetuneArgs]:
    """Every run: all methods of a seed, then the next seed, so that whatever there is can be compared."""
    common = {name: getattr(args, name) for name in ("prior", "rollouts", "eval_at", "out")}
    played = {"task": TASK, "real": (REMOTE,), "seeds": 1, "eval_episodes": args.episodes}
    for seed in range(args.seed, args.seed + args.seeds):
        for method in args.methods:
            run = finetune_args.arguments(method, seed=seed, **played, **common)
            yield replace(run, resume=run_folder(run, REMOTE).exists())


def unfinished(args: BulletArgs) -> list[FinetuneArgs]:
    """Those that are still to be played, or to go on."""
    return [run for run in runs(args) if not (run_folder(run, REMOTE) / SUMMARY).exists()]


def words_of(run: FinetuneArgs) -> list[object]:
    """Of `experiments.finetune`."""
    words = ["--method", run.method, "--seed", run.seed, "--prior", run.prior, "--rollouts", run.rollouts]
    words += ["--eval-episodes", run.eval_episodes, "--eval-at", *run.eval_at]
    return [*words, "--resume"] if run.resume else words


if __name__ == "__main__":
    cli.run_main(main, BulletArgs, __doc__ or "")
