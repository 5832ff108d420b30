"""SAC on the task reward, from the simulator's actor and critic."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.methods.options import KeptCriticOptions
from sgft_jax.types import Finetuner, Method, Prior, Simulation, Task


@dataclass(frozen=True)
class Config(KeptCriticOptions):
    """Options of `sac`."""

    utd: float = 1.0
    """Gradient updates per real transition. One did better than eight wherever both were tried (docs/protocol.md)."""
    simulated_share: float = 0.0
    """Share of each batch that is simulated, as in RLPD (Ball et al. 2023); 0 = none."""
    simulated_transitions: int = 200_000
    """Simulated transitions to draw it from, of the simulator's policy with more and more random actions."""
    simulated_ladder: float = 0.6
    """Share of random actions in the last of these episodes; it grows from 0 in the first."""
    ratio: bool = False
    """Weigh simulated rows by how much likelier they are in the real system than in the simulator, at most by 1, as
    H2O+ does. Two discriminators learn to tell real from simulated rows."""
    tune_alpha: bool = False
    """Let the temperature follow a target entropy of -1 nat per action dimension instead of staying at `alpha`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.share(self, "simulated_share", "simulated_ladder")
        checks.at_least(self, 1, "simulated_transitions")
        if self.ratio and not self.simulated_share:
            raise checks.refusal("ratio", True, "off where simulated-share is 0: it weighs simulated rows")


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner; without a prior it learns from nothing."""
    from sgft_jax.data import sources
    from sgft_jax.finetuner import sac_finetuner
    from sgft_jax.models.ratio import RatioConfig
    from sgft_jax.transforms import weigh

    simulated = round(config.simulated_share * config.batch_size) if prior is not None else 0
    source = sources.mixture(config.batch_size - simulated, simulated)
    weighs = (weigh(RatioConfig(task.obs_dim, task.act_dim)),) if config.ratio and simulated else ()
    return sac_finetuner(
        config, prior, task, transforms=weighs, weighted_actor=False, tune_alpha=config.tune_alpha,
        source=lambda state: source,
        simulation=Simulation(config.simulated_transitions, config.simulated_ladder) if simulated else None,
    )  # fmt: skip


METHOD = Method(
    "sac", "model-free", "SAC on the task reward, critic kept", "Haarnoja 2018", Config, build, needs_prior=False
)
