"""Look at real rollouts that a run has stored: a plot of what was measured, commanded and sent, and a video."""

from dataclasses import dataclass
from pathlib import Path

from envs.types import UserError
from experiments.runner import cli
from experiments.runner.options import episodes_of, home_of_rollouts, task_of_rollouts, without_repeats
from sgft_jax.io.real import Played
from sgft_jax.io.runs import check_folder


@dataclass(frozen=True)
class ReplayArgs:
    """Some rollouts of one seed, one after another."""

    run: Path
    """Folder of a fine-tuning run, or any other with rollouts in real/ (docs/formats.md)."""
    rollout: tuple[int, ...] = ()
    """Their numbers, as those of the files, e.g. --rollout 0 19; default: the last one."""
    seed: int | None = None
    """Seed whose rollouts are shown; default: the first one of the run."""
    out: Path | None = None
    """Folder for the pictures. Default: replay/ inside --run."""
    video: bool = True
    """Render each rollout too, where its states were stored and MuJoCo can render."""
    task: str | None = None
    """A Python file with a task of your own; default: the task of the run."""


def main(args: ReplayArgs) -> None:
    """Draws, and says where the pictures are."""
    home = home_of_rollouts("--run", args.run)
    out = args.out or home / "replay"
    check_folder(out)
    task, episodes = task_of_rollouts(home, args.task), chosen(home, args)
    from experiments.runner.pictures import draw

    print("\n".join(draw(home, task, episodes, out, video=args.video)))


def chosen(home: Path, args: ReplayArgs) -> list[Played]:
    """The rollouts that are asked for; raises UserError for numbers that there are not."""
    without_repeats("--rollout", [str(n) for n in args.rollout])
    stored = episodes_of(home, args.seed)
    episodes = {e.number: e for e in stored if e.seed == stored[0].seed and len(e.rows.reward)}
    if not episodes:
        raise UserError(f"{home / 'real'}: holds no valid step")
    if missing := [n for n in args.rollout if n not in episodes]:
        raise UserError(f"--rollout {missing[0]}: {home / 'real'} has {min(episodes)} to {max(episodes)}")
    return [episodes[n] for n in args.rollout or (max(episodes),)]


if __name__ == "__main__":
    cli.run_main(main, ReplayArgs, __doc__ or "")
