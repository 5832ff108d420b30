"""H2O: one critic from real and simulated rows, pushed down where the simulator is wrong (Niu et al. 2022)."""

from dataclasses import dataclass, replace

from sgft_jax import checks
from sgft_jax.methods.options import HybridOptions, agent_of, real_and_simulated
from sgft_jax.types import Fixed, HybridAgent, Method, RealData, Task


@dataclass(frozen=True)
class Config(HybridOptions):
    """Options of `h2o`."""

    conservatism: checks.NotNegative = 0.01
    """Weight of the push on the critic, in units of return."""
    spread_scale: checks.Positive = 1.0
    """Factor on the spread of the data over which a pair's gap of the dynamics is averaged. The released code takes
    the spread over a buffer padded with zeros, which makes it 0.3."""


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    from sgft_jax.data import replay
    from sgft_jax.learners import h2o

    def prepare(state: h2o.H2OState, real: RealData, updates: int) -> h2o.H2OState:
        return state.replace(spread=replay.obs_std(replay.full(real.rows)))

    structure = h2o.H2OConfig(task.obs_dim, task.act_dim, config.network, ratio_rows=2 * config.ratio_rows)
    learner, batches = h2o.make_h2o(structure, config), real_and_simulated(config)
    return agent_of(learner, config, task, batches, simulates=True, head="affine", prepare=prepare)


_PAPER = Config()
_PRESETS = {"paper": _PAPER, "released": replace(_PAPER, spread_scale=0.3)}
_ABOUT = "one critic, pushed down where the simulator is wrong"
METHOD = Method("h2o", fixed=Fixed("hybrid", _ABOUT, "Niu et al. 2022", _PRESETS, build))
