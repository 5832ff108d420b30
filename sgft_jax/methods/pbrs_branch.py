"""Shaped rewards and model branches over the infinite horizon, with a new critic."""

from dataclasses import dataclass

from sgft_jax.train.options import ModelOptions, ShapedOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(ModelOptions, ShapedOptions):
    """Options of `pbrs-branch`."""

    reset_critic: bool = True
    """Start from a new critic; False keeps the simulator's, read as Q(s, a) - V_sim(s)."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.train.finetuner import sac_finetuner
    from sgft_jax.transforms import branch, clip, shape

    imagined = branch(config.horizon, config.branches, noise=config.branch_noise, segments=False)
    transforms = (imagined, shape, clip(config.clip_shaped))
    return sac_finetuner(config, prior, task, transforms=transforms, value_baseline=True)


METHOD = Method(
    "pbrs-branch",
    Online("model-based", "shaped rewards and branches, infinite horizon, new critic", "SGFT 2025", Config, build),
)
