"""EDAC: SAC whose many critics must not agree on how to leave the data (An et al. 2021)."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.hybrid.methods.options import OfflineOptions, agent_of, sac_numbers
from sgft_jax.types import HybridAgent, HybridMethod, Task


@dataclass(frozen=True)
class Config(OfflineOptions):
    """Options of `edac`."""

    hidden: tuple[int, ...] = (256, 256, 256)
    """Widths of the hidden layers of actor and critics."""
    critics: int = 10
    """Critics; targets and actor take the minimum of all."""
    diversity: float = 1.0
    """Weight of what keeps the critics' gradients apart; 0 = SAC-N."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.at_least(self, 2, "critics")
        checks.not_negative(self, "diversity")


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    from sgft_jax.data import sources
    from sgft_jax.learners import edac
    from sgft_jax.models.config import NetworkConfig

    structure = edac.EDACConfig(
        task.obs_dim, task.act_dim, NetworkConfig(config.hidden), critics=config.critics, diversity=config.diversity
    )
    learner = edac.make_edac(structure, sac_numbers(config))
    return agent_of(learner, config, task, sources.real_rows(config.rows), simulates=False)


METHOD = HybridMethod(
    "edac",
    "offline",
    "SAC whose many critics must not agree on how to leave the data",
    "An et al. 2021",
    {"default": Config()},
    build,
)
