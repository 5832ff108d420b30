"""H2O+: the in-sample value of the real data and SAC in the simulator feed one critic (Niu et al. 2023)."""

from dataclasses import dataclass, replace
from typing import ClassVar

from sgft_jax import checks
from sgft_jax.methods.options import HybridOptions, agent_of, real_and_simulated, return_scale
from sgft_jax.types import Fixed, HybridAgent, Method, RealData, Task, ValueLoss


@dataclass(frozen=True)
class Config(HybridOptions):
    """Options of `h2oplus`. The defaults are the paper's, and where it is silent IQL's and the released code's."""

    critics: ClassVar[int] = 2
    diversity: ClassVar[float] = 0.0

    value_loss: ValueLoss = "iql"
    """What the value of the real data is: IQL's expectile, or that of SQL, EQL or XQL."""
    value_share: checks.Share = 0.1
    """Lambda: share of the target's bootstrap that comes from that value; 0 is SAC on both kinds of rows."""
    expectile: checks.Share = 0.7
    """Of the value loss `iql`."""
    value_alpha: checks.Positive = 1.0
    """Scale of the other value losses, in units of returns scaled until the best and the worst episode of the data are
    1,000 apart. Returns are not scaled where the data are one episode."""
    value_cut: checks.Positive = 5.0
    """Of the value losses `eql` and `xql`: the largest exponent, an advantage in units of that scale."""
    ratio: bool = True
    """Weigh simulated errors by the ratio of the dynamics; off: they count like real ones."""
    standardise: bool = False
    """Let the discriminators of that ratio read standardised observations. The released code does not."""


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    from sgft_jax.learners import h2oplus
    from sgft_jax.models import normalizer

    def prepare(state: h2oplus.H2OPlusState, real: RealData, updates: int) -> h2oplus.H2OPlusState:
        alpha = state.hyper.value_alpha / return_scale(real)  # the learner itself has it in units of return
        state = state.replace(hyper=state.hyper._replace(value_alpha=alpha))
        if state.ratio is not None and config.standardise:
            state = state.replace(ratio=state.ratio._replace(normalizer=normalizer.of(real.rows.obs)))
        return state

    chosen = {name: getattr(config, name) for name in ("critics", "diversity", "value_loss", "ratio")}
    structure = h2oplus.H2OPlusConfig(
        task.obs_dim, task.act_dim, config.network, ratio_rows=2 * config.ratio_rows, **chosen
    )
    learner, batches = h2oplus.make_h2oplus(structure, config), real_and_simulated(config)
    return agent_of(learner, config, task, batches, simulates=True, head="affine", prepare=prepare)


_PAPER = Config()
_PRESETS = {
    "paper": _PAPER,
    "released": replace(_PAPER, value_share=0.5, expectile=0.5),
    "released-robot": replace(_PAPER, expectile=0.9, hidden=(32, 32), rows=16),
    "no-ratio": replace(_PAPER, ratio=False),
    **{f"lambda-{share:g}": replace(_PAPER, value_share=share) for share in (0.0, 0.2, 0.5, 1.0)},
}
# With the numbers of their own authors' code for locomotion, which scales rewards so that returns span 1,000. In units
# of the return itself EQL's diverges: where V is below a critic by more than the cut-off, the loss lowers V further.
# XQL has numbers for each data set; these are its one setting for all of them. Source: IVR (SQL, EQL: run_mujoco.sh),
# XQL (offline/reproduce/mujoco).
_BACKBONES = {
    "sql": replace(_PAPER, value_loss="sql", value_alpha=1.0),
    "eql": replace(_PAPER, value_loss="eql", value_alpha=2.0, value_cut=5.0),
    "xql": replace(_PAPER, value_loss="xql", value_alpha=2.0, value_cut=7.0),
}
_ABOUT = "in-sample value of the data and SAC in the simulator, weighted by a ratio of dynamics"
METHOD = Method("h2oplus", fixed=Fixed("hybrid", _ABOUT, "Niu et al. 2023", _PRESETS | _BACKBONES, build))
