"""Fine-tune a pretrained policy on a "real" system and draw its learning curve."""

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from experiments.cli import run_main
from sgft_jax.finetune import FinetuneConfig


@dataclass(frozen=True)
class FinetuneArgs:
    """Fine-tuning of several seeds at once, all in one compiled program."""

    task: str = "push"
    """push, hammer or insert."""
    method: str = "sgft-sac"
    """sgft-sac, sgft, sac, sac-reset, pbrs, pbrs-branch or mbpo."""
    real: str = "default"
    """The real system: mild, default, hard, or a .toml/.json file with tables `params` and `effects`."""
    set: tuple[str, ...] = ()
    """Changes to it, e.g. --set latency=0.05 action_scale=[1,0.5]."""
    preset: str = "fast"
    """Pretraining preset whose priors to start from."""
    prior: Path | None = None
    """Folder of a prior, or of several (prior/seed-*); default: those of <out>/pretrain/<task>/<preset>."""
    seed: int = 0
    """First seed."""
    seeds: int = 10
    """Number of seeds; seed i starts from prior i modulo the number of priors."""
    rollouts: int = 100
    """Real rollouts per seed, the initial ones included."""
    initial_rollouts: int = 20
    """Rollouts of the simulator's policy that fill the buffer before learning starts."""
    utd: float = 2.0
    """Updates per real transition (O-1)."""
    eval_every: int = 5
    """Rollouts between evaluations."""
    eval_episodes: int = 50
    """Episodes per seed and evaluation, always the same ones; they cost no real transitions."""
    checkpoint_every: int = 10
    """Rollouts between checkpoints."""
    options: FinetuneConfig = field(default_factory=FinetuneConfig)
    """Method options; `network` and `gamma` always are the prior's."""
    video: bool = True
    """Render an episode before and after fine-tuning, side by side."""
    out: Path = Path("runs")
    resume: bool = False
    overwrite: bool = False


def main(args: FinetuneArgs) -> None:
    """Runs, or continues, one fine-tuning experiment."""
    finetune(args)


def run_folder(args: FinetuneArgs) -> Path:
    """Where the run of these arguments lives."""
    real = "_".join([Path(args.real).stem, *(s.replace("/", "") for s in args.set)])
    return args.out / "finetune" / args.task / real / args.method / f"seeds-{args.seed}-{args.seed + args.seeds - 1}"


def finetune(args: FinetuneArgs) -> dict[str, Any]:
    """One fine-tuning run from (or back) to disk; returns its summary."""
    import jax
    import jax.numpy as jnp

    import envs
    from envs import gaps
    from experiments.common import find_priors, network_of, stack
    from experiments.finetuning import make_program
    from sgft_jax import runs
    from sgft_jax.finetune import make_finetuner
    from sgft_jax.log import MetricsLog, RealLog, RunProgress
    from sgft_jax.sgft import get_method

    _check(args)
    method = get_method(args.method)
    env = envs.make(args.task)
    gap = gaps.load(env, args.real, args.set)
    priors, card = find_priors(args.prior, out=args.out, env=env, preset=args.preset)
    config = replace(args.options, network=network_of(card), gamma=card["gamma"])
    run = runs.open_run(
        run_folder(args),
        kind="finetune",
        config=args,
        resume=args.resume,
        overwrite=args.overwrite,
        volatile=("resume", "overwrite", "rollouts", "video"),
    )
    pool = gaps.worlds(env, gap, jax.random.key(0))
    tuner = make_finetuner(
        method, config, obs_dim=env.obs_dim, act_dim=env.act_dim, reward=env.reward, terminated=env.terminated
    )
    program = make_program(env, tuner, gamma=config.gamma)
    seeds = jnp.arange(args.seed, args.seed + args.seeds, dtype=jnp.uint32)
    loop = _Loop(args, env, program, pool, seeds, run.folder, MetricsLog(run.folder), RealLog(run.folder))
    state, done = loop.start(lambda: program.init(stack([priors[i % len(priors)] for i in range(args.seeds)]), seeds))
    with RunProgress(f"{args.method} on {args.task}/{gap.name}", total=args.rollouts, unit="rollouts", done=done) as bar:
        while done < args.rollouts:
            state, done = loop.advance(state, done, bar)
    loop.log.close()
    loop.save_policies(state, card)
    summary = loop.summarise(state, gap)
    loop.show(state, tuner, priors, card, gap)
    run.close()
    return summary


