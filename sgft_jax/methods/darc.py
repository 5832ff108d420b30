"""DARC: SAC in a simulator that pays less where it does what the real system would not (Eysenbach et al. 2021)."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.methods.options import RowsOptions, agent_of
from sgft_jax.types import Fixed, HybridAgent, Method, Task


@dataclass(frozen=True)
class Config(RowsOptions):
    """Options of `darc`; the defaults are those of the baseline of H2O+, with a fixed set of real data."""

    rows: int = 256
    """Simulated rows of a batch."""
    ratio_rows: checks.Rows = 256
    """Real rows for the discriminators; they have as many simulated ones."""


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    from sgft_jax.learners import darc
    from sgft_jax.learners.sac import SACHyper
    from sgft_jax.policies import actor_params

    structure = darc.DARCConfig(task.obs_dim, task.act_dim, config.network, ratio_rows=2 * config.ratio_rows)
    learner = darc.make_darc(structure, SACHyper.chosen(config), lr_ratio=config.lr)
    batches = darc.batches(config.rows, config.ratio_rows)
    return agent_of(learner, config, task, batches, simulates=True, export=lambda state: actor_params(state.sac))


_ABOUT = "SAC in the simulator, paid less where the real system would act otherwise"
METHOD = Method("darc", fixed=Fixed("hybrid", _ABOUT, "Eysenbach et al. 2021", {"default": Config()}, build))
