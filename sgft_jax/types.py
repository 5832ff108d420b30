"""The nouns of learning and fine-tuning. Imports no JAX."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Protocol

from envs.types import Array, Key, Policy, PyTree, Transition, UserError

__all__ = ["Batch", "Finetuner", "Fixed", "HybridAgent", "Imagination", "Learner", "Method", "Normalizer", "Online"]
__all__ += ["Prior", "SimulatedData", "Simulation", "Source", "Task", "Transform"]
__all__ += ["Policy", "Transition", "UserError"]  # of `envs.types`, public here too

Metrics = dict[str, Array]


# --- experience -----------------------------------------------------------------------------------------------------


class Batch(NamedTuple):
    """Transitions [B, ...] as a learner sees them. A field that nobody uses is None and costs nothing.

    Learners of sequences take windows: [B, H, ...], where `next_obs` of a step is `obs` of the next.
    valid: [B] or [B, H] bool, False for rows that must not count. Their values are finite.
    weight: [B], how much each row counts in the losses; None counts as 1.
    is_sim: [B] bool, True for rows of the simulator.
    context, next_context: [B, context_dim], further network inputs that go with `obs` and `next_obs` and are not part
        of the observation, such as the steps to go. Networks read them as they are, without normalisation.
    """

    obs: Array
    action: Array
    reward: Array
    discount: Array
    next_obs: Array
    valid: Array | None = None
    weight: Array | None = None
    is_sim: Array | None = None
    context: Array | None = None
    next_context: Array | None = None


class Source(NamedTuple):
    """Where the rows of a batch come from.

    sample(state, key) -> Batch [n_real + n_sim, ...], real rows first. The counts are static.
    """

    sample: Callable[[PyTree, Key], Batch]
    n_real: int
    n_sim: int = 0


class SimulatedData(NamedTuple):
    """A fixed set of simulated transitions, seen by one member. All members share the arrays behind it.

    draw(key, n) -> n rows, [n, ...]. returns: [episodes] undiscounted task returns of the episodes they come from.
    """

    draw: Callable[[Key, int], Transition]
    returns: Array


# --- learning -------------------------------------------------------------------------------------------------------


class Act(Protocol):
    """How an agent acts."""

    def __call__(self, state: Any, carry: Any, obs: Array, key: Key, /, *, explore: bool | Array) -> tuple[Array, Any]:
        """(action [act_dim] in [-1, 1], carry). obs: [obs_dim] raw. explore: [] bool, which may be traced."""
        ...


class Learner(NamedTuple):
    """A learning algorithm as pure functions, written for one agent; the caller vmaps over seeds.

    init(key) -> state.
    init_carry() -> carry, what the policy remembers from step to step of an episode; () for an MLP.
    act: see `Act`. Learners that were built with a context take `context` [context_dim], too.
    update(state, batch, key) -> (state, metrics), one gradient step of every network that trains.
    """

    init: Callable[[Key], PyTree]
    init_carry: Callable[[], PyTree]
    act: Callable[..., tuple[Array, PyTree]]
    update: Callable[[PyTree, Batch, Key], tuple[PyTree, Metrics]]


class Normalizer(NamedTuple):
    """Fixed observation statistics: `mean` and `std`, both [obs_dim], raw units."""

    mean: Array
    std: Array


class Imagination(NamedTuple):
    """What transforms may ask about the world: closures over the current fine-tuning state, for ONE example.

    value(obs) -> []: the frozen, deterministic V_sim.
    policy(obs, context, key) -> [act_dim]: a sample of the current policy. context: None or [context_dim].
    dynamics(obs, action, key) -> [obs_dim]: one predicted successor.
    reward(obs, action, next_obs) -> []: the task's reward. terminated(obs, action, next_obs) -> [] bool.
    gamma: [] discount factor.
    """

    value: Callable[[Array], Array]
    policy: Callable[[Array, Array | None, Key], Array]
    dynamics: Callable[[Array, Array, Key], Array]
    reward: Callable[[Array, Array, Array], Array]
    terminated: Callable[[Array, Array, Array], Array]
    gamma: float | Array


class Transform(NamedTuple):
    """A change of a sampled batch before the learner sees it.

    init(params, key) -> state, () for a transform that does not learn. params: of the prior, None without one.
    apply(state, imagination, batch, key) -> Batch. imagination: an `Imagination`, or what else the method offers.
    update(state, batch, key) -> (state, metrics): learns from the batch as it was sampled; by default nothing.
    """

    init: Callable[[PyTree, Key], PyTree]
    apply: Callable[[PyTree, Any, Batch, Key], Batch]
    update: Callable[[PyTree, Batch, Key], tuple[PyTree, Metrics]] = lambda state, batch, key: (state, {})


# --- between simulation and reality ---------------------------------------------------------------------------------


class Task(Protocol):
    """What a method needs to know of a task; every `envs.Env` is one.

    reward, terminated: functions of one (obs, action, next_obs), None where the task has no such function.
    """

    @property
    def obs_dim(self) -> int:
        """Length of the observation vector."""
        ...

    @property
    def act_dim(self) -> int:
        """Length of the action vector."""
        ...

    @property
    def measured_dim(self) -> int:
        """How many numbers of the observation are measured."""
        ...

    @property
    def sensor_errors(self) -> tuple[float, ...]:
        """[measured_dim] how far off each sensor of a real system may be for good, as a std in its own unit."""
        ...

    @property
    def cartesian(self) -> bool:
        """Whether the first two actions are x and y of one frame."""
        ...

    @property
    def episode_length(self) -> int:
        """Control steps until the time limit."""
        ...

    @property
    def score(self) -> str:
        """What a run is judged by, "success" or "return"."""
        ...

    @property
    def simulator(self) -> Callable[[], Callable[[Array, Array], Array]] | None:
        """Compiles (obs, action) -> [measured_dim], what a step changes in the system that `obs` tells."""
        ...

    @property
    def reward(self) -> Callable[[Array, Array, Array], Array] | None:
        """Task reward []."""
        ...

    @property
    def terminated(self) -> Callable[[Array, Array, Array], Array] | None:
        """Whether the episode ends for good, [] bool."""
        ...


@dataclass(frozen=True)
class Prior:
    """What pretraining hands to fine-tuning.

    params: the networks' parameters and the observation statistics (`SACParams`, `TDMPC2Params` or
        `RecurrentParams`).
    card: JSON data: task, algorithm, network, gamma, and the numbers that were measured.
    """

    params: PyTree
    card: Mapping[str, Any]


class Simulation(NamedTuple):
    """Simulated data that a method asks for: whole episodes of the prior's policy in the training domain.

    transitions: how many. ladder: from the first episode to the last, a share of the actions that grows from 0 to this
        is replaced by random ones, as along the fleet of pretraining. offline_updates: updates on them alone, before
        the first real rollout.
    """

    transitions: int
    ladder: float
    offline_updates: int = 0


class Learn(Protocol):
    """Learning of an agent from what it has observed; see `Finetuner`."""

    def __call__(
        self,
        state: Any,
        key: Key,
        updates: int,
        simulated: SimulatedData | None = None,
        /,
        *,
        offline: bool = False,
        limit: Array | None = None,
    ) -> tuple[Any, Metrics]:
        """(state, metrics averaged over the updates). `updates` and `offline` are static.

        offline: learn from the simulated transitions alone. limit: [] int32, no more updates than that, for rollouts
        that ended early. The metric `updates` counts them; there is none, and the other metrics are nan, while an agent
        that learns from real rows holds none.
        """
        ...


class Finetuner(NamedTuple):
    """Fine-tuning of one agent on one real system, as pure functions; the caller vmaps over members.

    init(params, key) -> state. params: of a prior, None without one.
    prepare(state, simulated) -> state that has seen the simulated data once, for statistics; it acts as before. Comes
        before `observe` and `learn`. simulated: a `SimulatedData`, or None for a method that asks for none.
    init_carry() -> carry of an episode.
    act, learn: see `Act` and `Learn`.
    observe(state, transitions [T, ...], valid [T], score []) -> state: keeps the rows of one episode, in order. score:
        of the episode, -inf if its physics exploded; None if another policy has played it, as in a log, so that a guard
        does not count it.
    export(state) -> params of the agent as it would be deployed now.
    policy: how exported params act.
    updates_per_rollout: gradient updates that follow a real rollout of full length.
    initial_rollouts: real rollouts before the first update.
    initial_policy: what makes them, from the prior's params; None = the agent itself.
    simulation: the simulated data that the method needs, or None.
    card: what the card of an exported policy says beyond the prior's, such as the options of a plan.
    trial(state) -> params by which it acts in its next rollout; None = those of `export`.
    guarded: whether a guard chooses who acts.
    estimates: whether it reads the estimator of a prior.
    """

    init: Callable[[PyTree, Key], PyTree]
    prepare: Callable[[PyTree, SimulatedData | None], PyTree]
    init_carry: Callable[[], PyTree]
    act: Act
    observe: Callable[[PyTree, Transition, Array, Array | None], PyTree]
    learn: Learn
    export: Callable[[PyTree], PyTree]
    policy: Policy
    updates_per_rollout: int
    initial_rollouts: int
    initial_policy: Policy | None
    simulation: Simulation | None
    card: Mapping[str, Any]
    trial: Callable[[PyTree], PyTree] | None = None
    guarded: bool = False
    estimates: bool = False


ValueLoss = Literal["iql", "sql", "eql", "xql"]
Successors = Literal["stored", "shifted"]  # where next observations of a D4RL file come from, see `data.layouts`
Family = Literal["sgft", "model-free", "model-based", "offline", "planning"]
FixedKind = Literal["hybrid", "offline", "simulator"]


# --- from a fixed set of real data and a simulator ------------------------------------------------------------------


class RealData(NamedTuple):
    """A fixed set of real transitions, in the order in which they were recorded.

    rows: [N, ...]. last: [N] bool, those that the next row does not follow.
    """

    rows: Transition
    last: Array


class HybridAgent(NamedTuple):
    """An agent that learns from a fixed set of real rows, from rows that it collects in a simulator, or from both.

    keep(real) -> memory of the real rows. batches: what an update takes, from the state (that memory, replay of its own
        rows or None).
    simulates: whether it acts in a simulator while it learns.
    prepare(state, real, updates) -> state: a fresh learner that has seen the real data once, for statistics, and knows
        how many updates will follow.
    export(state) -> params of its policy. policy: how these act. card: what the card of an exported policy says of it.
    """

    learner: Learner
    keep: Callable[[RealData], PyTree]
    batches: Source
    simulates: bool
    prepare: Callable[[PyTree, RealData, int], PyTree]
    export: Callable[[PyTree], PyTree]
    policy: Policy
    card: Mapping[str, Any]


# --- methods --------------------------------------------------------------------------------------------------------


class Online(NamedTuple):
    """How a method learns from rollouts of the real system: fine-tuning.

    family: the kind of method, for tables and figures. description, source: one line each.
    config: a frozen dataclass whose fields carry their help; its defaults are the method's settings.
    build(config, prior, task) -> Finetuner. Every option left open (None) is resolved here.
    prior: the algorithm of the priors that it starts from. needs_prior: False where it can start without one.
    zero_shot: whether it begins as its prior acts; False where it plans otherwise or begins from nothing.
    sees_system: True where these priors must see which system they are in, as no others may. blind_actor: whether their
        actors must not.
    name: of the method; `methods.get_method` fills it in.
    """

    family: Family
    description: str
    source: str
    config: type[Any]
    build: Callable[[Any, Prior | None, Task], Finetuner]
    prior: str = "sac"
    needs_prior: bool = True
    zero_shot: bool = True
    sees_system: bool = False
    blind_actor: bool = False
    name: str = ""


class Fixed(NamedTuple):
    """How a method learns without touching the real system.

    kind: what it learns from: real rows and a simulator, the real rows alone, or the simulator alone.
    description, source: one line each. presets: settings by name, frozen dataclasses that derive from
    `methods.options.ActorCriticOptions` and whose fields carry their help; the first is the default.
    build(config, task) -> HybridAgent. by_data: whether presets are called after data sets, see `presets.preset_for`.
    name: of the method; `methods.get_method` fills it in.
    """

    kind: FixedKind
    description: str
    source: str
    presets: Mapping[str, Any]
    build: Callable[[Any, Task], HybridAgent]
    by_data: bool = False
    name: str = ""

    @property
    def config(self) -> Any:
        """The default settings."""
        return next(iter(self.presets.values()))


class Method(NamedTuple):
    """A method and what it can learn from; each file of `sgft_jax/methods/` has one.

    name: of folders and tables. online: how it fine-tunes, None if it does not. fixed: how it learns from a fixed set
    of real data, a simulator or both, None if it does not.
    """

    name: str
    online: Online | None = None
    fixed: Fixed | None = None
