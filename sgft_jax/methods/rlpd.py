"""RLPD: SAC from nothing with ten normalised critics; half of each batch is simulated."""

from dataclasses import dataclass, field

from sgft_jax import checks
from sgft_jax.models.config import NetworkConfig
from sgft_jax.train.options import SACOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Simulation, Task


@dataclass(frozen=True)
class Config(SACOptions):
    """Options of `rlpd`; defaults of Ball et al. 2023, except for `alpha`, `lr_critic` and `target_critics`.

    The paper has a critic rate of 3e-4 and targets from the minimum of two critics; tuning changed both
    (docs/protocol.md). `alpha`: see there.
    """

    utd: float = 20.0
    """Gradient updates per real transition."""
    lr_actor: float = 3e-4
    """Adam learning rate of the actor."""
    lr_critic: float = 1e-3
    """Adam learning rate of the critic."""
    alpha: float = 0.01
    """Entropy temperature at the start; it follows a target of -0.5 nats per action dimension. RLPD starts at 1, from
    which a few thousand updates do not bring it down; 0.01 is what real robots use (SERL, Luo et al. 2024)."""
    policy_delay: int | None = None
    """Critic updates per update of the actor; None = `utd`, one actor update per real transition."""
    critic_warmup: int | None = 0
    """Updates at the start in which the critic alone learns."""
    actor_ramp: int = 0
    """Updates over which the actor's learning rate rises from 0."""
    critics: int = 10
    """Members of the critic ensemble."""
    target_critics: int = 1
    """Random members whose minimum is a target."""
    critic_network: NetworkConfig = field(default_factory=lambda: NetworkConfig(hidden=(256, 256), layer_norm=True))
    """Body of the critic. LayerNorm tames extrapolation on little data."""
    simulated_share: float = 0.5
    """Share of each batch that is simulated."""
    simulated_transitions: int = 200_000
    """Simulated transitions, of the simulator's policy with more and more random actions."""
    simulated_ladder: float = 0.6
    """Share of random actions in the last of these episodes; it grows from 0 in the first."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.share(self, "simulated_share", "simulated_ladder")
        checks.at_least(self, 1, "simulated_transitions")


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner; without a prior it learns from real data alone."""
    from sgft_jax.data import sources
    from sgft_jax.train.finetuner import sac_finetuner

    simulated = round(config.simulated_share * config.batch_size) if prior is not None else 0
    source = sources.mixture(config.batch_size - simulated, simulated)
    return sac_finetuner(
        config,
        prior,
        task,
        fresh=True,
        source=lambda state: source,
        simulation=Simulation(config.simulated_transitions, config.simulated_ladder) if simulated else None,
        critic_network=config.critic_network,
        critics=config.critics,
        target_critics=config.target_critics,
        actor_mean=True,
        tune_alpha=True,
        entropy_per_dim=-0.5,
    )


METHOD = Method(
    "rlpd",
    Online(
        "model-free",
        "from nothing; ten normalised critics, half of each batch simulated",
        "Ball 2023",
        Config,
        build,
        needs_prior=False,
        zero_shot=False,
    ),
)
