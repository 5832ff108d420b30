"""H2O+ with EDAC's critic: many that must not agree on how to leave the real data (Niu et al. 2023, An et al. 2021)."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.hybrid.methods import h2oplus
from sgft_jax.types import HybridAgent, HybridMethod, Task


@dataclass(frozen=True)
class Config(h2oplus.Config):
    """Options of `h2oplus-edac`: those of `h2oplus`, and its ensemble's."""

    critics: int = 10
    """Critics; value, targets and actor take the minimum of all."""
    diversity: float = 1.0
    """Weight of what keeps the critics' gradients at real pairs apart. With 2 critics and 0 it is `h2oplus`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.at_least(self, 2, "critics")
        checks.not_negative(self, "diversity")


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    return h2oplus.build(config, task, critics=config.critics, diversity=config.diversity)


METHOD = HybridMethod(
    "h2oplus-edac", "hybrid", "H2O+ with ten critics that must not agree on how to leave the data",
    "Niu et al. 2023, An et al. 2021", {"default": Config()}, build,
)  # fmt: skip
