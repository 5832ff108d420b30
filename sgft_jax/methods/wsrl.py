"""WSRL: SAC goes on from the simulator's actor and critic, after rollouts of the simulator's policy, on these alone.

Source: Zhou et al. 2024 (arXiv 2412.07762), without their offline pretraining: the simulator's twin critics stand for
their ten. They warm up for 5,000 steps, which are 100 rollouts and more here.
"""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.train.options import SACOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(SACOptions):
    """Options of `wsrl`; defaults of Zhou et al. 2024, but for `initial_rollouts`."""

    tune_alpha = True
    entropy_per_dim = 0.0

    utd: float = 4.0
    batch_size: checks.Count = 1024
    initial_rollouts: checks.Count = 5
    """Real rollouts of the simulator's policy before the first update."""
    critic_warmup: int | None = 0
    policy_delay: int | None = None
    actor_ramp: int = 0


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.train.finetuner import sac_finetuner

    return sac_finetuner(config, prior, task)


METHOD = Method("wsrl", Online("model-free", "SAC warm-started by the simulator's policy", "Zhou 2024", Config, build))
