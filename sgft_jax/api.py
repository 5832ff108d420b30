"""The short way in from Python: from a task, a gap and priors to what `finetune` takes, and policies that act.

The only module of this package that builds tasks; the others take an `Env` or less.
"""

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

import envs
from envs.base import Env
from envs.gaps import Gap, drifts, from_dict
from envs.observations import remember, with_memory
from envs.rollout import Episode, heldout_worlds, real_env, real_worlds, training_worlds
from envs.types import Array, Policy, PyTree, UserError
from sgft_jax.algorithms import make_policy
from sgft_jax.export import player
from sgft_jax.io.cards import known_task
from sgft_jax.io.priors import load_prior, variant
from sgft_jax.methods import DEFAULT, get_method
from sgft_jax.posterior.estimator import without_estimator
from sgft_jax.presets import check_card
from sgft_jax.stacking import member, stack
from sgft_jax.systems.simulated import Simulated, System
from sgft_jax.train.finetuning import FinetuneProgress
from sgft_jax.train.options import card_of
from sgft_jax.train.simulation import SimulatedRows, simulate
from sgft_jax.types import Finetuner, Online, Prior, Simulation

__all__ = ["ActingPolicy", "Setup", "evaluate_prior", "finetuned_priors", "load_policy", "make_env", "setup"]

SIMULATED_WORLDS = 256
_PARTS = ("params", "effects", "scene", "commands")  # of the gap that a card names
_SIMULATION = 2**31  # seed of what happens in them, the same for every run
_EVALUATION = 2**31 + 2  # held out from training and from the choice of the prior


class Setup(NamedTuple):
    """What `finetune(*setup, rollouts=...)` takes, for M members.

    With gaps M = gaps * seeds: the seeds of the first gap, then those of the next. With a `System` M = seeds.
    finetuner: the method. system: plays episodes. priors: params [P, ...], None without any. seeds: [M] uint32.
    simulated() -> transitions of the simulator, collected when they are first needed; None for a method that uses none.
    """

    finetuner: Finetuner
    system: System
    priors: PyTree
    seeds: Array
    simulated: Callable[[], SimulatedRows] | None


def setup(
    env: Env,
    real: Gap | Sequence[Gap] | System,
    priors: Prior | Sequence[Prior],
    *,
    method: str = DEFAULT,
    seeds: int | Sequence[int] = 1,
    config: Any = None,
    rows: Callable[[Simulation, Callable[..., SimulatedRows]], SimulatedRows] = lambda needs, collect: collect(),
    **options: Any,
) -> Setup:
    """Fine-tuning of seeds on real systems, ready to run.

    real: gaps, which are simulated, or one `System`, such as `Gymnasium`, with a member for each seed.
    priors: one or P of them, or [] to learn from nothing where the method can; seed s starts from prior s modulo P.
    method: a name, or a Python file. seeds: how many, or a list of them. options: of the method, by name; config: all
    of them as one object instead. rows(needs, collect) -> what `collect()` returns, perhaps kept from an earlier run;
    collect(heard) tells how far it is, see `simulate`.
    Raises UserError for a prior of another algorithm or task, for a missing prior, and for options that do not fit.
    """
    known = [priors] if isinstance(priors, Prior) else list(priors)
    chosen = get_method(method)
    for prior in known:
        check_prior(prior, chosen, env)
    if not known and chosen.needs_prior:
        raise UserError(f"method {chosen.name} needs a prior of {chosen.prior}")
    finetuner = chosen.build(chosen.config(**options) if config is None else config, known[0] if known else None, env)
    numbers = range(seeds) if isinstance(seeds, int) else seeds
    if isinstance(real, System):
        system, copies = real, 1
    else:
        gaps = [real] if isinstance(real, Gap) else list(real)
        gamma, copies, scene = card_of(known[0] if known else None)["gamma"], len(gaps), real_env(env, gaps)
        which = jnp.repeat(jnp.arange(copies), len(numbers))
        pools, drift = real_worlds(scene, gaps, jax.random.key(0)), drifts(scene, gaps)
        system = Simulated(scene, pools, which, gamma=gamma, drift=drift)
    params = [prior.params if finetuner.estimates else without_estimator(prior.params) for prior in known]
    stacked = stack(params) if known else None
    members = jnp.tile(jnp.array(list(numbers), jnp.uint32), copies)
    needs = finetuner.simulation
    if needs is None:
        return Setup(finetuner, system, stacked, members, None)
    simulated = functools.cache(lambda: rows(needs, functools.partial(_collected, env, needs, known, stacked)))
    return Setup(finetuner, system, stacked, members, simulated)


def _collected(
    env: Env,
    needs: Simulation,
    priors: list[Prior],
    stacked: PyTree,
    heard: Callable[[float], None] = lambda share: None,
) -> SimulatedRows:
    """What every prior's policy does where it was trained; always the same.

    That is the task's own domain, or the system of the gap that the first card names.
    """
    key, card, gap = jax.random.key(_SIMULATION), priors[0].card, None
    if (named := card.get("gap")) is not None:
        gap = from_dict(env, named["name"], {part: named[part] for part in _PARTS if part in named})
        env = real_env(env, [gap])
    worlds = training_worlds(env, gap, key, SIMULATED_WORLDS)
    return simulate(env, make_policy(card, env), worlds, stacked, key, needs, gamma=card["gamma"], heard=heard)


