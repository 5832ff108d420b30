"""EDAC: SAC whose many critics must not agree on how to leave the data (An et al. 2021)."""

from dataclasses import dataclass

from sgft_jax.methods.options import EnsembleOptions, RowsOptions, agent_of
from sgft_jax.types import Fixed, HybridAgent, Method, Task


@dataclass(frozen=True)
class Config(RowsOptions, EnsembleOptions):
    """Options of `edac`; with diversity 0 it is SAC-N."""

    hidden: tuple[int, ...] = (256, 256, 256)


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    from sgft_jax.learners import edac
    from sgft_jax.learners.sac import SACHyper

    sizes = task.obs_dim, task.act_dim, config.network
    structure = edac.EDACConfig(*sizes, critics=config.critics, diversity=config.diversity)
    return agent_of(edac.make_edac(structure, SACHyper.chosen(config)), config, task)


_ABOUT = "SAC whose many critics must not agree on how to leave the data"
METHOD = Method("edac", fixed=Fixed("offline", _ABOUT, "An et al. 2021", {"default": Config()}, build))
