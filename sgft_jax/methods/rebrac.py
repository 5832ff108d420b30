"""ReBRAC: TD3 whose actor and critic each pay for leaving the data's actions (Tarasov et al. 2023)."""

from dataclasses import dataclass, replace
from typing import ClassVar

from sgft_jax import checks
from sgft_jax.methods.options import RowsOptions, agent_of
from sgft_jax.models.config import NetworkConfig
from sgft_jax.types import Fixed, HybridAgent, Method, Task


@dataclass(frozen=True)
class Config(RowsOptions):
    """Options of `rebrac`."""

    target_noise: ClassVar[float] = 0.2
    target_noise_max: ClassVar[float] = 0.5
    explore_noise: ClassVar[float] = 0.1

    lr: float = 1e-3
    hidden: tuple[int, ...] = (256, 256, 256)
    rows: int = 1024
    """Real rows of a batch, each with the action that followed it."""
    actor_penalty: checks.NotNegative = 0.01
    """Weight of the squared distance of the actor's action from the data's."""
    critic_penalty: checks.NotNegative = 0.001
    """The same in targets, in units of return."""

    @property
    def network(self) -> NetworkConfig:
        """The body of every network; the actor's has no LayerNorm."""
        return NetworkConfig(self.hidden, layer_norm=True)


def build(config: Config, task: Task) -> HybridAgent:
    """The agent."""
    from sgft_jax.data import sequences, sources
    from sgft_jax.learners import rebrac

    structure = rebrac.ReBRACConfig(task.obs_dim, task.act_dim, config.network)
    return agent_of(
        rebrac.make_rebrac(structure, config),
        config,
        task,
        sources.real_windows(config.rows, 2),
        head="deterministic",
        keep=lambda real: sequences.full(real.rows, real.last),
    )


_REPLAY = Config()
_PRESETS = {  # the published penalties, by data set
    "halfcheetah-medium-replay": _REPLAY,
    "halfcheetah-medium": replace(_REPLAY, actor_penalty=0.001, critic_penalty=0.01),
    "walker2d-medium-replay": replace(_REPLAY, actor_penalty=0.05, critic_penalty=0.01),
    "walker2d-medium": replace(_REPLAY, actor_penalty=0.05, critic_penalty=0.1),
}
_ABOUT = "TD3 whose actor and critic pay for leaving the data"
METHOD = Method("rebrac", fixed=Fixed("offline", _ABOUT, "Tarasov et al. 2023", _PRESETS, build, by_data=True))
