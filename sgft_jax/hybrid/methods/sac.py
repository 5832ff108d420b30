"""SAC in the simulator alone: what the imperfect simulator is worth without any real data."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.hybrid.methods.options import ActorCriticOptions
from sgft_jax.types import HybridAgent, HybridMethod, Task


@dataclass(frozen=True)
class Config(ActorCriticOptions):
    """Options of `sac`."""

    rows: int = 256
    """Simulated rows of a batch."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.at_least(self, 1, "rows")


def build(config: Config, task: Task) -> HybridAgent:
    """The agent: H2O+ with neither real rows nor their value is SAC, with the same networks."""
    from sgft_jax.data import sources
    from sgft_jax.learners import actor, h2oplus
    from sgft_jax.models.config import NetworkConfig

    network = NetworkConfig(config.hidden)
    structure = h2oplus.H2OPlusConfig(task.obs_dim, task.act_dim, network, ratio=False)
    rates = dict.fromkeys(("lr_actor", "lr_critic", "lr_value", "lr_alpha"), config.lr)
    return HybridAgent(
        learner=h2oplus.make_h2oplus(structure, h2oplus.H2OPlusHyper(**rates, tau=config.tau, value_share=0.0)),
        batches=sources.two_buffers(0, config.rows),
        simulates=True,
        prepare=lambda state, rows: state,
        export=actor.exported,
        policy=actor.affine_policy(task.obs_dim, task.act_dim, network),
        card=actor.card(network, config.gamma),
    )


METHOD = HybridMethod(
    "sac", "simulator", "SAC in the simulator alone", "Haarnoja et al. 2018", {"default": Config()}, build
)
