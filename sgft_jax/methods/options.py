"""What methods of fixed data share: options, each with its help, and their agent. Imports no JAX at the top."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from envs.types import Array, PyTree
from sgft_jax import checks
from sgft_jax.files.disk import jsonable
from sgft_jax.models.config import NetworkConfig
from sgft_jax.types import HybridAgent, Learner, RealData, Source, Task

if TYPE_CHECKING:
    from sgft_jax.policies import Head

_RETURN_SPAN = 1000.0  # of scaled returns, as published for locomotion


@dataclass(frozen=True)
class ActorCriticOptions(checks.Checked):
    """Options of soft actor-critics; the defaults are those of H2O+'s released code.

    A `ClassVar` is no option, see `ActorOptions`. A learner takes its numbers from here under its own names.
    """

    alpha: ClassVar[float] = 1.0
    entropy_per_dim: ClassVar[float] = -1.0
    actor_ramp: ClassVar[float] = 0.0

    lr: checks.Positive = 3e-4
    """Adam learning rate of every network."""
    tau: checks.Share = 0.005
    """Averaging rate of the target critics."""
    hidden: checks.Layers = (256, 256)
    """Widths of the hidden layers of every network."""
    gamma: checks.BelowOne = 0.99
    """Discount factor per control step."""

    @property
    def network(self) -> NetworkConfig:
        """The body of every network."""
        return NetworkConfig(self.hidden)

    @property
    def lr_actor(self) -> float:
        """The rate as that of one network."""
        return self.lr

    lr_critic = lr_value = lr_alpha = lr_ratio = lr_actor


@dataclass(frozen=True)
class RowsOptions(ActorCriticOptions):
    """Options of methods whose batches are of one kind of rows, real ones unless a method says otherwise."""

    rows: checks.Rows = 256
    """Real rows of a batch."""


@dataclass(frozen=True)
class HybridOptions(ActorCriticOptions):
    """Options of methods whose critic learns from real and simulated rows, which discriminators tell apart."""

    rows: checks.Rows = 128
    """Real rows of a batch; it has as many simulated ones."""
    ratio_rows: checks.Rows = 256
    """The same for the discriminators, which have batches of their own."""


@dataclass(frozen=True)
class EnsembleOptions(ActorCriticOptions):
    """Options of methods whose many critics must not agree on how to leave the data, as in EDAC."""

    critics: Annotated[int, checks.least(2), checks.few] = 10
    """Critics; whatever reads values takes the minimum of all."""
    diversity: checks.NotNegative = 1.0
    """Weight of what keeps the critics' gradients at the data's actions apart; 0 leaves it out. It does nothing where a
    task has one action, whose gradients have only a sign."""


def return_scale(real: RealData) -> Array:
    """What rewards are multiplied by [] so that the best and the worst recorded return are 1,000 apart.

    Returns are undiscounted sums over the recorded episodes. 1 where they do not differ, as in a log of one episode.
    Source: IQL (Kostrikov et al. 2021), whose successors SQL, EQL and XQL scale rewards alike.
    """
    import jax
    import jax.numpy as jnp

    n = real.last.shape[0]
    number = jnp.cumsum(real.last) - real.last  # of the episode of every row
    returns = jax.ops.segment_sum(real.rows.reward, number, n)
    recorded = jnp.arange(n) <= number[-1]
    span = jnp.max(returns, where=recorded, initial=-jnp.inf) - jnp.min(returns, where=recorded, initial=jnp.inf)
    return jnp.where(span > 0, _RETURN_SPAN / span, 1.0)


def real_and_simulated(config: HybridOptions) -> Source:
    """Rows of both origins for actor, critic and value, then those of the discriminators."""
    from sgft_jax.data import sources

    return sources.beside(*(sources.two_buffers(n, n) for n in (config.rows, config.ratio_rows)))


def agent_of(
    learner: Learner,
    config: Any,
    task: Task,
    batches: Source | None = None,
    *,
    simulates: bool = False,
    head: "Head" = "gaussian",
    keep: Callable[[RealData], PyTree] | None = None,
    prepare: Callable[[PyTree, RealData, int], PyTree] = lambda state, real, updates: state,
    export: Callable[[PyTree], PyTree] | None = None,
) -> HybridAgent:
    """The agent of a learner. config: an `ActorCriticOptions`.

    head: of its actor, see `policies.actor_policy`. batches, keep, prepare, export: see `HybridAgent`; by default
    `rows` real rows, single rows, nothing, and the actor and statistics of the learner's state.
    """
    from sgft_jax import policies
    from sgft_jax.data import replay, sources

    return HybridAgent(
        learner=learner,
        keep=keep or (lambda real: replay.full(real.rows)),
        batches=batches or sources.real_rows(config.rows),
        simulates=simulates,
        prepare=prepare,
        export=export or policies.actor_params,
        policy=policies.actor_policy(task.obs_dim, task.act_dim, config.network, head),
        card={"algorithm": "actor", "network": jsonable(config.network), "head": head, "gamma": config.gamma},
    )
