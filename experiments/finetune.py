"""Fine-tune a pretrained policy on a "real" system and draw its learning curve."""

import json
import re
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env
from envs.gaps import Gap
from envs.physics import Impl
from envs.rollout import Episode
from experiments import cli, common
from experiments.algorithms import make_player, network_of
from experiments.evaluation import score
from experiments.finetuning import Program, Simulation, make_program, simulate
from experiments.presets import PRESETS
from experiments.results import describe_run, read_curve
from experiments.video import before_and_after
from sgft_jax import checkpoint, mesh, plot, runs
from sgft_jax.finetune import make_finetuner
from sgft_jax.log import MetricsLog, RealLog, RunProgress, write_summary
from sgft_jax.methods import METHODS, FinetuneConfig, Method, finetune_config, get_method
from sgft_jax.players import Player
from sgft_jax.replay import ReplayState
from sgft_jax.stats import iqm_interval
from sgft_jax.types import Array, Finetuner, Key, PyTree, UserError

DEFAULT_METHOD, DEFAULT_PRESET = "sgft-sac", "fast"
_SIMULATED_WORLDS = 256
_SIMULATION = 2**31  # seed of what happens in them, the same for every run
_OFFLINE_PART = 10_000  # updates between two signs of life


@dataclass(frozen=True)
class FinetuneArgs:
    """Fine-tuning of several seeds at once, all in one compiled program."""

    task: str = "push"
    """push, hammer or insert."""
    method: str = DEFAULT_METHOD
    """How it learns; the table is at the top. The defaults below are those of the method that is chosen."""
    real: str = "default"
    """The real system: mild, default, hard, or a .toml/.json file with tables `params` and `effects`."""
    set: tuple[str, ...] = ()
    """Changes to it, e.g. --set latency=0.05 action_scale=[1,0.5]."""
    preset: str = DEFAULT_PRESET
    """Pretraining preset whose priors to start from."""
    prior: Path | None = None
    """Folder of a prior, or of several (prior/seed-*); default: those of <out>/pretrain/<task>/<preset>."""
    seed: int = 0
    """First seed."""
    seeds: int = 10
    """Number of seeds; seed i starts from prior i modulo the number of priors."""
    rollouts: int = 100
    """Real rollouts per seed, the initial ones included; may grow with --resume."""
    initial_rollouts: int = 5
    """Rollouts of the simulator's policy that fill the buffer before learning starts. The paper has 20; after 5
    SGFT-SAC needs less than half of the transitions to get to 90 % (docs/results.md)."""
    utd: float = 8.0
    """Updates per real transition."""
    eval_every: int = 5
    """Rollouts between evaluations."""
    eval_episodes: int = 50
    """Episodes per seed and evaluation, always the same ones; they cost no real transitions."""
    checkpoint_every: int = 10
    """Rollouts between checkpoints."""
    options: FinetuneConfig = field(default_factory=FinetuneConfig)
    """Method options; `network`, `size` and `gamma` always are the prior's."""
    variant: str = ""
    """A word for these options: the run gets a folder of its own beside the method's, and a curve in the figures."""
    impl: Impl = "auto"
    """Who steps the physics: MJX's own code, MuJoCo Warp, or MuJoCo's C engine. auto: $SGFT_IMPL, or else c on a CPU,
    warp on an NVIDIA GPU where it is installed, jax elsewhere."""
    devices: int | None = None
    """Devices that share the seeds; 0: all there are; default: one."""
    video: bool = True
    """Render an episode before and after fine-tuning side by side, where MuJoCo can render."""
    out: Path = Path("runs")
    """Parent of all run folders."""
    resume: bool = False
    """Continue from the last checkpoint."""
    overwrite: bool = False
    """Replace an earlier run of the same name."""


