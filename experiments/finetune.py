"""Fine-tune a pretrained policy on "real" systems and draw its learning curve on each."""

import functools
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env
from envs.gaps import Gap
from envs.rollout import Episode
from experiments import cli, stacking, tuned
from experiments.algorithms import make_player, network_of
from experiments.evaluation import score
from experiments.finetune_args import DEFAULT_METHOD, VOLATILE, FinetuneArgs, arguments, check, check_prior, run_folder
from experiments.finetune_record import Record
from experiments.finetuning import Program, Reals, Simulation, make_program, simulate
from experiments.options import prior_folders
from experiments.worlds import real_env, real_worlds
from sgft_jax import mesh
from sgft_jax.data.replay import ReplayState
from sgft_jax.finetune import make_finetuner
from sgft_jax.finetune_mpc import plan_options
from sgft_jax.io import checkpoint, runs
from sgft_jax.io.config import config_to_json
from sgft_jax.io.progress import RunProgress
from sgft_jax.io.priors import load_priors
from sgft_jax.methods import METHODS, FinetuneConfig, Method, dynamics_warmup, lr_warmup, policy_delay
from sgft_jax.types import Array, Finetuner, Key, PyTree, UserError

_SIMULATED_WORLDS = 256
_SIMULATION = 2**31  # seed of what happens in them, the same for every run
_OFFLINE_PART = 10_000  # updates between two checkpoints, which are signs of life, too


def main(argv: Sequence[str] | None = None) -> None:
    """The command line. The method is looked up first, because it gives the other options their defaults."""
    argv = list(sys.argv[1:] if argv is None else argv)
    cli.run_main(finetune, FinetuneArgs, f"{__doc__}\n\n{_table()}", argv=argv, default=_defaults)


def _defaults(argv: Sequence[str]) -> FinetuneArgs:
    """Those of the chosen method, with the options that tuning chose for the task if `--tuned` asks for them."""
    chosen = cli.preview(argv, method=DEFAULT_METHOD, tuned=False, task=FinetuneArgs.task, out=FinetuneArgs.out)
    default = arguments(chosen.method)
    return tuned.apply(replace(default, task=chosen.task, out=chosen.out)) if chosen.tuned else default


def _table() -> str:
    """The methods in two lines each."""
    width = max(map(len, METHODS))

    def row(m: Method) -> str:
        transforms = f"batches: {', '.join(m.parts)}; " if m.parts else ""
        return f"  {m.name:{width}}  {m.description} ({m.source})\n  {'':{width}}  {transforms}prior: {m.needs}"

    title = "methods, what they do to their batches, and what of the prior they need:"
    return "\n".join([title, *map(row, METHODS.values())])


def finetune(args: FinetuneArgs) -> list[dict[str, Any]]:
    """Fine-tuning runs from (or back) to disk, one per real system; returns their summaries in the order of `real`."""
    method, seeds = check(args)
    priors_in = prior_folders(args.prior, out=args.out, task=args.task, preset=args.preset)
    members = "--seeds" if len(args.real) == 1 else "the number of --real times --seeds"
    devices = mesh.devices(args.devices, {members: len(args.real) * args.seeds})
    env = envs.make(args.task, args.impl)
    found = [gaps.load(env, real, args.set) for real in args.real]
    system = real_env(env, found)
    priors, card = load_priors(priors_in, env)
    check_prior(args, method, card)
    # Every folder is that of a run on its real system alone: either kind of run continues the other.
    folders = {run_folder(args, real): config_to_json(args) | {"real": real} for real in args.real}
    opened = runs.open_runs(
        folders, kind="finetune", resume=args.resume, overwrite=args.overwrite, volatile=VOLATILE,
        inputs={"priors": [checkpoint.digest(prior) for prior in priors]},
    )  # fmt: skip
    try:
        with mesh.use(devices):
            records = [
                Record(run.folder, system, gap, method.name, seeds) for run, gap in zip(opened, found, strict=True)
            ]
            return _Run(args, env, system, found, method, seeds).work(records, stacking.stack(priors), card)
    finally:
        for run in opened:
            run.close()


