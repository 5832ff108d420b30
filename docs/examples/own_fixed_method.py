"""A method of your own for a fixed set of real data: SAC whose batches are half real and half simulated rows.

Commands read this file before they start JAX, so JAX is imported where it is used.
"""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.methods.options import ActorCriticOptions, agent_of
from sgft_jax.types import Fixed, HybridAgent, Method, Task


@dataclass(frozen=True)
class Config(ActorCriticOptions):
    """Options of `sac-both`: learning rate, widths and discount factor, and what is written here."""

    rows: checks.Rows = 128
    """Real rows of a batch; it has as many simulated ones."""


def build(config: Config, task: Task) -> HybridAgent:
    """Which learner it is, and what its batches are made of."""
    from sgft_jax.data import sources
    from sgft_jax.learners.sac import SACConfig, SACHyper, make_sac

    structure = SACConfig(task.obs_dim, task.act_dim, config.network, train_dynamics=False)
    batches = sources.two_buffers(config.rows, config.rows)
    return agent_of(make_sac(structure, SACHyper.chosen(config)), config, task, batches, simulates=True)


METHOD = Method(  # what `--method docs/examples/own_fixed_method.py` looks for
    "sac-both",
    fixed=Fixed(
        "hybrid",
        "SAC on real and simulated rows alike",
        "docs/extending.md",
        {"default": Config(), "small": Config(hidden=(32, 32), rows=16)},
        build,
    ),
)
