"""Fine-tuning in another engine: a small prior of `panda-push` meets panda-gym, in Bullet, behind the socket.

Bullet needs Python 3.11 and therefore an environment of its own, which the first run makes. What follows are the two
commands that a user would type: `experiments.finetune --real remote`, and the robot's driver.
"""

import contextlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from envs.types import UserError
from experiments.runner import cli, real_systems
from experiments.runner.finetune_args import arguments, run_folder
from experiments.runner.options import at_least_one, check_prior, seed_list
from experiments.runner.progress import doing
from sgft_jax.io.cards import resolve_shipped
from sgft_jax.io.runs import check_folder
from sgft_jax.methods import get_method

TASK = "panda-push"
HOME = Path("build/panda-gym")  # where the environment is, or shall be made
PYTHON = os.environ.get("PYTHON311") or "python3.11"  # what makes it
DRIVER = Path("docs/examples/panda_gym_robot.py")  # in the folder of the code, as the priors are
PACKAGES = ("panda-gym==3.0.7", "pybullet==3.2.7", "gymnasium==1.4.0", "numpy==2.4.6", "msgpack==1.2.4")
PACKAGES += ("websockets==17.4",)
_END = 10.0  # seconds that a process has for its end
_FILMED = 3  # episodes of the first and of the last evaluation, to choose a telling one from


@dataclass(frozen=True)
class RealDemoArgs:
    """A few minutes on two cores; everything but the environment of Bullet lands in one folder."""

    prior: Path = Path(f"shipped:{TASK}/seed-0")
    """Folder of a prior of panda-push."""
    method: str = "sac"
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
    python = bullet(args.home, args.python)
    shutil.rmtree(args.out, ignore_errors=True)
    args.out.mkdir(parents=True)
    first, last = filmed(args)
    options = ["--prior", args.prior, "--method", args.method, "--seed", args.seed, "--rollouts", args.rollouts]
    options += ["--eval-at", *evaluated(args), "--eval-episodes", args.episodes]
    film = ["--into", args.out / "pictures", "--film", *first, *last] if args.video else []
    fine_tune(python, args.out, options, log=args.out / "robot.log", film=film)
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
    check_driver()
    if args.out.exists() and any(args.out.iterdir()) and not (args.out / "robot.log").exists():
        raise UserError(f"--out {args.out}: holds something that is no demo; choose another folder")


def evaluated(args: RealDemoArgs) -> list[int]:
    """The numbers of rollouts after which there is an evaluation."""
    return sorted({0, 1, args.rollouts})


def filmed(args: RealDemoArgs) -> tuple[range, range]:
    """The first episodes of the first and of the last evaluation, as the robot counts its episodes."""
    count, last = min(_FILMED, args.episodes), (len(evaluated(args)) - 1) * args.episodes + args.rollouts
    return range(count), range(last, last + count)


# --- Bullet, and both sides of the socket ----------------------------------------------------------------------------


def check_driver() -> None:
    """Raises UserError where the driver is not, before anything is made."""
    if not DRIVER.exists():
        raise UserError(f"{DRIVER}: no such file; run this command in the folder of the code")


def bullet(home: Path, python: str) -> Path:
    """The Python of the environment with panda-gym in `home`, which is made where there is none.

    Raises UserError where there is no Python 3.11, or where its packages cannot be had.
    """
    bullet_python = home / "bin" / "python"
    if output(str(bullet_python), "import panda_gym, msgpack, websockets") is not None:
        return bullet_python
    if output(python, "import sys; sys.exit(sys.version_info[:2] != (3, 11))") is None:
        raise UserError(f"{python} is no Python 3.11, for which pybullet has wheels; name one with PYTHON311=...")
    install = [str(bullet_python), "-m", "pip", "install", "-q", *PACKAGES]
    with doing(f"making an environment for Bullet in {home}", 60, once=True):
        for command in ([python, "-m", "venv", "--clear", str(home)], install):
            done = subprocess.run(command, capture_output=True, text=True)
            if done.returncode:
                last = (done.stderr.strip() or f"exit code {done.returncode}").splitlines()[-1]
                raise UserError(f"{' '.join(command[:4])} failed: {last}")
    return bullet_python