class _Run:
    """The impure part: what happens between compiled calls, on disk before in memory.

    The real systems are stepped together, because physics takes as long as its longest chain of steps and hardly longer
    for more worlds. Members [M = G * S] are the seeds of the first real system, then those of the next.
    """

    def __init__(
        self, args: FinetuneArgs, env: Env, real: Env, found: list[Gap], method: Method, seeds: list[int]
    ) -> None:
        self.args, self.env, self.real, self.found, self.method, self.seeds = args, env, real, found, method, seeds
        which = jnp.repeat(jnp.arange(len(found)), len(seeds))
        self.reals = Reals(real_worlds(real, found, jax.random.key(0)), which)
        self.numbers = jnp.tile(jnp.array(seeds, jnp.uint32), len(found))

    def work(self, records: list[Record], priors: PyTree, card: dict[str, Any]) -> list[dict[str, Any]]:
        """Everything, in order; returns the summaries. priors: [P]; seed i starts from prior i modulo P."""
        self.records, done = records, _common_rollouts(records)
        config = self._options(card)
        self.simulation = self._simulate(config, priors, card) if config.needs_simulation else None
        if self.method.agent == "iql" and config.reward_scale is None:
            config = replace(config, reward_scale=self._reward_scale())
        self.tuner, self.program = self._programs(self.method, config)
        self.pilot = self._programs(self.method.pilot, config)[1] if self.method.fresh else self.program

        own = jax.jit(lambda priors: jax.tree.map(lambda x: x[self._prior_of(priors)], priors))(priors)
        self.untuned = lambda: self.pilot.init(own, self.numbers)
        state = self._start(lambda: self.program.init(own, self.numbers), done, config.offline_updates)
        return self._finish(self._train(state, done), self._card(card, config))

    def _options(self, card: dict[str, Any]) -> FinetuneConfig:
        """Those of the command line, with what must be as the prior has it and what follows from `--utd`."""
        options = self.args.options
        rules = {"policy_delay": policy_delay, "lr_warmup": lr_warmup, "dynamics_warmup": dynamics_warmup}
        own = {"gamma": card["gamma"], **{name: rule(options, self.args.utd) for name, rule in rules.items()}}
        if options.critic_warmup is None:
            own["critic_warmup"] = self.args.initial_rollouts * self._updates_per_rollout()
        if checkpoint.algorithm_of(card) == "tdmpc2":
            return replace(options, size=card["config"]["size"], **own)
        return replace(options, network=network_of(card), **own)

    def _card(self, card: dict[str, Any], config: FinetuneConfig) -> dict[str, Any]:
        """What a reader of the fine-tuned policies needs: the prior's card, and how they plan, if they do."""
        own = {name: value for name, value in card.items() if name != "plan"}
        return own | ({"plan": plan_options(config)} if self.method.agent == "mpc" else {})

    def _programs(self, method: Method, config: FinetuneConfig) -> tuple[Finetuner, Program]:
        env = self.env
        sizes = {"obs_dim": env.obs_dim, "act_dim": env.act_dim}
        tuner = make_finetuner(method, config, **sizes, reward=env.reward, terminated=env.terminated)
        return tuner, make_program(self.real, tuner, gamma=config.gamma)

    def _prior_of(self, priors: PyTree) -> Array:
        """[M] for every member an index into priors [P]."""
        return self.numbers % jax.tree.leaves(priors)[0].shape[0]

    def _simulate(self, config: FinetuneConfig, priors: PyTree, card: dict[str, Any]) -> Simulation:
        """What every simulator's policy does in its training domain; the same for all methods and after a resume."""
        worlds = self.env.sample_worlds(jax.random.key(_SIMULATION), _SIMULATED_WORLDS)
        player = make_player(card, self.env)
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

    def _start(self, make: Callable[[], PyTree], done: int, offline_updates: int) -> PyTree:
        """The state after so many rollouts: of checkpoints, or a fresh one, which learns offline and is scored."""
        if done == 0:
            for record in self.records:
                record.clear()
            state = self._offline(make, offline_updates)
            self._evaluate(state, 0)
            return state
        return _join([record.restore(self._like(make), done) for record in self.records])

    def _like(self, make: Callable[[], PyTree]) -> PyTree:
        """Shapes of the state [S] of one real system."""
        return jax.eval_shape(lambda: stacking.part(make(), 0, len(self.seeds)))

    def _each(self, members: PyTree) -> Iterator[tuple[Record, PyTree]]:
        """Every real system's record and, [S], what belongs to it in a pytree over all members."""
        return ((record, stacking.part(members, i, len(self.seeds))) for i, record in enumerate(self.records))

    def _each_state(self, state: PyTree) -> Iterator[tuple[Record, PyTree]]:
        """The same for a state, of whose many arrays one program cuts out one real system's at a time."""
        for i, record in enumerate(self.records):
            yield record, state if len(self.records) == 1 else _part(state, i, len(self.seeds))

    def _offline(self, make: Callable[[], PyTree], updates: int) -> PyTree:
        """A fresh state that has learned from the simulator's transitions alone; goes on where an earlier start was."""
        if not updates:
            return make()
        n = min(updates, _OFFLINE_PART)
        # No real system has had a part in the states yet: that of the one that got furthest is that of all.
        first = max(self.records, key=Record.offline)
        done = first.offline()
        state = _join([first.restore_offline(self._like(make), done)] * len(self.records)) if done else make()
        with RunProgress(f"{self.args.method} offline", total=updates // n * n, unit="updates", done=done) as progress:
            for part in range(done // n, updates // n):
                state, metrics = self.program.offline(state, self.numbers, part, n, self.simulation)
                # Equal copies: one would do for all, but any of the folders may be resumed alone, moved or removed, and
                # half a million updates must not go with another's. They last until the first checkpoint of the run.
                for record, own in self._each_state(state):
                    record.checkpoint_offline(own, (part + 1) * n)
                progress.advance(n, {"critic loss": float(metrics["critic/loss"].mean())})
        return state

    def _train(self, state: PyTree, done: int) -> PyTree:
        title = f"{self.args.method} on {self.args.task}/{'+'.join(gap.name for gap in self.found)}"
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
        self._store(episodes)
        collected = time.perf_counter()
        state, metrics = self._learn(self.program.store(state, episodes), done, n)
        real = {
            "real/return": np.asarray(episodes.total_reward).mean(1),
            "real/success": np.asarray(episodes.success).mean(1),
            "real/exploded": np.asarray(episodes.exploded).mean(1),
        }
        done += n
        for record, own in self._each(real | metrics):
            record.metrics(done, own)
        learned = time.perf_counter()
        shown = {"real success": float(real["real/success"].mean())}
        last = done >= args.rollouts
        if first or last or done % args.eval_every == 0:
            shown["success"] = self._evaluate(state, done)
        if first or last or done % args.checkpoint_every == 0:
            self._checkpoint(state, done)
        for record in self.records:
            record.time(done, collected - started, learned - collected)
        return state, shown

    def _collect(self, state: PyTree, done: int, n: int) -> Episode:
        """The initial rollouts are the simulator's policy's, the same for all methods that do not plan."""
        program, state = (self.program, state) if done else (self.pilot, self.untuned())
        return program.collect(state, self.reals, self.numbers, done, n)

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

    def _store(self, episodes: Episode) -> None:
        """Real transitions reach the disk before a learner sees them."""
        arrays = {**episodes.transitions._asdict(), "valid": episodes.valid, "qpos": episodes.qpos}
        for record, own in self._each({name: np.asarray(x) for name, x in arrays.items()}):
            record.store(own)

    def _evaluate(self, state: PyTree, done: int) -> float:
        scores = jax.vmap(score)(self.program.evaluate(state, self.reals, self.numbers, self.args.eval_episodes))
        for record, own in self._each(scores):
            record.evaluation(done, own)
        return float(scores["success"].mean())

    def _checkpoint(self, state: PyTree, done: int) -> None:
        for record, own in self._each_state(state):
            record.checkpoint(own, done)

    # ------------------------------------------------------------ what stays

    def _finish(self, state: PyTree, card: dict[str, Any]) -> list[dict[str, Any]]:
        """Policies, summaries, figures and films."""
        export = jax.jit(lambda state, i: self.tuner.export(stacking.member(state, i)))
        summaries, play = [], functools.cache(lambda: self._before_and_after(state))
        for i, (record, own) in enumerate(self._each_state(state)):
            record.save_policies(export, own, card)
            summary = record.summarise()
            summaries.append(summary)
            if self.args.video:
                mine = lambda i=i: [stacking.part(played, i, len(self.seeds)) for played in play()]  # noqa: E731
                print(record.film(stacking.member(self.reals.pools, i), mine, summary["final"]["rollouts"]))
            print(f"results: {record.folder}  (policy/, real/, summary.json, figures/)")
        print("next: python -m experiments.figures")
        return summaries

    def _before_and_after(self, tuned: PyTree) -> list[Episode]:
        """The evaluation episodes [M, n] of the simulator's policy and of the agent as it is now."""
        players, n = ((self.pilot, self.untuned()), (self.program, tuned)), self.args.eval_episodes
        return [program.evaluate(state, self.reals, self.numbers, n) for program, state in players]


_part = jax.jit(stacking.part, static_argnums=2)


@jax.jit
def _join(states: list[PyTree]) -> PyTree:
    """The states of all members from those of each real system."""
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *states)


def _common_rollouts(records: list[Record]) -> int:
    """How many rollouts all real systems have behind them; raises UserError if they differ."""
    done = [record.rollouts() for record in records]
    if len(set(done)) > 1:
        listed = ", ".join(f"{record.folder} is at rollout {n}" for record, n in zip(records, done, strict=True))
        raise UserError(f"{listed}: they cannot go on together, resume them one at a time")
    return done[0]


if __name__ == "__main__":
    main()