def check_prior(prior: Prior, method: Online, env: Env) -> None:
    """Raises UserError for a prior of another algorithm or task, or of a policy that is told more or less."""
    check_card(prior.card, method, env.name)
    if prior.card["obs_dim"] != env.obs_dim:
        sizes = f"{prior.card['obs_dim']} numbers, the task as it was made {env.obs_dim}"
        raise UserError(f"the policy of the prior observes {sizes}; make it with sgft_jax.make_env(prior)")


def make_env(prior: Prior, *, task: str | None = None) -> Env:
    """The task of a prior, with the observations that its policy reads: perhaps also its last actions.

    task: where the file of a task of your own is; otherwise the prior's card names its task.
    """
    named = task or known_task("the prior's card", prior.card["task"], "task=")
    return envs.make(named, **variant(prior.card))


def evaluate_prior(
    prior: Prior, env: Env, real: Gap | System | None = None, *, episodes: int = 200, seed: int = 0
) -> Episode:
    """Episodes [episodes] of a prior's policy without exploration.

    real: a gap or a `System` of one member; None = the training domain without sensor noise. Another seed draws other
    worlds and starts.
    """
    key_worlds, key_episodes = jax.random.split(jax.random.fold_in(jax.random.key(_EVALUATION), seed))
    system = real
    if not isinstance(system, System):
        scene = real_env(env, [] if system is None else [system])
        pool = stack([heldout_worlds(scene, system, key_worlds, episodes)])
        system = Simulated(scene, pool, jnp.zeros(1, int), gamma=prior.card["gamma"])
    keys = jax.random.split(key_episodes, (1, episodes))
    return member(system.play(make_policy(prior.card, env), stack([prior.params]), keys, explore=False), 0)


def finetuned_priors(setup: Setup, state: FinetuneProgress, prior: Prior, *, best: bool = True) -> list[Prior]:
    """What fine-tuning leaves, a prior [M] for each member: to save with `save_prior`, to act with `ActingPolicy`.

    state: what `finetune` has yielded. prior: one that it began with, for what its card says. best: the policies that
    did best in the real rollouts; False: the last ones.
    """
    params = state.best.params if best else jax.vmap(setup.finetuner.export)(state.agent)
    card = {**prior.card, "estimator": None, **setup.finetuner.card}
    copied = jax.tree.map(jnp.copy, params)  # the state's arrays may be donated
    return [Prior(member(copied, i), card) for i in range(len(setup.seeds))]


class ActingPolicy:
    """A policy that remembers what it must between the steps of an episode.

    prior: its parameters and card. env: its task, for policies that plan and for the names of its numbers.
    """

    def __init__(self, prior: Prior, env: Env, *, seed: int = 0) -> None:
        self.prior, self.env = prior, env
        self._policy: Policy = make_policy(prior.card, env)
        self._act = jax.jit(self._policy.act)
        self._key = jax.random.key(seed)
        self.reset()

    def reset(self) -> None:
        """Forgets the episode; call it at the start of the next one."""
        self._carry = self._policy.init_carry()
        self._actions = np.zeros((self.env.previous_actions, self.env.act_dim), np.float32)

    def act(self, obs: ArrayLike, *, explore: bool = False) -> np.ndarray:
        """The action [act_dim] in [-1, 1] for what was measured, [measured_dim] in raw units.

        Raises UserError for another number of entries, and for one that is no number, not finite or too large; nothing
        is remembered then.
        """
        names = [f"{e.name}[{i}]" for e in self.env.measured for i in range(e.size)]
        measured = _judged(player.numbers, obs, names, "the policy reads {} measured numbers")
        seen = with_memory(self.env, measured, self._actions)  # of the system its own estimate counts
        following, key = jax.random.split(self._key)
        action, carry = self._act(self.prior.params, self._carry, seen, key, explore=explore)
        _judged(player.check_answer, action, *jax.tree.leaves(carry))
        self._key, self._carry, self._actions = following, carry, remember(self._actions, np.asarray(action))
        return np.asarray(action)


def _judged[T](check: Callable[..., T], *args: Any) -> T:
    """What a check of exported policies says, which know no UserError."""
    try:
        return check(*args)
    except ValueError as error:
        raise UserError(str(error)) from None


def load_policy(folder: str | Path, *, task: str | None = None, seed: int = 0) -> ActingPolicy:
    """The policy of a prior's folder, or of what fine-tuning left in `policy/` or `best/`.

    task: where the file of a task of your own is; otherwise the prior's card names its task. seed: of exploration and
    of plans. Raises UserError if there is no prior.
    """
    prior = load_prior(Path(folder))
    return ActingPolicy(prior, make_env(prior, task=task), seed=seed)