class _Loop:
    """The impure part of a run: what happens between compiled calls, in order, on disk before in memory."""

    def __init__(self, args, env, program, pool, seeds, folder, log, real) -> None:  # noqa: ANN001
        self.args, self.env, self.program, self.pool, self.seeds = args, env, program, pool, seeds
        self.folder, self.log, self.real = folder, log, real
        self.expect = {"kind": "finetune", "task": args.task, "method": args.method, "seeds": args.seeds}

    def start(self, make):  # noqa: ANN001, ANN201
        """The state to continue from and its rollout count: a checkpoint's, or a fresh one with its zero-shot score."""
        import jax

        from sgft_jax import checkpoint

        if self.args.resume and checkpoint.latest(self.folder) is not None:
            state, meta = checkpoint.restore(self.folder, jax.eval_shape(make), expect=self.expect)
            self.log.truncate(meta["position"])
            self.real.truncate(meta["stored"])
            return state, meta["rollouts"]
        self.log.truncate({})
        self.real.truncate(0)
        state = make()
        self._evaluate(state, 0)
        return state, 0

    def advance(self, state, done: int, bar):  # noqa: ANN001, ANN201
        """Some real rollouts, then learning from them: the initial ones together, later ones one by one."""
        args = self.args
        n = args.initial_rollouts if done == 0 else 1
        started = time.perf_counter()
        episodes = self.program.collect(state, self.pool, self.seeds, done, n)
        self._store(episodes, n)
        collected = time.perf_counter()
        updates = max(round(args.utd * n * self.env.episode_length), 1)
        state, metrics = self.program.learn(state, episodes, self.seeds, done, updates)
        metrics = {k: np.asarray(v) for k, v in metrics.items()}
        done += n
        own = {"real/return": np.asarray(episodes.total_reward).mean(1), "real/success": np.asarray(episodes.success).mean(1)}
        own["real/exploded"] = np.asarray(episodes.exploded).mean(1)
        self.log.metrics(self._transitions(done), {"rollouts": done, **own, **metrics})
        success = None
        if done % args.eval_every == 0 or done >= args.rollouts or n > 1:
            success = self._evaluate(state, done)
        if done % args.checkpoint_every == 0 or done >= args.rollouts or n > 1:
            self._checkpoint(state, done)
        learned = time.perf_counter()
        bar.advance(n, {"real success": own["real/success"].mean(), **({"success": success} if success is not None else {})})
        self._time(done, collected - started, learned - collected)
        return state, done

    def _transitions(self, rollouts: int) -> int:
        return rollouts * self.env.episode_length

    def _store(self, episodes, n: int) -> None:  # noqa: ANN001
        """Every real transition reaches the disk before a learner sees it: one file a rollout, arrays [seeds, T, ...]."""
        arrays = {**episodes.transitions._asdict(), "valid": episodes.valid, "qpos": episodes.qpos}
        arrays = {k: np.asarray(v) for k, v in arrays.items()}
        for i in range(n):
            self.real.append({k: v[:, i] for k, v in arrays.items()})

    def _evaluate(self, state, done: int) -> float:  # noqa: ANN001
        scores = {k: np.asarray(v) for k, v in self.program.evaluate(state, self.pool, self.seeds, self.args.eval_episodes).items()}
        minutes = self._transitions(done) * self.env.control_dt / 60
        self.log.eval(self._transitions(done), {"rollouts": done, "robot_minutes": minutes, **scores})
        return float(scores["success"].mean())

    def _checkpoint(self, state, done: int) -> None:  # noqa: ANN001
        from sgft_jax import checkpoint

        meta = {**self.expect, "rollouts": done, "stored": len(self.real), "position": self.log.position()}
        checkpoint.save(self.folder, done, state, meta=meta)

    def _time(self, done: int, collect_s: float, learn_s: float) -> None:
        import json

        with open(self.folder / "timing.jsonl", "a") as file:
            file.write(json.dumps({"rollouts": done, "time/collect_s": collect_s, "time/learn_and_evaluate_s": learn_s}) + "\n")

    def save_policies(self, state, card: dict[str, Any]) -> None:  # noqa: ANN001
        """The fine-tuned policies in the form of priors: policy/seed-<k>."""
        import jax

        from sgft_jax import checkpoint
        from sgft_jax.types import Prior

        if self.args.options.horizon > 1:
            return  # a steps-to-go conditioned actor is not a plain policy; the checkpoint holds it
        for i, seed in enumerate(range(self.args.seed, self.args.seed + self.args.seeds)):
            one = jax.tree.map(lambda x, i=i: x[i], state)
            agent = one.learner
            tuned = Prior(agent.actor.params, agent.critic.params, one.value, one.dynamics.params, one.normalizer)
            facts = {**card, "finetuned": {"method": self.args.method, "real": self.args.real, "seed": seed}}
            checkpoint.save_prior(self.folder / "policy" / f"seed-{seed}", tuned, facts)

    def summarise(self, state, gap) -> dict[str, Any]:  # noqa: ANN001
        """summary.json, the learning-curve figure and the closing lines."""
        from experiments.results import describe_run, read_curve
        from sgft_jax.log import write_summary
        from sgft_jax.plot import learning_curves

        curve = read_curve(self.folder)
        summary = describe_run(curve) | {"task": self.args.task, "method": self.args.method, "gap": gap._asdict()}
        write_summary(self.folder, summary)
        figure = learning_curves(
            self._figures() / "success.png",
            {self.args.method: (curve.transitions, curve.success)},
            title=f"{self.args.task} on the {gap.name} real system",
            zero_shot=float(curve.success[:, 0].mean()),
            rollout_length=self.env.episode_length,
            control_dt=self.env.control_dt,
        )
        zero, final = summary["zero_shot"]["success"], summary["final"]["success"]
        print(
            f"success {zero['iqm']:.2f} zero-shot -> {final['iqm']:.2f} [{final['low']:.2f}, {final['high']:.2f}] after "
            f"{summary['final']['rollouts']} rollouts; deepest dip {summary['dip']['mean']:.3f}; figure {figure}"
        )
        return summary

    def _figures(self) -> Path:
        path = self.folder / "figures"
        path.mkdir(exist_ok=True)
        return path

    def show(self, state, tuner, priors, card, gap) -> None:  # noqa: ANN001
        """A video of one real episode before and after, where MuJoCo can render."""
        if not self.args.video:
            return
        from experiments.video import before_and_after

        message = before_and_after(self, state, tuner, priors[0], card)
        print(message)


def _check(args: FinetuneArgs) -> None:
    from sgft_jax.types import UserError

    for name in ("seeds", "rollouts", "initial_rollouts", "eval_every", "eval_episodes", "checkpoint_every"):
        if getattr(args, name) < 1:
            raise UserError(f"--{name.replace('_', '-')} is {getattr(args, name)}: must be at least 1")
    if args.initial_rollouts > args.rollouts:
        raise UserError(f"--initial-rollouts {args.initial_rollouts} is more than --rollouts {args.rollouts}")
    if args.utd <= 0:
        raise UserError(f"--utd is {args.utd}: must be positive")


if __name__ == "__main__":
    run_main(main, FinetuneArgs, __doc__ or "")
