"""SAC on the task reward, from the simulator's actor and critic."""

from dataclasses import dataclass

from sgft_jax.methods.options import KeptCriticOptions
from sgft_jax.types import Finetuner, Method, Prior, Task


@dataclass(frozen=True)
class Config(KeptCriticOptions):
    """Options of `sac`."""

    tune_alpha: bool = False
    """Let the temperature follow a target entropy of -1 nat per action dimension instead of staying at `alpha`."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner; without a prior it learns from nothing."""
    from sgft_jax.finetuner import sac_finetuner

    return sac_finetuner(config, prior, task, tune_alpha=config.tune_alpha)


METHOD = Method(
    "sac", "model-free", "SAC on the task reward, critic kept", "Haarnoja 2018", Config, build, needs_prior=False
)
