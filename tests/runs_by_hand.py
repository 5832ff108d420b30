"""Run folders with known learning curves."""

import json

STEPS = 20  # of an episode


def save(
    out, label, success, *, rollouts, task="toy", real="default", seeds="seeds-0-1", wanted=None, priors=(), variant=""
):
    """A run: success [evaluations][seeds] after so many rollouts of 20 steps of 0.1 s, with ten times it as return.

    label: the method, with its variant if it has one. priors: digests of those that the seeds began from, in turn.
    """
    folder = out / "finetune" / task / real / label / seeds
    folder.mkdir(parents=True)
    with open(folder / "eval.jsonl", "w") as file:
        for n, each in zip(rollouts, success, strict=True):
            line = {"step": STEPS * n, "rollouts": n, "robot_minutes": n * STEPS * 0.1 / 60}
            file.write(json.dumps({**line, "success": each, "return": [10 * score for score in each]}) + "\n")
    first = int(seeds.split("-")[1])
    config = {"preset": "fast", "prior": None, "seed": first, "rollouts": wanted or rollouts[-1], "variant": variant}
    config["options"] = {"horizon": 4, "network": {"hidden": [8, 8]}}
    (folder / "config.json").write_text(json.dumps({"sgft_jax": "0", "kind": "finetune", "config": config}))
    start = {"git": {"commit": "0123456789abcdef"}, "device": {"kind": "cpu", "count": 1}, "priors": list(priors)}
    (folder / "provenance.json").write_text(json.dumps({"starts": [start]}))
    return folder


def pretrained(out, *, task="toy", preset="fast"):
    """A finished run of pretraining of two priors, evaluated twice."""
    folder = out / "pretrain" / task / preset / "seeds-0-1"
    folder.mkdir(parents=True)
    lines = [{"step": n, "success": [0.1 * n, 0.2 * n], "return": [-n, n]} for n in (0, 4)]
    (folder / "eval.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    config = {"preset": preset, "out": "/home/somebody/runs", "config": {"gamma": 0.9}}
    (folder / "config.json").write_text(json.dumps({"kind": "pretrain", "config": config}))
    start = {"git": {"commit": "0123456789abcdef"}, "command": "pretrain.py --out /home/somebody/runs"}
    (folder / "provenance.json").write_text(json.dumps({"starts": [start]}))
    seeds = [{"seed": i, "success": 0.4 + i / 2, "success/interval": [0.3, 1.0]} for i in range(2)]
    (folder / "summary.json").write_text(json.dumps({"seeds": seeds, "time/train_s": 12.5}))
    return folder
