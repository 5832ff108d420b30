"""The whole method at a small scale on a CPU: pretrain, meet a "real" system, fine-tune with and without SGFT."""

import time
from dataclasses import dataclass, replace
from pathlib import Path

from experiments import cli
from experiments.figures import FiguresArgs, figures
from experiments.finetune import FinetuneArgs, finetune
from experiments.presets import PRESETS
from experiments.pretrain import PretrainArgs, pretrain
from sgft_jax.finetune import FinetuneConfig

METHODS = ("sgft-sac", "sac")


@dataclass(frozen=True)
class DemoArgs:
    """A few minutes of the whole pipeline; everything lands in one folder."""

    task: str = "push"
    """push, hammer or insert."""
    real: str = "default"
    """The real system, as in fine-tuning."""
    env_steps: int | None = None
    """Environment steps of pretraining, default: those of preset `cpu`."""
    seeds: int = 3
    """Fine-tuning seeds per method."""
    rollouts: int = 40
    """Real rollouts per seed, the 20 initial ones included."""
    video: bool = True
    """Render an episode before and after fine-tuning, where MuJoCo can render."""
    out: Path = Path("runs/demo")
    """Folder of the demo; an earlier demo in it is replaced."""


def main(args: DemoArgs) -> None:
    """Pretrains once, fine-tunes with each method from the same prior on the same real starts, and compares."""
    started = time.monotonic()
    config = PRESETS["cpu"]
    config = config if args.env_steps is None else replace(config, env_steps=args.env_steps)
    shared = {"task": args.task, "preset": "cpu", "out": args.out, "overwrite": True}
    pretrain(PretrainArgs(config=config, report=False, video=False, **shared))
    # Smaller batches and fewer, larger updates: what two cores can do; both methods get the same.
    options = FinetuneConfig(batch_size=64, branches=2, lr_actor=3e-4, actor_ramp=300)
    initial = min(20, args.rollouts)
    for method in METHODS:
        finetune(
            FinetuneArgs(
                real=args.real,
                method=method,
                seeds=args.seeds,
                rollouts=args.rollouts,
                initial_rollouts=initial,
                utd=3.0,
                eval_every=10,
                eval_episodes=initial,  # the program that plays the initial rollouts serves again
                options=options,
                video=args.video and method == METHODS[0],
                **shared,
            )
        )
    print(figures(FiguresArgs(task=args.task, out=args.out)).read_text())
    folder = args.out / "finetune" / args.task / Path(args.real).stem
    print(f"{time.monotonic() - started:.0f} s in all; curves, video and every real rollout: {folder}")


if __name__ == "__main__":
    cli.run_main(main, DemoArgs, __doc__ or "")
