"""Impure: what a fine-tuning run leaves on disk for one real system, whether that is played alone or with others."""

import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.base import Env, World
from envs.gaps import Gap
from envs.rollout import Episode
from experiments.stacking import member
from experiments.video import before_and_after
from sgft_jax.analysis import figures, tables
from sgft_jax.analysis.curves import deepest_fall, describe, read_curve
from sgft_jax.io import checkpoint
from sgft_jax.io.log import MetricsLog, check_finite, write_summary
from sgft_jax.io.priors import save_prior
from sgft_jax.io.real import RealStore
from sgft_jax.train import OFFLINE_PART, FinetuneProgress
from sgft_jax.types import Metrics, Prior, PyTree


class Record:
    """The files of one run folder (docs/formats.md). Arrays and states have a leading axis of the seeds [S]."""

    def __init__(self, folder: Path, env: Env, gap: Gap, method: str, seeds: list[int]) -> None:
        self.folder, self.env, self.gap, self.method, self.seeds = folder, env, gap, method, seeds
        self.log, self.real = MetricsLog(folder), RealStore(folder)
        self.last_good: Path | None = None  # the checkpoint to go back to when training diverges
        self.expect = {"kind": "finetune", "task": env.name, "method": method, "seeds": seeds}

    def latest(self) -> int | None:
        """The step of the last checkpoint: parts of the offline phase and rollouts together; None without one."""
        return checkpoint.latest(self.folder)

    def restore(self, like: FinetuneProgress, step: int) -> FinetuneProgress:
        """The state of that checkpoint, to which the logs are cut back. What the robot did stays."""
        progress, meta = checkpoint.restore(self.folder, like, step=step, expect=self.expect)
        self.log.truncate(meta["position"])
        self.last_good = checkpoint.path(self.folder, step)
        return progress

    def checkpoint(self, progress: FinetuneProgress) -> None:
        """The state, and how long the logs are."""
        step = int(progress.rollouts) + -(-int(progress.offline) // OFFLINE_PART)
        meta = {**self.expect, "rollouts": int(progress.rollouts), "position": self.log.position()}
        self.last_good = checkpoint.save(self.folder, step, progress, meta=meta)

    def metrics(self, done: int, values: Mapping[str, np.ndarray]) -> None:
        """A line of one learning phase; raises DivergedError where a number is not finite."""
        check_finite(values, done, unit="rollouts", last_good=self.last_good)
        self.log.metrics(self._transitions(done), {"rollouts": done, **values})

    def evaluation(self, done: int, scores: Metrics) -> None:
        """A line of the learning curve."""
        minutes = self._transitions(done) * self.env.control_dt / 60
        self.log.eval(self._transitions(done), {"rollouts": done, "robot_minutes": minutes, **scores})

    def time(self, done: int, seconds: float) -> None:
        """Apart from the metrics, which must not depend on the clock."""
        with open(self.folder / "timing.jsonl", "a") as file:
            file.write(json.dumps({"rollouts": done, "time/rollout_s": round(seconds, 3)}) + "\n")

    def save_policies(self, kind: str, params: PyTree, card: Mapping[str, Any]) -> None:
        """Policies [S] in the form of priors: <kind>/seed-<k>. kind: `policy`, the last ones, or `best`."""
        own = {"task": self.env.name, "obs_dim": self.env.obs_dim, "act_dim": self.env.act_dim}
        for i, seed in enumerate(self.seeds):
            facts = {"method": self.method, "gap": self.gap._asdict(), "seed": seed, "which": kind}
            prior = Prior(member(params, i), {**card, **own, "finetuned": facts})
            save_prior(self.folder / kind / f"seed-{seed}", prior)

    def summarise(self, best: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """summary.json, the learning curve and the closing words; the log ends here.

        best: of the best policies by real evidence, [S] each: `score` in the evaluation, `evidence`, `rollouts`.
        """
        self.log.close()
        env, curve = self.env, read_curve(self.folder).of(self.env.score)
        about = {"task": env.name, "method": self.method, "impl": env.impl, "gap": self.gap._asdict()}
        summary = about | {"score": env.score} | describe(curve) | {"best": {k: x.tolist() for k, x in best.items()}}
        write_summary(self.folder, summary)
        title = f"{env.name} on the {self.gap.name} real system"
        figures.learning_curves(self.folder / "figures" / "success.png", {self.method: [curve]}, title=title)
        before, after = (tables.middle(curve, curve.values[:, i]) for i in (0, -1))
        fall, chosen = (tables.plain(x, env.score) for x in (deepest_fall(curve), float(best["score"].mean())))
        print(
            f"{self.gap.name}: {tables.words(env.score)} on the real system {before} before -> {after} after "
            f"{curve.rollouts[-1]} rollouts; deepest fall below the start {fall}; best policy by the training rollouts "
            f"{chosen}"
        )
        return summary

    def film(self, pool: World, play: Callable[[], Sequence[Episode]], rollouts: int) -> str:
        """An evaluation episode of the first seed before and after fine-tuning; says in one line how it went.

        play() -> both policies' episodes [S, n] in worlds of `pool`. The first one that only the tuned agent solves:
        what fine-tuning is about. Without one, the first.
        """

        def chosen() -> list[Episode]:
            both = [member(episodes, 0) for episodes in play()]
            old, new = (np.asarray(episodes.success) for episodes in both)
            first = int(np.argmax(new & ~old))
            return [jax.tree.map(lambda x: np.asarray(x[first]), episodes) for episodes in both]

        path = self.folder / "videos" / f"seed-{self.seeds[0]}.mp4"
        return before_and_after(self.env, pool, chosen, path, rollouts=rollouts)

    def _transitions(self, rollouts: int) -> int:
        return rollouts * self.env.episode_length
