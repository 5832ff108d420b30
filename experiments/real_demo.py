"""Fine-tuning in another engine: a small prior of `panda-push` meets panda-gym, in Bullet, behind the socket.

Bullet needs Python 3.11 and therefore an environment of its own, which the first run makes.
"""

import os
import shutil
import subprocess
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from experiments import cli
from experiments.options import SHIPPED, at_least_one
from sgft_jax.types import UserError

if TYPE_CHECKING:
    import numpy as np

    from envs.rollout import Episode
    from sgft_jax.systems.remote import Remote

TASK = "panda-push"
DRIVER = Path("docs/examples/panda_gym_robot.py")  # in the folder of the code, as the priors are
PACKAGES = (
    "panda-gym==3.0.7", "pybullet==3.2.7", "gymnasium==1.4.0", "numpy==2.4.6", "msgpack==1.2.4", "websockets==17.4",
)  # fmt: skip
_FILMED = 3  # episodes of the first and of the last evaluation, to choose a telling one from
_CONNECT, _END = 60.0, 10.0  # seconds in which the robot's side must have connected, and ended


@dataclass(frozen=True)
class RealDemoArgs:
    """A few minutes on two cores; everything but the environment of Bullet lands in one folder."""

    prior: Path = SHIPPED / TASK / "seed-0"
    """Folder of a prior of panda-push. None comes with the code yet."""
    method: str = "guarded"
    """How to fine-tune."""
    rollouts: int = 8
    """Real rollouts."""
    episodes: int = 20
    """Of each evaluation: before, half-way and after. They are the same ones each time."""
    seed: int = 0
    """Of fine-tuning and of the episodes."""
    video: bool = True
    """Film some episodes before and after."""
    out: Path = Path("runs/real-demo")
    """Folder of the demo; an earlier demo in it is replaced."""
    home: Path = Path("build/panda-gym")
    """Where the environment of Bullet is, or shall be made."""
    python: str = os.environ.get("PYTHON311") or "python3.11"
    """What makes it: a Python 3.11, by default $PYTHON311 or python3.11."""


def main(args: RealDemoArgs) -> None:
    """Makes the second environment, plays, learns, plays again, and shows what came of it."""
    check(args)
    started = time.monotonic()
    python = bullet(args.home, args.python)
    shutil.rmtree(args.out, ignore_errors=True)
    args.out.mkdir(parents=True)
    evaluations = fine_tune(args, python)
    show(args, evaluations)
    print(f"{(time.monotonic() - started) / 60:.1f} minutes in all")


def check(args: RealDemoArgs) -> None:
    """Raises UserError for all that is wrong with the options before anything is made."""
    at_least_one(args, "rollouts", "episodes")
    if not (args.prior / "prior.json").exists():
        command = f"python -m experiments.pretrain --task {TASK}"
        raise UserError(f"--prior {args.prior}: holds no prior; make one with: {command}")
    if not DRIVER.exists():
        raise UserError(f"{DRIVER}: no such file; run this command in the folder of the code")
    if args.out.exists() and any(args.out.iterdir()) and not (args.out / "robot.log").exists():
        raise UserError(f"--out {args.out}: holds something that is no demo; choose another folder")


# --- the robot's side -------------------------------------------------------------------------------------------------


def bullet(home: Path, python: str) -> Path:
    """The Python of the environment with panda-gym in `home`, which is made where there is none.

    Raises UserError where there is no Python 3.11, or where its packages cannot be had.
    """
    own = home / "bin" / "python"
    if _said(str(own), "import panda_gym, msgpack, websockets") is not None:
        return own
    if _said(python, "import sys; sys.exit(sys.version_info[:2] != (3, 11))") is None:
        raise UserError(f"{python} is no Python 3.11, for which pybullet has wheels; name one with PYTHON311=...")
    print(f"making an environment for Bullet in {home}, once", flush=True)
    for command in ([python, "-m", "venv", "--clear", str(home)], [str(own), "-m", "pip", "install", "-q", *PACKAGES]):
        done = subprocess.run(command, capture_output=True, text=True)
        if done.returncode:
            last = (done.stderr.strip() or f"exit code {done.returncode}").splitlines()[-1]
            raise UserError(f"{' '.join(command[:4])} failed: {last}")
    return own


def _said(python: str, code: str) -> str | None:
    """What Python prints for the code; None where it fails, or where there is no such Python."""
    try:
        done = subprocess.run([python, "-c", code], capture_output=True, text=True)
    except OSError:
        return None
    return None if done.returncode else done.stdout


class Robot:
    """The robot's side as a process of its own; ends with the `with` block, whatever happens in it.

    command: what starts it, but for where the learner listens. log: file for what it says.
    """

    def __init__(self, command: Sequence[str], log: Path) -> None:
        self.command, self.log = list(command), log
        self.process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> "Robot":
        return self

    def connect(self, remote: "Remote") -> None:
        """Starts it, and waits until it has found the learner. Raises UserError where it has ended before."""
        reach = ["--url", remote.url, "--token", remote.token]
        with open(self.log, "wb") as log:  # in a session of its own: Ctrl-C reaches the learner alone, which ends both
            self.process = subprocess.Popen(
                [*self.command, *reach], stdout=log, stderr=subprocess.STDOUT, start_new_session=True
            )
        until = time.monotonic() + _CONNECT
        while b"connected to" not in self.log.read_bytes():
            self.hear()
            if time.monotonic() > until:
                raise UserError(f"the robot's side has not connected within {_CONNECT:g} s; see {self.log}")
            time.sleep(0.1)

    def hear(self, line: str = "") -> None:
        """Prints what the learner says of its robot. Raises UserError where its process has ended."""
        if self.process is not None and self.process.poll() is not None:
            raise UserError(f"the robot's side has ended with exit code {self.process.returncode}; see {self.log}")
        if line:
            print(line)

    def __exit__(self, *raised: object) -> None:
        if self.process is None:
            return
        try:
            self.process.wait(_END)  # the learner has told it to end
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


