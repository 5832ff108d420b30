"""SGFT-SAC that bounds the task's rewards instead of the shaped ones, so V_sim is never cut."""

from dataclasses import dataclass

from sgft_jax.methods import sgft_sac
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(sgft_sac.Config):
    """Options of `sgft-first-clip`."""

    clip_shaped: float | None = 1.0
    """Bound of the task's rewards, before they are shaped; None = no bound."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.train.finetuner import sac_finetuner
    from sgft_jax.transforms import branch, clip, shape, shorten

    imagined = branch(config.horizon, config.branches, noise=config.branch_noise)
    transforms = (imagined, clip(config.clip_shaped), shape, shorten(config.horizon))
    return sac_finetuner(config, prior, task, transforms=transforms, horizon_dim=config.horizon, value_baseline=True)


METHOD = Method("sgft-first-clip", Online("sgft", "SGFT-SAC on bounded rewards of the task", "ours", Config, build))
