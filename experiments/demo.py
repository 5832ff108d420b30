"""The idea in two minutes on a CPU: a policy fails on a "real" system, and two rollouts say which system it is."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.finetune import finetune
from experiments.runner import cli
from experiments.runner.finetune_args import FinetuneArgs, arguments, check, priors_of, run_folder
from experiments.runner.options import FirstSeed, at_least_one, check_task
from experiments.runner.progress import doing
from sgft_jax.io.log import EVAL, METRICS, read_jsonl
from sgft_jax.io.runs import check_folder
from sgft_jax.methods import get_method

if TYPE_CHECKING:
    from experiments.runner.narrowed import Narrowed

_METHOD = "posterior"
_GAP = Path(__file__).parents[1] / "envs/gaps/development/push-drawn.toml"


@dataclass(frozen=True)
class DemoArgs:
    """A few rollouts on one real system; everything lands in one folder."""

    task: str = "push"
    """A task by name."""
    prior: Path = Path("shipped:push/seed-0")
    """Folder of a prior with an estimator (`python -m experiments.estimate`)."""
    real: str = f"{_GAP}:push-1-05"
    """The real system, as in fine-tuning. The default was drawn at random: turned commands, a camera that is 11 mm off,
    a heavier puck."""
    rollouts: int = 2
    """Real rollouts."""
    seed: FirstSeed = 0
    video: bool = False
    """Also render an episode before and after (half a minute), where MuJoCo can render."""
    out: Path = Path("runs/demo")
    """Folder of the demo; an earlier demo in it is replaced."""


def main(args: DemoArgs) -> None:
    """Plays, says after every rollout which systems may have made them, and how what is chosen does."""
    run, started = plan(args), time.monotonic()
    finetune(run)
    from experiments.runner.narrowed import table
    from sgft_jax.analysis import figures, tables

    home = run_folder(run, args.real)
    with doing("drawing from the posterior", 10, once=True):
        known = narrowed_by(run, home)
    path = figures.shrinking(home / "figures" / "posterior.png", *known, title="Which system is it?")
    print("\nWhich system is it? 80 % intervals of what rollouts tell most of:\n")
    print(table(known))
    print("\nSuccess without exploration, before it promised by simulation:\n")
    print(tables.markdown(["rollouts", "deployed", "promised", "succeeds", "plays the next rollout"], outcome(home)))
    print(f"\nfigure: {path}\nother kinds of gap: docs/results.md")
    print(f"{(time.monotonic() - started) / 60:.1f} minutes in all")


def plan(args: DemoArgs) -> FinetuneArgs:
    """What runs; raises UserError for all that is wrong with it before any of it does."""
    # The default system's numbers are checked against the task, which takes JAX: everything else comes before.
    check_task(args.task)
    at_least_one(args, "rollouts")
    check_folder(args.out)
    shared = {"task": args.task, "prior": args.prior, "out": args.out, "overwrite": True, "real": (args.real,)}
    size = {"seed": args.seed, "seeds": 1, "rollouts": args.rollouts, "eval_every": 1, "eval_episodes": 20}
    run = arguments(_METHOD, options=get_method(_METHOD).config(), video=args.video, **shared, **size)
    priors_of(run)
    check(run)
    return run


def narrowed_by(run: FinetuneArgs, home: Path) -> "Narrowed":
    """What the rollouts of a run of `posterior` tell of its real system."""
    import jax

    from envs import gaps
    from experiments.runner.diagnose_run import load, recorded_in
    from experiments.runner.narrowed import narrowed, posterior, readable
    from sgft_jax.posterior.estimator import MOST

    env, priors = load(run.task, run.impl, priors_of(run))
    seen, key = recorded_in(env, priors, home, None), jax.random.key(run.seed)
    estimator, after = priors[seen.which[0]].params.estimator, range(min(len(seen.real[0].success), MOST) + 1)
    points = posterior(env, estimator, readable(env, seen.real[0]), after, key)
    return narrowed(env, points, after, gaps.load(env, run.real[0]))


def outcome(home: Path) -> list[list[str]]:
    """After each number of rollouts what is deployed, the success that is promised for it, its success, and what plays
    the next rollout.
    """
    from sgft_jax.posterior.trust import POLICIES

    scores = {int(record["rollouts"]): record["score"][0] for record in read_jsonl(home / EVAL)}
    words = ["the prior as it is", *(f"the prior {policy}" for policy in POLICIES[1:])]
    lines = [["0", words[0], "", f"{100 * scores[0]:.0f} %", words[0]]]
    for record in read_jsonl(home / METRICS):
        kept, tried = (int(record[f"posterior/{name}"][0]) for name in ("deployed", "tried"))
        promised, score = record[f"posterior/{POLICIES[kept]}"][0], scores[n := int(record["rollouts"])]
        lines.append([str(n), words[kept], f"{100 * promised:.0f} %", f"{100 * score:.0f} %", words[tried]])
    return lines


if __name__ == "__main__":
    cli.run_main(main, DemoArgs, __doc__ or "")
