"""CQL: SAC whose critic is pushed down where the data do not go (Kumar et al. 2020)."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.methods.options import RowsOptions, agent_of
from sgft_jax.types import Fixed, HybridAgent, Method, Task


@dataclass(frozen=True)
class Config(RowsOptions):
    """Options of `cql`."""

    conservatism: checks.NotNegative = 2.0
    """Weight of the push, in units of return. Others use 5 or 10."""
    samples: checks.Few = 10
    """Actions drawn from each of the uniform distribution and the policy at s and at s'."""


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    from sgft_jax.learners import cql
    from sgft_jax.learners.sac import SACHyper

    sizes = task.obs_dim, task.act_dim, config.network
    structure = cql.CQLConfig(*sizes, conservatism=config.conservatism, samples=config.samples)
    return agent_of(cql.make_cql(structure, SACHyper.chosen(config)), config, task)


_ABOUT = "SAC whose critic is pushed down where the data do not go"
METHOD = Method("cql", fixed=Fixed("offline", _ABOUT, "Kumar et al. 2020", {"default": Config()}, build))