def main(argv: Sequence[str] | None = None) -> None:
    """The command line. The method is looked up first, because it gives the other options their defaults."""
    argv = list(sys.argv[1:] if argv is None else argv)
    name = common.option(argv, "--method", DEFAULT_METHOD)
    default = arguments(name) if name in METHODS else FinetuneArgs(method=name)
    cli.run_main(finetune, FinetuneArgs, f"{__doc__}\n\n{_table()}", argv=argv, default=default)


def arguments(method: str, **changes: Any) -> FinetuneArgs:
    """The arguments with which a method runs unless told otherwise, and any changes to these."""
    chosen = get_method(method)
    own = {"method": method, "utd": chosen.utd, "options": finetune_config(chosen), "preset": _preset(chosen)}
    return FinetuneArgs(**{**own, **changes})


def _preset(method: Method) -> str:
    """The preset that makes the priors a method needs."""
    return "tdmpc2" if method.prior == "tdmpc2" else DEFAULT_PRESET


def _table() -> str:
    """The methods in a line each."""
    width = max(map(len, METHODS))
    return "methods:\n" + "\n".join(f"  {m.name:{width}}  {m.description} ({m.source})" for m in METHODS.values())


def finetune(args: FinetuneArgs) -> dict[str, Any]:
    """One fine-tuning run from (or back) to disk; returns its summary."""
    method, seeds = _check(args)
    devices = mesh.devices(args.devices, {"--seeds": args.seeds})
    env = envs.make(args.task, args.impl)
    gap = gaps.load(env, args.real, args.set)
    priors, card = common.find_priors(args.prior, out=args.out, env=env, preset=args.preset)
    _check_prior(args, method, card)
    run = runs.open_run(
        run_folder(args),
        kind="finetune",
        config=args,
        resume=args.resume,
        overwrite=args.overwrite,
        volatile=("resume", "overwrite", "rollouts", "devices", "video", "out"),
    )
    try:
        with mesh.use(devices):
            return _Run(args, env, gap, method, seeds, run.folder).work(common.stack(priors), card)
    finally:
        run.close()


def run_folder(args: FinetuneArgs) -> Path:
    """Where the run of these arguments lives; the seeds of one call share a folder."""
    real = "_".join([Path(args.real).stem, *(change.replace("/", "") for change in args.set)])
    seeds = common.seeds_name(common.seed_list(args.seed, args.seeds))
    method = "_".join(filter(None, [args.method, args.variant]))
    return args.out / "finetune" / args.task / real / method / seeds


