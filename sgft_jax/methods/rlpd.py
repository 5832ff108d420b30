"""RLPD: SAC from nothing with ten normalised critics; half of each batch is simulated."""

from dataclasses import dataclass, field

from sgft_jax.models.config import NetworkConfig
from sgft_jax.train.options import MixedOptions, SACOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(SACOptions, MixedOptions):
    """Options of `rlpd`; defaults of Ball et al. 2023, except for `alpha`, `lr_critic` and `target_critics`.

    The paper has a critic rate of 3e-4 and targets from the minimum of two critics; tuning changed both
    (docs/rules.md). `alpha`: see there.
    """

    fresh = True
    actor_mean = True
    tune_alpha = True
    entropy_per_dim = -0.5

    utd: float = 20.0
    lr_actor: float = 3e-4
    lr_critic: float = 1e-3
    alpha: float = 0.01
    """Entropy temperature at the start; it follows a target of -0.5 nats per action dimension. RLPD starts at 1, from
    which a few thousand updates do not bring it down; 0.01 is what real robots use (SERL, Luo et al. 2024)."""
    policy_delay: int | None = None
    critic_warmup: int | None = 0
    actor_ramp: int = 0
    critics: int = 10
    """Members of the critic ensemble."""
    target_critics: int = 1
    """Random members whose minimum is a target."""
    critic_network: NetworkConfig = field(default_factory=lambda: NetworkConfig(hidden=(256, 256), layer_norm=True))
    """Body of the critic. LayerNorm tames extrapolation on little data."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner; without a prior it learns from real data alone."""
    from sgft_jax.train.finetuner import mixed_rows, sac_finetuner

    source, simulation = mixed_rows(config, prior)
    return sac_finetuner(config, prior, task, source=lambda state: source, simulation=simulation)


_ABOUT = "from nothing; ten normalised critics, half of each batch simulated"
METHOD = Method("rlpd", Online("model-free", _ABOUT, "Ball 2023", Config, build, needs_prior=False, zero_shot=False))
