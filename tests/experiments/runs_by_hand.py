"""Run folders with known learning curves."""

import json

from experiments.comparison import split
from experiments.finetune_args import FinetuneArgs, arguments
from sgft_jax.io.config import config_to_json
from sgft_jax.methods import METHODS

STEPS = 20  # of an episode


def save(out, method, success, *, rollouts, task="toy", real="default", seeds="seeds-0-1", wanted=None, **options):
    """A run: success [evaluations][seeds] after so many rollouts of 20 steps of 0.1 s; options: of `FinetuneConfig`."""
    folder = out / "finetune" / task / real / method / seeds
    folder.mkdir(parents=True)
    with open(folder / "eval.jsonl", "w") as file:
        for n, each in zip(rollouts, success, strict=True):
            line = {"step": STEPS * n, "rollouts": n, "robot_minutes": n * STEPS * 0.1 / 60}
            file.write(json.dumps({**line, "success": each, "return": each}) + "\n")
    name, _ = split(method)
    args = arguments(name) if name in METHODS else FinetuneArgs()
    config = config_to_json(args) | {"rollouts": wanted or rollouts[-1]}
    config["options"] |= options
    (folder / "config.json").write_text(json.dumps({"sgft_jax": "0", "kind": "finetune", "config": config}))
    return folder


def rising(reached, *, to=100, level=1.0, seeds=2):
    """Rollouts and success of a run whose seeds get to `level` after `reached` rollouts, of `to`; None = never."""
    rollouts = [0, *range(10, to + 1, 10)]
    return {
        "rollouts": rollouts,
        "success": [[level if reached is not None and n >= reached else 0.0] * seeds for n in rollouts],
    }
