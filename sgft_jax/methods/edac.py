"""EDAC: SAC whose many critics must not agree on how to leave the data (An et al. 2021)."""

from dataclasses import dataclass

from sgft_jax.methods.options import EnsembleOptions, RowsOptions, agent_of, sac_numbers
from sgft_jax.types import Fixed, HybridAgent, Method, Task


@dataclass(frozen=True)
class Config(RowsOptions, EnsembleOptions):
    """Options of `edac`; with diversity 0 it is SAC-N."""

    hidden: tuple[int, ...] = (256, 256, 256)


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    from sgft_jax.learners import edac

    sizes = task.obs_dim, task.act_dim, config.network
    structure = edac.EDACConfig(*sizes, critics=config.critics, diversity=config.diversity)
    return agent_of(edac.make_edac(structure, sac_numbers(config)), config, task)


METHOD = Method(
    "edac",
    fixed=Fixed(
        "offline",
        "SAC whose many critics must not agree on how to leave the data",
        "An et al. 2021",
        {"default": Config()},
        build,
    ),
)
