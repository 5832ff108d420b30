"""MBPO: SAC that also learns from short branches of the dynamics ensemble."""

from dataclasses import dataclass

from sgft_jax.train.options import ModelOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(ModelOptions):
    """Options of `mbpo`."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.train.finetuner import sac_finetuner
    from sgft_jax.transforms import branch

    transforms = (branch(config.horizon, config.branches, noise=config.branch_noise, segments=False),)
    return sac_finetuner(config, prior, task, transforms=transforms)


METHOD = Method("mbpo", Online("model-based", "SAC with branches of the models", "Janner 2019", Config, build))