def output(python: str, code: str) -> str | None:
    """What Python prints for the code; None where it fails, or where there is no such Python."""
    try:
        done = subprocess.run([python, "-c", code], capture_output=True, text=True)
    except OSError:
        return None
    return None if done.returncode else done.stdout


def fine_tune(python: Path, out: Path, options: Sequence[object], *, log: Path, film: Sequence[object] = ()) -> None:
    """Runs learner and robot as a user would, until the learner is done.

    python: of the environment. out: parent of the run's folder. options: of `experiments.finetune`, beside task, robot
    and seeds. log: file for what the robot's side says. film: options of the driver. Raises UserError where one of the
    two fails; neither outlives this function.
    """
    port = real_systems.free_port()
    learner = [sys.executable, "-u", "-m", "experiments.finetune", "--task", TASK, "--real", f"remote::{port}"]
    learner += ["--seeds", "1", "--out", str(out), *map(str, options)]
    reach = ["--url", f"ws://127.0.0.1:{port}", "--token", real_systems.token(out)]
    together(learner, [str(python), "-u", str(DRIVER), *reach, *map(str, film)], log)


def together(learner: Sequence[str], robot: Sequence[str], log: Path) -> None:
    """Two processes, until the first one is done. log: file for what the second one says.

    A robot ends with exit code 0 once the learner has told it that the run is over; the learner then takes its time.
    Raises UserError where one of the two fails. Neither outlives this function.
    """
    with contextlib.ExitStack() as last:
        with open(log, "wb") as file:  # in a session of its own: Ctrl-C reaches the learner alone, which ends both
            other = subprocess.Popen(robot, stdout=file, stderr=subprocess.STDOUT, start_new_session=True)
        last.callback(_end, other)
        first = subprocess.Popen(learner)
        last.callback(_end, first)
        while first.poll() is None and not other.poll():
            time.sleep(0.1)
        if first.returncode is None:
            first.kill()  # it would wait for another robot
            raise UserError(f"the robot's side has ended with exit code {other.returncode}; see {log}")
        if first.returncode:
            raise UserError(f"fine-tuning has ended with exit code {first.returncode}; it said why above")


def _end(process: "subprocess.Popen[bytes]") -> None:
    """Ends a process that does not end by itself."""
    try:
        process.wait(_END)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


# --- pictures ---------------------------------------------------------------------------------------------------------


def show(args: RealDemoArgs) -> None:
    """The success before and after, and where the learning curve, the video and the policy are."""
    from experiments.runner.finetune_run import evaluation_store

    run = run_folder(arguments(args.method, task=TASK, seeds=1, seed=args.seed, out=args.out), real_systems.REMOTE)
    stores = [evaluation_store(run, done) for done in (0, args.rollouts)]
    before, after = ([bool(store.load(i)["success"][0]) for i in range(len(store))] for store in stores)
    first, last = (f"{100 * sum(succeeded) / len(succeeded):.0f} %" for succeeded in (before, after))
    rates = f"{first} before, {last} after {args.rollouts} rollouts of {args.method}"
    played = f"{args.episodes} episodes, in which the cube lay within 5 cm of the mark at the end"
    print(f"\nsuccess in Bullet: {rates}; one seed, {played}")
    print(film(args, before, after) if args.video else "no video: not asked for")
    print(f"learning curve: {run / 'figures/score.png'}; what the robot's side said: {args.out / 'robot.log'}")


def film(args: RealDemoArgs, before: Sequence[bool], after: Sequence[bool]) -> str:
    """Puts the same episode before and after side by side; says in one line where, or why not."""
    import numpy as np

    from envs.mujoco.render import write_side_by_side
    from experiments.runner.pictures import telling

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


if __name__ == "__main__":
    cli.run_main(main, RealDemoArgs, __doc__ or "")
