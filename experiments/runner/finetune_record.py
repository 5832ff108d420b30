"""Impure: what a fine-tuning run leaves on disk for one real system, whether that is played alone or with others."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from envs.base import Env
from envs.gaps import Gap
from envs.types import PyTree
from experiments.runner.training import Record
from sgft_jax.analysis import figures, tables
from sgft_jax.analysis.curves import Curve, deepest_fall, describe
from sgft_jax.analysis.reading import read_curve
from sgft_jax.io.log import EVAL, check_finite, read_jsonl, write_summary
from sgft_jax.io.real import RealStore
from sgft_jax.train.finetuning import FinetuneProgress
from sgft_jax.types import Metrics

EVALUATION = "evaluation"  # the folder of episodes that evaluations on a real system have cost


def evaluation_store(folder: Path, done: int) -> RealStore:
    """The episodes of a run's evaluation after so many rollouts, where they are real ones."""
    return RealStore(folder / EVALUATION / f"rollouts-{done:06d}")


class FinetuneRecord(Record):
    """The files of a run on one real system.

    costly: whether evaluations are played on the real system and cost transitions; simulated ones are free.
    logged: real transitions that every seed began with and nobody has played here.
    """

    def __init__(
        self, folder: Path, env: Env, gap: Gap, method: str, seeds: list[int], *, costly: bool = False, logged: int = 0
    ) -> None:
        super().__init__(folder, {"kind": "finetune", "task": env.name, "method": method, "seeds": seeds})
        self.logged, self.costly = logged, costly
        self.played = self.evaluated = np.zeros(len(seeds), int)  # [S] real transitions of rollouts, of evaluations
        self.env, self.gap, self.method, self.real = env, gap, method, RealStore(folder)

    def restore(self, like: FinetuneProgress, step: int) -> tuple[FinetuneProgress, dict[str, Any]]:
        """The state of a checkpoint, to which the logs are cut back. What the robot did stays."""
        progress, meta = super().restore(like, step)
        self.played, self.evaluated = np.asarray(progress.transitions), np.asarray(meta["evaluated"])
        return progress, meta

    def metrics(self, done: int, values: Mapping[str, np.ndarray]) -> None:
        """A line of one learning phase; raises DivergedError where a number is not finite though something learned."""
        idle = values.get("updates", np.ones(len(self.seeds))) == 0
        known = {name: np.where(idle, 0.0, x) for name, x in values.items()}
        check_finite(known, done, unit="rollouts", last_good=self.last_good)
        self.log.metrics(self._transitions(), {"rollouts": done, **values})

    def evaluation(self, done: int, scores: Metrics, cost: np.ndarray) -> None:
        """A line of the learning curve. Its step is what lies behind it; what it costs itself counts from then on.

        cost: [S] steps of its episodes.
        """
        self.log.eval(self._transitions(), {"rollouts": done, "robot_minutes": self._minutes(), **scores})
        if self.costly:
            self.evaluated = self.evaluated + cost

    def time(self, done: int, seconds: float) -> None:
        """Apart from the metrics, which must not depend on the clock."""
        with open(self.folder / "timing.jsonl", "a") as file:
            file.write(json.dumps({"rollouts": done, "time/rollout_s": round(seconds, 3)}) + "\n")

    def save(self, kind: str, params: PyTree, card: Mapping[str, Any]) -> None:
        """Policies [S], `policy` (the last ones) or `best`, whose cards add to `card`."""
        env = {"task": self.env.name, "obs_dim": self.env.obs_dim, "act_dim": self.env.act_dim}
        facts = {"method": self.method, "gap": self.gap._asdict(), "which": kind}
        self.save_policies(kind, params, lambda seed: {**card, **env, "finetuned": {**facts, "seed": seed}})

    def summarise(self, done: int, best: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """summary.json, the learning curve and the closing words; the log ends here.

        done: rollouts. best: of the best policies by real evidence, [S] each: `evidence`, `rollouts`, and `score` in
        an evaluation of their own, where there was one.
        """
        self.log.close()
        env, evaluated = self.env, read_jsonl(self.folder / EVAL) if (self.folder / EVAL).exists() else []
        curve = read_curve(self.folder).of(env.score) if evaluated else None
        far = {"rollouts": done, "transitions": self._transitions(), "robot_minutes": self._minutes()}
        numbers = {"final": far, "seeds": len(self.seeds)} if curve is None else describe(curve)
        about = {"task": env.name, "method": self.method, "impl": env.impl, "gap": self.gap._asdict()}
        summary = about | {"score": env.score} | numbers | {"best": {k: x.tolist() for k, x in best.items()}}
        if self.logged:
            summary["logged"] = self.logged
        if self.costly:
            summary["real_steps"] = self._real_steps()
        write_summary(self.folder, summary)
        if curve is not None:
            self._show(curve, best.get("score"))
        return summary

    def _show(self, curve: Curve, best: np.ndarray | None) -> None:
        """The learning curve as a figure and in words. best: [S] scores of the best policies."""
        score = self.env.score
        title = f"{self.env.name} on the {self.gap.name} real system"
        figures.learning_curves(self.folder / "figures" / "score.png", {self.method: [curve]}, title=title)
        before, after = (tables.middle(curve, curve.values[:, i]) for i in (0, -1))
        chosen = "" if best is None else f"; best policy by the training rollouts {tables.plain(best.mean(), score)}"
        print(
            f"{self.gap.name}: {tables.words(score)} on the real system {before} before -> {after} after "
            f"{curve.x[-1]} rollouts; deepest fall below the start {tables.plain(deepest_fall(curve), score)}"
            f"{chosen}"
        )

    def _real_steps(self) -> list[int]:
        """[S] all steps of the real system that are on disk, those of evaluations included."""
        stores = [self.real, *(RealStore(folder) for folder in sorted((self.folder / EVALUATION).glob("*")))]
        steps = [store.rollout(i)["valid"].sum(1) for store in stores for i in range(len(store))]
        return np.sum(steps, axis=0).tolist()

    def _transitions(self) -> int:
        """Real transitions of a seed so far, those that evaluations have cost included; the mean where seeds differ."""
        return round(float(np.mean(self.played + self.evaluated)))

    def _minutes(self) -> float:
        return self._transitions() * self.env.control_dt / 60
