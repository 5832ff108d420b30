"""Impure: what a fine-tuning run leaves on disk for one real system, whether that is stepped alone or with others."""

import json
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np

from envs.base import Env, World
from envs.gaps import Gap
from envs.rollout import Episode
from experiments.results import describe_run, read_curve
from experiments.stacking import member
from experiments.video import before_and_after
from sgft_jax.analysis import plot
from sgft_jax.analysis.stats import iqm_interval
from sgft_jax.io import checkpoint
from sgft_jax.io.log import MetricsLog, write_summary
from sgft_jax.io.real import RealStore
from sgft_jax.types import Array, Metrics, Prior, PyTree

OFFLINE = "offline"  # checkpoints of learning before the first real rollout: those of the run count rollouts


class Record:
    """The files of one run folder (docs/formats.md). Arrays and states have a leading axis of the seeds [S]."""

    def __init__(self, folder: Path, env: Env, gap: Gap, method: str, seeds: list[int]) -> None:
        self.folder, self.env, self.gap, self.method, self.seeds = folder, env, gap, method, seeds
        self.log, self.real = MetricsLog(folder), RealStore(folder)
        self.expect = {"kind": "finetune", "task": env.name, "method": method, "seeds": seeds}

    def rollouts(self) -> int:
        """Those behind the last checkpoint; 0 without one."""
        return checkpoint.latest(self.folder) or 0

    def clear(self) -> None:
        """What an earlier start wrote before its first checkpoint."""
        self.log.truncate({})
        self.real.truncate(0)

    def restore(self, like: PyTree, rollouts: int) -> PyTree:
        """The state of the checkpoint after so many rollouts, to which the logs are cut back."""
        state, meta = checkpoint.restore(self.folder, like, step=rollouts, expect=self.expect)
        self.log.truncate(meta["position"])
        self.real.truncate(meta["stored"])
        return state

    def offline(self) -> int:
        """Updates of the offline phase behind its last checkpoint; 0 without one."""
        return checkpoint.latest(self.folder / OFFLINE) or 0

    def restore_offline(self, like: PyTree, updates: int) -> PyTree:
        """The state of the checkpoint after so many of them."""
        return checkpoint.restore(self.folder / OFFLINE, like, step=updates, expect=self.expect)[0]

    def checkpoint_offline(self, state: PyTree, updates: int) -> None:
        """The state after so many of them."""
        checkpoint.save(self.folder / OFFLINE, updates, state, meta=self.expect)

    def store(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Real rollouts, arrays [S, rollouts, T, ...]: one file each, of arrays [S, T, ...]."""
        for i in range(arrays["reward"].shape[1]):
            self.real.append({name: x[:, i] for name, x in arrays.items()})

    def metrics(self, done: int, values: Mapping[str, Array | np.ndarray]) -> None:
        """A line of one learning phase."""
        self.log.metrics(self._transitions(done), {"rollouts": done, **values})

    def evaluation(self, done: int, scores: Metrics) -> None:
        """A line of the learning curve."""
        minutes = self._transitions(done) * self.env.control_dt / 60
        self.log.eval(self._transitions(done), {"rollouts": done, "robot_minutes": minutes, **scores})

    def checkpoint(self, state: PyTree, done: int) -> None:
        """The state, and how long the logs are. The offline phase is not gone back to."""
        meta = {**self.expect, "rollouts": done, "stored": len(self.real), "position": self.log.position()}
        checkpoint.save(self.folder, done, state, meta=meta)
        shutil.rmtree(self.folder / OFFLINE, ignore_errors=True)

    def time(self, done: int, collect_s: float, learn_s: float) -> None:
        """Apart from the metrics, which must not depend on the clock."""
        line = {"rollouts": done, "time/collect_s": round(collect_s, 3), "time/learn_s": round(learn_s, 3)}
        with open(self.folder / "timing.jsonl", "a") as file:
            file.write(json.dumps(line) + "\n")

    def save_policies(self, export: Callable[[PyTree, int], Prior], state: PyTree, card: Mapping[str, Any]) -> None:
        """The fine-tuned policies in the form of priors: policy/seed-<k>. export(state, i) -> that of the i-th seed."""
        for i, seed in enumerate(self.seeds):
            facts = {"method": self.method, "gap": self.gap._asdict(), "seed": seed}
            checkpoint.save_prior(
                self.folder / "policy" / f"seed-{seed}", export(state, i), {**card, "finetuned": facts}
            )

    def summarise(self) -> dict[str, Any]:
        """summary.json, the learning curve and the closing words; the log ends here."""
        self.log.close()
        env, curve = self.env, read_curve(self.folder)
        about = {"task": env.name, "method": self.method, "impl": env.impl, "gap": self.gap._asdict()}
        summary = about | describe_run(curve)
        write_summary(self.folder, summary)
        plot.learning_curves(
            self.folder / "figures" / "success.png",
            {self.method: (curve.transitions, curve.success)},
            title=f"{env.name} on the {self.gap.name} real system",
            zero_shot=float(iqm_interval(curve.success[:, 0]).estimate),
            rollout_length=env.episode_length,
            control_dt=env.control_dt,
        )
        zero, final = (summary[when]["success"] for when in ("zero_shot", "final"))
        band = f" [{final['low']:.2f}, {final['high']:.2f}]" if len(self.seeds) > 1 else ""
        print(
            f"{self.gap.name}: success {zero['iqm']:.2f} zero-shot -> {final['iqm']:.2f}{band} after "
            f"{summary['final']['rollouts']} rollouts; deepest dip {summary['dip']['mean']:.3f}"
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
