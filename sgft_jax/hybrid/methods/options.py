"""Options that methods share, each with its help. Imports no JAX: command lines read it."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from sgft_jax import checks
from sgft_jax.types import HybridAgent, Learner, PyTree, RealData, Source, Task

if TYPE_CHECKING:
    from sgft_jax.learners.actor import Head
    from sgft_jax.learners.sac import SACHyper


@dataclass(frozen=True)
class ActorCriticOptions:
    """Options of soft actor-critics; the defaults are those of H2O+'s released code."""

    lr: float = 3e-4
    """Adam learning rate of every network."""
    tau: float = 0.005
    """Averaging rate of the target critics."""
    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers of actor, critics and value."""
    gamma: float = 0.99
    """Discount factor per control step."""

    def __post_init__(self) -> None:
        checks.positive(self, "lr")
        checks.share(self, "tau")
        checks.layers(self, "hidden")
        checks.below_one(self, "gamma")


@dataclass(frozen=True)
class OfflineOptions(ActorCriticOptions):
    """Options of methods that learn from the real rows alone."""

    rows: int = 256
    """Real rows of a batch."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.at_least(self, 1, "rows")


def sac_numbers(config: ActorCriticOptions) -> "SACHyper":
    """The numbers of methods that are made of SAC."""
    from sgft_jax.learners.sac import SACHyper

    return SACHyper(lr_actor=config.lr, lr_critic=config.lr, lr_alpha=config.lr, tau=config.tau)


def agent_of_rows(
    learner: Learner,
    config: ActorCriticOptions,
    task: Task,
    batches: Source,
    *,
    simulates: bool,
    head: "Head" = "gaussian",
    prepare: Callable[[PyTree, RealData], PyTree] = lambda state, real: state,
    export: Callable[[PyTree], PyTree] | None = None,
) -> HybridAgent:
    """The agent of a learner whose batches are single rows.

    head: of its actor, see `learners.actor.actor_policy`. prepare, export: see `HybridAgent`; by default nothing, and
    the actor and statistics of the learner's state.
    """
    from sgft_jax.data import replay
    from sgft_jax.learners import actor
    from sgft_jax.models.config import NetworkConfig

    network = NetworkConfig(config.hidden)
    return HybridAgent(
        learner=learner,
        keep=lambda real: replay.full(real.rows),
        batches=batches,
        simulates=simulates,
        prepare=prepare,
        export=export or actor.exported,
        policy=actor.actor_policy(task.obs_dim, task.act_dim, network, head),
        card=actor.card(network, head, config.gamma),
    )
