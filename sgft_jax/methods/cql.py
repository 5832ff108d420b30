"""CQL: SAC whose critic is pushed down where the data do not go (Kumar et al. 2020)."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.methods.options import RowsOptions, agent_of, sac_numbers
from sgft_jax.types import Fixed, HybridAgent, Method, Task


@dataclass(frozen=True)
class Config(RowsOptions):
    """Options of `cql`."""

    conservatism: float = 2.0
    """Weight of the push, in units of return. Others use 5 or 10."""
    samples: int = 10
    """Actions drawn from each of the uniform distribution and the policy at s and at s'."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.not_negative(self, "conservatism")
        checks.few(self, 1, "samples")


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    from sgft_jax.data import sources
    from sgft_jax.learners import cql

    structure = cql.CQLConfig(
        task.obs_dim,
        task.act_dim,
        config.network,
        conservatism=config.conservatism,
        samples=config.samples,
    )
    learner = cql.make_cql(structure, sac_numbers(config))
    return agent_of(learner, config, task, sources.real_rows(config.rows), simulates=False)


METHOD = Method(
    "cql",
    fixed=Fixed(
        "offline",
        "SAC whose critic is pushed down where the data do not go",
        "Kumar et al. 2020",
        {"default": Config()},
        build,
    ),
)
