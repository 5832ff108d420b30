"""IQL: the best of the data's own actions, without asking what another is worth (Kostrikov et al. 2021)."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from sgft_jax import checks
from sgft_jax.hybrid.methods.options import OfflineOptions, agent_of, numbers_of, return_scale
from sgft_jax.types import HybridAgent, HybridMethod, Task

if TYPE_CHECKING:
    from sgft_jax.learners.iql import IQLState
    from sgft_jax.types import RealData


@dataclass(frozen=True)
class Config(OfflineOptions):
    """Options of `iql`; the published ones for locomotion."""

    expectile: float = 0.7
    """V is the mean of the data's actions at 0.5 and their best towards 1."""
    beta: float = 3.0
    """Inverse temperature of the advantage weights; 0 clones the data."""
    falling_rate: bool = True
    """Let the actor's learning rate fall to 0 along a cosine over all updates of the run, as the authors do."""
    scale_rewards: bool = True
    """Divide rewards by the span of the data's returns and multiply them by 1,000, as the authors do. A log of one
    episode keeps its rewards."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.share(self, "expectile")
        checks.not_negative(self, "beta")


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    import jax.numpy as jnp

    from sgft_jax.data import sources
    from sgft_jax.learners import actor, iql
    from sgft_jax.models.config import NetworkConfig

    def prepare(state: "IQLState", real: "RealData", updates: int) -> "IQLState":
        hyper = state.hyper
        if config.scale_rewards:
            hyper = hyper._replace(reward_scale=return_scale(real))
        if config.falling_rate:
            hyper = hyper._replace(actor_updates=jnp.float32(updates))
        return state.replace(hyper=hyper)

    def export(state: "IQLState") -> actor.ACTORParams:
        return actor.ACTORParams(iql.as_tanh_gaussian(state.actor.params), actor.exported(state).normalizer)

    structure = iql.IQLConfig(task.obs_dim, task.act_dim, NetworkConfig(config.hidden))
    learner = iql.make_iql(structure, numbers_of(iql.IQLHyper, config, "actor", "critic", "value"))
    batches = sources.real_rows(config.rows)
    return agent_of(learner, config, task, batches, simulates=False, prepare=prepare, export=export)


METHOD = HybridMethod(
    "iql", "offline", "the best of the data's own actions", "Kostrikov et al. 2021", {"default": Config()}, build
)
