"""SAC in the simulator alone: what the imperfect simulator is worth without any real data."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.hybrid.methods.options import ActorCriticOptions, agent_of, sac_numbers
from sgft_jax.types import HybridAgent, HybridMethod, Task


@dataclass(frozen=True)
class Config(ActorCriticOptions):
    """Options of `sac`."""

    rows: int = 256
    """Simulated rows of a batch."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.rows(self, "rows")


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    from sgft_jax.data import sources
    from sgft_jax.learners.sac import SACConfig, make_sac
    from sgft_jax.models.config import NetworkConfig

    structure = SACConfig(
        task.obs_dim, task.act_dim, network=NetworkConfig(config.hidden), train_value=False, train_dynamics=False
    )
    learner = make_sac(structure, sac_numbers(config))
    return agent_of(learner, config, task, sources.two_buffers(0, config.rows), simulates=True)


METHOD = HybridMethod(
    "sac", "simulator", "SAC in the simulator alone", "Haarnoja et al. 2018", {"default": Config()}, build
)
