"""The nouns every other module speaks: transitions, learners, priors, fine-tuners. Imports nothing of ours."""

import difflib
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

import jax
from flax import struct

Array = jax.Array
Key = jax.Array
PyTree = Any
Metrics = dict[str, Array]


class UserError(Exception):
    """Bad input: one line that names the file, key or option and says how to fix it. Entry points exit with code 2."""


def unknown(kind: str, name: str, options: Iterable[str]) -> str:
    """What to tell someone who asked for a `kind` called `name` where only `options` exist."""
    listed = sorted(options)
    close = difflib.get_close_matches(name, listed, n=1)
    hint = f", did you mean {close[0]!r}?" if close else "."
    return f"{kind}: there is no {name!r}{hint} Choose from: {', '.join(listed)}"


class Transition(NamedTuple):
    """One step of experience, or a batch of them with leading axes.

    obs: [obs_dim] observation before the action, raw units.
    action: [act_dim] in [-1, 1], as the policy chose it (before any effect of the system on it).
    reward: [] task reward of arriving in `next_obs` (O-2), never reshaped in storage.
    discount: [] gamma * (1 - terminated). A time limit never zeroes it.
    next_obs: [obs_dim] the true successor, also at the end of an episode.
    truncated: [] bool, the episode was cut here by its time limit.
    steps_to_go: [] int32, steps left in an H-step segment including this one; 0 = no segment assigned.
    """

    obs: Array
    action: Array
    reward: Array
    discount: Array
    next_obs: Array
    truncated: Array
    steps_to_go: Array


class Learner(NamedTuple):
    """A learning algorithm as pure functions, written for one agent and vmapped over seeds by the caller.

    init(key) -> state
    init_carry() -> carry: what the policy remembers between steps; () for an MLP.
    act(state, carry, obs, key, *, explore) -> (action, carry): one observation; `explore` is static.
    update(state, batch, key) -> (state, metrics): one gradient step of every trained network on a `[B, ...]` batch of
        transitions, or of what the learner says it needs.
    """

    init: Callable[[Key], PyTree]
    init_carry: Callable[[], PyTree]
    act: Callable[..., tuple[Array, PyTree]]
    update: Callable[[PyTree, Any, Key], tuple[PyTree, Metrics]]


class Normalizer(NamedTuple):
    """Fixed observation statistics: `mean`, `std`, both [obs_dim], raw units."""

    mean: Array
    std: Array


@struct.dataclass
class Prior:
    """What pretraining hands to fine-tuning: parameters only, frozen, shareable.

    actor, critic, value: network parameters (flax variables' `params`), critic with a leading ensemble axis of 2.
    dynamics: parameters of the delta-dynamics ensemble, leading axis = member.
    normalizer: statistics of the random-action data; every network above reads normalised observations.
    """

    actor: PyTree
    critic: PyTree
    value: PyTree
    dynamics: PyTree
    normalizer: Normalizer


class Imagination(NamedTuple):
    """What batch transforms may ask about the world: closures over the current fine-tuning state, for ONE example.

    value(obs) -> []: the frozen, deterministic V_sim.
    policy(obs, steps_to_go, key) -> [act_dim]: a sample of the current policy with that many steps to go.
    dynamics(obs, action, key) -> [obs_dim]: one predicted successor (a random ensemble member).
    reward(obs, action, next_obs) -> []: the task's reward.
    terminated(obs, action, next_obs) -> [] bool.
    gamma: [] discount factor.
    """

    value: Callable[[Array], Array]
    policy: Callable[[Array, Array, Key], Array]
    dynamics: Callable[[Array, Array, Key], Array]
    reward: Callable[[Array, Array, Array], Array]
    terminated: Callable[[Array, Array, Array], Array]
    gamma: float | Array


BatchTransform = Callable[[Imagination, Transition, Key], Transition]


Simulated = Callable[[Key, int], Transition]
"""(key, n) -> n transitions of the simulator, [n, ...]."""


class Finetuner(NamedTuple):
    """Fine-tuning of one agent as pure functions.

    init(prior, key) -> state.
    init_carry() -> what it remembers from step to step of an episode.
    act(state, carry, obs [obs_dim], key, *, explore) -> (action [act_dim], carry); explore: [] bool, may be traced.
    observe(state, transitions [T, ...], valid [T]) -> state: keep the rows of one episode, in order.
    learn(state, key, n_updates, simulated=None, *, offline=False) -> (state, metrics averaged over the updates);
        `n_updates` is static. simulated(key, n) -> n transitions of the simulator, for methods that ask for them;
        offline: learn from these alone (static).
    export(state) -> the agent in the form of a prior: actor and critic as they act, with the whole horizon to go.
    """

    init: Callable[[Any, Key], Any]
    init_carry: Callable[[], PyTree]
    act: Callable[..., tuple[Array, PyTree]]
    observe: Callable[[Any, Transition, Array], Any]
    learn: Callable[..., tuple[Any, Metrics]]
    export: Callable[[Any], PyTree]
