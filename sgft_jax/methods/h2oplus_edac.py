"""H2O+ with EDAC's critic: many that must not agree on how to leave the real data (Niu et al. 2023, An et al. 2021)."""

from dataclasses import dataclass

from sgft_jax.methods import h2oplus
from sgft_jax.methods.options import EnsembleOptions
from sgft_jax.types import Fixed, HybridAgent, Method, Task


@dataclass(frozen=True)
class Config(h2oplus.Config, EnsembleOptions):
    """Options of `h2oplus-edac`; with 2 critics and diversity 0 it is `h2oplus`."""


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    return h2oplus.build(config, task, critics=config.critics, diversity=config.diversity)


METHOD = Method(
    "h2oplus-edac",
    fixed=Fixed(
        "hybrid",
        "H2O+ with ten critics that must not agree on how to leave the data",
        "Niu et al. 2023, An et al. 2021",
        {"default": Config()},
        build,
    ),
)
