"""Fine-tuning in another engine: a small prior of `panda-push` meets panda-gym, in Bullet, behind the socket.

Bullet needs Python 3.11 and therefore an environment of its own, which the first run makes. What follows are the two
commands that a user would type: `experiments.finetune --real remote`, and the robot's driver.
"""

import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from envs.types import UserError
from experiments.runner import cli, panda_gym
from experiments.runner.finetune_args import arguments, run_folder
from experiments.runner.options import at_least_one, check_prior, seed_list
from experiments.runner.panda_gym import HOME, PYTHON, TASK
from experiments.runner.real_systems import REMOTE
from sgft_jax.io.cards import resolve_shipped
from sgft_jax.io.runs import check_folder
from sgft_jax.methods import get_method

if TYPE_CHECKING:
    import numpy as np

_FILMED = 3  # episodes of the first and of the last evaluation, to choose a telling one from


@dataclass(frozen=True)
class RealDemoArgs:
    """A few minutes on two cores; everything but the environment of Bullet lands in one folder."""

    prior: Path = Path(f"shipped:{TASK}/seed-0")
    """Folder of a prior of panda-push."""
    method: str = "guarded"
    """How to fine-tune."""
    rollouts: int = 8
    """Real rollouts."""
    episodes: int = 20
    """Episodes of each evaluation, always the same ones: before, after the first rollout and at the end."""
    seed: int = 0
    """Seed of fine-tuning and of the episodes."""
    video: bool = True
    """Film some episodes before and after."""
    out: Path = Path("runs/real-demo")
    """Folder of the demo; an earlier demo in it is replaced."""
    home: Path = HOME
    """Folder of the Python environment with panda-gym; made if it does not exist."""
    python: str = PYTHON
    """Python 3.11 that makes this environment, by default $PYTHON311 or python3.11."""


def main(args: RealDemoArgs) -> None:
    """Makes the second environment, plays, learns, plays again, and shows what came of it."""
    check(args)
    started = time.monotonic()
    python = panda_gym.bullet(args.home, args.python)
    shutil.rmtree(args.out, ignore_errors=True)
    args.out.mkdir(parents=True)
    fine_tune(args, python)
    show(args)
    print(f"{(time.monotonic() - started) / 60:.1f} minutes in all")


def check(args: RealDemoArgs) -> None:
    """Raises UserError for all that is wrong with the options before anything is made."""
    at_least_one(args, "rollouts", "episodes")
    seed_list(args.seed, 1)
    method = get_method(args.method)
    check_folder(args.out)
    if not (resolve_shipped(args.prior) / "prior.json").exists():
        command = f"python -m experiments.pretrain --task {TASK}"
        raise UserError(f"--prior {args.prior}: holds no prior; make one with: {command}")
    check_prior(resolve_shipped(args.prior), method, TASK)
    panda_gym.check_driver()
    if args.out.exists() and any(args.out.iterdir()) and not (args.out / "robot.log").exists():
        raise UserError(f"--out {args.out}: holds something that is no demo; choose another folder")


# --- playing ----------------------------------------------------------------------------------------------------------


def fine_tune(args: RealDemoArgs, python: Path) -> None:
    """The run, with what is filmed of it."""
    first, last = filmed(args)
    options = ["--prior", args.prior, "--method", args.method, "--seed", args.seed, "--rollouts", args.rollouts]
    options += ["--eval-at", *evaluated(args), "--eval-episodes", args.episodes]
    film = ["--into", args.out / "pictures", "--film", *first, *last] if args.video else []
    panda_gym.fine_tune(python, args.out, options, log=args.out / "robot.log", film=film)


def evaluated(args: RealDemoArgs) -> list[int]:
    """The numbers of rollouts after which there is an evaluation."""
    return sorted({0, 1, args.rollouts})


def filmed(args: RealDemoArgs) -> tuple[range, range]:
    """The first episodes of the first and of the last evaluation, as the robot counts its episodes."""
    count, last = min(_FILMED, args.episodes), (len(evaluated(args)) - 1) * args.episodes + args.rollouts
    return range(count), range(last, last + count)


# --- pictures ---------------------------------------------------------------------------------------------------------


def show(args: RealDemoArgs) -> None:
    """The success before and after, and where the learning curve, the video and the policy are."""
    from experiments.runner.finetune_record import evaluation_store

    run = run_folder(arguments(args.method, task=TASK, seeds=1, seed=args.seed, out=args.out), REMOTE)
    stores = [evaluation_store(run, done) for done in (0, args.rollouts)]
    before, after = ([bool(store.load(i)["success"][0]) for i in range(len(store))] for store in stores)
    print(
        f"\nsuccess in Bullet: {_percent(before)} before, {_percent(after)} after {args.rollouts} rollouts of "
        f"{args.method}; one seed, {args.episodes} episodes, in which the cube lay within 5 cm of the mark at the end"
    )
    print(film(args, before, after) if args.video else "no video: not asked for")
    print(f"learning curve: {run / 'figures/score.png'}; what the robot's side said: {args.out / 'robot.log'}")


def film(args: RealDemoArgs, before: Sequence[bool], after: Sequence[bool]) -> str:
    """Puts the same episode before and after side by side; says in one line where, or why not."""
    import numpy as np

    from envs.mujoco.render import write_side_by_side

    first, last = filmed(args)
    i = telling(np.array(before[: len(first)]), np.array(after[: len(last)]))
    path, outcome = args.out / "videos" / "before-after.mp4", ("failure", "success")
    captions = [f"before: {outcome[before[i]]}", f"after {args.rollouts} rollouts: {outcome[after[i]]}"]
    try:
        files = [args.out / "pictures" / f"episode-{numbers[i]}.npz" for numbers in (first, last)]
        write_side_by_side([np.load(file)["pictures"] for file in files], captions, path)
    except Exception as error:  # whatever a file or a video encoder raises: a demo does not fail for a picture
        return f"no video: {(str(error).strip() or type(error).__name__).splitlines()[0]}"
    return f"video: {path}"


def _percent(succeeded: Sequence[bool]) -> str:
    return f"{100 * sum(succeeded) / len(succeeded):.0f} %"


def telling(first: "np.ndarray", last: "np.ndarray") -> int:
    """Which episode to show, of successes before and after, [n] bool: the first that was mended, else the first."""
    mended = (~first & last).nonzero()[0]
    return int(mended[0]) if len(mended) else 0


if __name__ == "__main__":
    cli.run_main(main, RealDemoArgs, __doc__ or "")