# --- the learner's side -----------------------------------------------------------------------------------------------


def fine_tune(args: RealDemoArgs, python: Path) -> "dict[int, Episode]":
    """Evaluations by the rollouts that were learned from; episodes [1, n]."""
    import envs
    import sgft_jax
    from sgft_jax.io.priors import observed

    prior = sgft_jax.load_prior(args.prior, task=TASK)
    env = envs.make(TASK, **observed(prior.card))
    at = sorted({0, args.rollouts // 2, args.rollouts})
    film = _filmed(args, len(at)) if args.video else []
    command = [str(python), "-u", str(DRIVER), "--into", str(args.out / "pictures")]
    command += ["--film", *map(str, sum(film, ()))] if film else []
    found: dict[int, Episode] = {}
    with Robot(command, args.out / "robot.log") as robot:
        remote = sgft_jax.Remote(env.measured_dim, env.act_dim, steps=env.episode_length, say=robot.hear)
        try:
            robot.connect(remote)
            system = sgft_jax.Gymnasium(env, remote, gamma=prior.card["gamma"])
            setup = sgft_jax.setup(env, system, prior, method=args.method, seeds=[args.seed])
            for state, metrics in sgft_jax.finetune(*setup, rollouts=args.rollouts):
                done = int(state.rollouts)
                if metrics:
                    print(f"rollout {done}: {'success' if metrics['real/score'][0] > 0.5 else 'failure'}", flush=True)
                if done in at:
                    found[done] = sgft_jax.evaluate(setup.finetuner, system, state.agent, setup.seeds, args.episodes)
                    print(f"after {done} rollouts: success {_percent(found[done])}", flush=True)
            tuned = sgft_jax.finetuned_priors(setup, state, prior, best=False)
            sgft_jax.save_prior(args.out / "policy" / f"seed-{args.seed}", tuned[0])
        finally:
            remote.close()
    return found


def _filmed(args: RealDemoArgs, evaluations: int) -> list[tuple[int, ...]]:
    """Numbers of the first episodes of the first and of the last evaluation, as the robot counts them."""
    count = min(_FILMED, args.episodes)
    last = (evaluations - 1) * args.episodes + args.rollouts
    return [tuple(range(count)), tuple(range(last, last + count))]


def _percent(played: "Episode") -> str:
    return f"{100 * float(played.score.mean()):.0f} %"


# --- pictures ---------------------------------------------------------------------------------------------------------


def show(args: RealDemoArgs, evaluations: "dict[int, Episode]") -> None:
    """The success before and after, and where the learning curve, the video and the policy are."""
    import envs
    from sgft_jax.analysis import curves, figures

    curve = curves.make_curve(evaluations, envs.make(TASK), gap="Bullet", method=args.method, seeds=[args.seed])
    picture = figures.learning_curves(
        args.out / "figures" / "curve.png", {"panda-gym (Bullet)": [curve]}, title="fine-tuning in another engine"
    )
    first, *_, last = evaluations.values()
    print(
        f"\nsuccess in Bullet: {_percent(first)} before, {_percent(last)} after {args.rollouts} rollouts of "
        f"{args.method}; one seed, {args.episodes} episodes, in which the cube lay within 5 cm of the mark at the end"
    )
    print(f"learning curve: {picture}")
    print(film(args, evaluations) if args.video else "no video: not asked for")
    print(f"policy: {args.out / 'policy' / f'seed-{args.seed}'}; what the robot's side said: {args.out / 'robot.log'}")


def film(args: RealDemoArgs, evaluations: "dict[int, Episode]") -> str:
    """Puts the same episode before and after side by side; says in one line where, or why not."""
    import numpy as np

    from envs.mujoco.render import write_side_by_side

    first, *_, last = (np.asarray(played.success[0]) for played in evaluations.values())
    before, after = _filmed(args, len(evaluations))
    i = telling(first[: len(before)], last[: len(before)])
    path, captions = args.out / "videos" / "before-after.mp4", [_caption("before", first[i])]
    captions.append(_caption(f"after {args.rollouts} rollouts", last[i]))
    try:
        files = [args.out / "pictures" / f"episode-{numbers[i]}.npz" for numbers in (before, after)]
        write_side_by_side([np.load(file)["pictures"] for file in files], captions, path)
    except Exception as error:  # whatever a file or a video encoder raises: a demo does not fail for a picture
        return f"no video: {(str(error).strip() or type(error).__name__).splitlines()[0]}"
    return f"video: {path}"


def telling(first: "np.ndarray", last: "np.ndarray") -> int:
    """Which episode to show, of successes before and after, [n] bool: the first that was mended, else the first."""
    mended = (~first & last).nonzero()[0]
    return int(mended[0]) if len(mended) else 0


def _caption(when: str, success: bool) -> str:
    return f"{when}: {'success' if success else 'failure'}"


if __name__ == "__main__":
    cli.run_main(main, RealDemoArgs, __doc__ or "")