class _Run:
    """The impure part: what happens between compiled calls, on disk before in memory."""

    def __init__(self, args: FinetuneArgs, env: Env, gap: Gap, method: Method, seeds: list[int], folder: Path) -> None:
        self.args, self.env, self.gap, self.method, self.seeds, self.folder = args, env, gap, method, seeds, folder
        self.pool = gaps.worlds(env, gap, jax.random.key(0))
        self.numbers = jnp.array(seeds, jnp.uint32)
        self.log, self.real = MetricsLog(folder), RealLog(folder)
        self.expect = {"kind": "finetune", "task": args.task, "method": args.method, "seeds": seeds}

    def work(self, priors: PyTree, card: dict[str, Any]) -> dict[str, Any]:
        """Everything, in order. priors: [P]; seed i starts from prior i modulo P."""
        args = self.args
        config = self._options(card)
        if config.critic_warmup is None:
            config = replace(config, critic_warmup=args.initial_rollouts * self._updates_per_rollout())
        self.simulation = self._simulate(config, priors, make_player(card)) if config.simulated_share else None
        if self.method.agent == "iql" and config.reward_scale is None:
            config = replace(config, reward_scale=self._reward_scale())
        self.tuner, self.program = self._programs(self.method, config)
        self.pilot = self._programs(self.method.pilot, config)[1] if self.method.fresh else self.program

        own = jax.tree.map(lambda x: x[self._prior_of(priors)], priors)
        self.untuned = lambda: self.pilot.init(own, self.numbers)
        state, done = self._start(lambda: self.program.init(own, self.numbers), config)
        state = self._train(state, done)
        self.log.close()
        self._save_policies(state, card)
        summary = self._summarise()
        if args.video:
            print(self._film(state, summary["final"]["rollouts"]))
        print(f"results: {self.folder}  (policy/, real/, summary.json, figures/)")
        print("next: python -m experiments.figures")
        return summary

    def _options(self, card: dict[str, Any]) -> FinetuneConfig:
        """Those of the command line, with what must be as the prior has it."""
        own = {"gamma": card["gamma"]}
        if checkpoint.algorithm_of(card) == "tdmpc2":
            return replace(self.args.options, size=card["config"]["size"], **own)
        return replace(self.args.options, network=network_of(card), **own)

    def _programs(self, method: Method, config: FinetuneConfig) -> tuple[Finetuner, Program]:
        env = self.env
        sizes = {"obs_dim": env.obs_dim, "act_dim": env.act_dim}
        tuner = make_finetuner(method, config, **sizes, reward=env.reward, terminated=env.terminated)
        return tuner, make_program(env, tuner, gamma=config.gamma)

    def _prior_of(self, priors: PyTree) -> Array:
        """[S] for every seed an index into priors [P]."""
        return self.numbers % jax.tree.leaves(priors)[0].shape[0]

    def _simulate(self, config: FinetuneConfig, priors: PyTree, player: Player) -> Simulation:
        """What every simulator's policy does in its training domain; the same for all methods and after a resume."""
        worlds = self.env.sample_worlds(jax.random.key(_SIMULATION), _SIMULATED_WORLDS)
        sizes = {"transitions": config.simulated_transitions, "ladder": config.simulated_ladder, "gamma": config.gamma}

        def one(prior: PyTree, key: Key) -> tuple[ReplayState, Array]:
            return simulate(self.env, player, worlds, prior, key, **sizes)

        keys = jax.random.split(jax.random.key(_SIMULATION), jax.tree.leaves(priors)[0].shape[0])
        buffers, returns = jax.jit(jax.vmap(one))(priors, keys)
        print(f"simulated: {returns.size} episodes, returns from {returns.min():.1f} to {returns.max():.1f}")
        return Simulation(buffers, self._prior_of(priors), returns)

    def _reward_scale(self) -> float:
        """IQL's authors scale rewards so that the returns of the data span the length of an episode."""
        assert self.simulation is not None
        returns = self.simulation.returns
        return self.env.episode_length / max(float(returns.max() - returns.min()), 1e-6)

    def _start(self, make: Callable[[], PyTree], config: FinetuneConfig) -> tuple[PyTree, int]:
        """The state to continue from and the rollouts behind it: a checkpoint's, or a fresh one scored zero-shot."""
        if checkpoint.latest(self.folder) is None:
            self.log.truncate({})
            self.real.truncate(0)
            state = self._offline(make(), config.offline_updates)
            self._evaluate(state, 0)
            return state, 0
        state, meta = checkpoint.restore(self.folder, jax.eval_shape(make), expect=self.expect)
        self.log.truncate(meta["position"])
        self.real.truncate(meta["stored"])
        return state, meta["rollouts"]

    def _offline(self, state: PyTree, updates: int) -> PyTree:
        """Learning from the simulator's transitions alone."""
        if not updates:
            return state
        n = min(updates, _OFFLINE_PART)
        with RunProgress(f"{self.args.method} offline", total=updates // n * n, unit="updates") as progress:
            for part in range(updates // n):
                state, metrics = self.program.offline(state, self.numbers, part, n, self.simulation)
                progress.advance(n, {"critic loss": float(metrics["critic/loss"].mean())})
        return state

    def _train(self, state: PyTree, done: int) -> PyTree:
        title = f"{self.args.method} on {self.args.task}/{self.gap.name}"
        with RunProgress(title, total=self.args.rollouts, unit="rollouts", done=done) as progress:
            while done < self.args.rollouts:
                n = self.args.initial_rollouts if done == 0 else 1
                state, shown = self._advance(state, done, n)
                done += n
                progress.advance(n, shown)
        return state

    def _advance(self, state: PyTree, done: int, n: int) -> tuple[PyTree, dict[str, float]]:
        """N real rollouts, then learning from them; later, where one is due, an evaluation and a checkpoint."""
        args, first = self.args, done == 0
        started = time.perf_counter()
        episodes = self._collect(state, done, n)
        self._store(episodes, n)
        collected = time.perf_counter()
        state, metrics = self._learn(self.program.store(state, episodes), done, n)
        real = {
            "real/return": np.asarray(episodes.total_reward).mean(1),
            "real/success": np.asarray(episodes.success).mean(1),
            "real/exploded": np.asarray(episodes.exploded).mean(1),
        }
        done += n
        self.log.metrics(self._transitions(done), {"rollouts": done, **real, **metrics})
        learned = time.perf_counter()
        shown = {"real success": float(real["real/success"].mean())}
        last = done >= args.rollouts
        if first or last or done % args.eval_every == 0:
            shown["success"] = self._evaluate(state, done)
        if first or last or done % args.checkpoint_every == 0:
            self._checkpoint(state, done)
        self._time(done, collected - started, learned - collected)
        return state, shown

    def _collect(self, state: PyTree, done: int, n: int) -> Episode:
        """The initial rollouts are the simulator's policy's, whatever the method: the same for all."""
        program, state = (self.program, state) if done else (self.pilot, self.untuned())
        return program.collect(state, self.pool, self.numbers, done, n)

    def _learn(self, state: PyTree, done: int, n: int) -> tuple[PyTree, dict[str, np.ndarray]]:
        """The updates that N rollouts allow, in N equal parts, so that one compiled program serves any number."""
        parts = []
        for rollout in range(done, done + n):
            state, metrics = self.program.learn(
                state, self.numbers, rollout, self._updates_per_rollout(), self.simulation
            )
            parts.append(metrics)
        return state, {name: np.mean([part[name] for part in parts], axis=0) for name in parts[0]}

    def _updates_per_rollout(self) -> int:
        return max(round(self.args.utd * self._transitions(1)), 1)

    def _transitions(self, rollouts: int) -> int:
        return rollouts * self.env.episode_length

    def _store(self, episodes: Episode, n: int) -> None:
        """Real transitions reach the disk before a learner sees them: one file a rollout, arrays [seeds, T, ...]."""
        arrays = {**episodes.transitions._asdict(), "valid": episodes.valid, "qpos": episodes.qpos}
        arrays = {name: np.asarray(x) for name, x in arrays.items()}
        for i in range(n):
            self.real.append({name: x[:, i] for name, x in arrays.items()})

    def _evaluate(self, state: PyTree, done: int) -> float:
        scores = jax.vmap(score)(self.program.evaluate(state, self.pool, self.numbers, self.args.eval_episodes))
        minutes = self._transitions(done) * self.env.control_dt / 60
        self.log.eval(self._transitions(done), {"rollouts": done, "robot_minutes": minutes, **scores})
        return float(scores["success"].mean())

    def _checkpoint(self, state: PyTree, done: int) -> None:
        meta = {**self.expect, "rollouts": done, "stored": len(self.real), "position": self.log.position()}
        checkpoint.save(self.folder, done, state, meta=meta)

    def _time(self, done: int, collect_s: float, learn_s: float) -> None:
        """Apart from the metrics, which must not depend on the clock."""
        line = {"rollouts": done, "time/collect_s": round(collect_s, 3), "time/learn_s": round(learn_s, 3)}
        with open(self.folder / "timing.jsonl", "a") as file:
            file.write(json.dumps(line) + "\n")

    # ------------------------------------------------------------ what stays

    def _save_policies(self, state: PyTree, card: dict[str, Any]) -> None:
        """The fine-tuned policies in the form of priors: policy/seed-<k>."""
        for i, seed in enumerate(self.seeds):
            tuned = self.tuner.export(common.member(state, i))
            facts = {"method": self.args.method, "gap": self.gap._asdict(), "seed": seed}
            checkpoint.save_prior(self.folder / "policy" / f"seed-{seed}", tuned, {**card, "finetuned": facts})

    def _summarise(self) -> dict[str, Any]:
        """summary.json, the learning curve and the closing words."""
        args, curve = self.args, read_curve(self.folder)
        about = {"task": args.task, "method": args.method, "impl": self.env.impl, "gap": self.gap._asdict()}
        summary = about | describe_run(curve)
        write_summary(self.folder, summary)
        plot.learning_curves(
            self.folder / "figures" / "success.png",
            {args.method: (curve.transitions, curve.success)},
            title=f"{args.task} on the {self.gap.name} real system",
            zero_shot=float(iqm_interval(curve.success[:, 0]).estimate),
            rollout_length=self.env.episode_length,
            control_dt=self.env.control_dt,
        )
        zero, final = (summary[when]["success"] for when in ("zero_shot", "final"))
        band = f" [{final['low']:.2f}, {final['high']:.2f}]" if len(self.seeds) > 1 else ""
        print(
            f"success {zero['iqm']:.2f} zero-shot -> {final['iqm']:.2f}{band} after {summary['final']['rollouts']} "
            f"rollouts; deepest dip {summary['dip']['mean']:.3f}"
        )
        return summary

    def _film(self, tuned: PyTree, rollouts: int) -> str:
        """An evaluation episode of the first seed by the simulator's policy and by the agent as it is now.

        The first one that only the tuned agent solves: what fine-tuning is about. Without one, the first.
        """

        def play() -> list[Episode]:
            n = self.args.eval_episodes
            players = ((self.pilot, self.untuned()), (self.program, tuned))
            both = [program.evaluate(state, self.pool, self.numbers, n) for program, state in players]
            old, new = (np.asarray(episodes.success[0]) for episodes in both)
            chosen = int(np.argmax(new & ~old))
            return [jax.tree.map(lambda x: np.asarray(x[0, chosen]), episodes) for episodes in both]

        path = self.folder / "videos" / f"seed-{self.seeds[0]}.mp4"
        return before_and_after(self.env, self.pool, play, path, rollouts=rollouts)


def _check_prior(args: FinetuneArgs, method: Method, card: dict[str, Any]) -> None:
    """Raises UserError for a prior of another algorithm than the method needs."""
    if checkpoint.algorithm_of(card) != method.prior:
        raise UserError(
            f"--method {method.name} needs a prior of {method.prior}, not of {checkpoint.algorithm_of(card)}; "
            f"make one with: python -m experiments.pretrain --task {args.task} --preset {_preset(method)}"
        )


def _check(args: FinetuneArgs) -> tuple[Method, list[int]]:
    """The method and the seeds; raises UserError for what is wrong in the arguments alone."""
    cli.choose("--task", args.task, envs.TASKS)
    cli.choose("--preset", args.preset, PRESETS)
    for name in ("rollouts", "initial_rollouts", "eval_every", "eval_episodes", "checkpoint_every"):
        if getattr(args, name) < 1:
            raise UserError(f"--{name.replace('_', '-')} is {getattr(args, name)}: must be at least 1")
    if args.initial_rollouts > args.rollouts:
        raise UserError(f"--initial-rollouts {args.initial_rollouts} is more than --rollouts {args.rollouts}")
    if not re.fullmatch(r"[\w.-]*", args.variant):
        raise UserError(f"--variant {args.variant!r}: letters, digits, '.', '_' and '-' only, it names a folder")
    if args.utd <= 0:
        raise UserError(f"--utd is {args.utd}: must be positive")
    return get_method(args.method), common.seed_list(args.seed, args.seeds)


if __name__ == "__main__":
    main()
