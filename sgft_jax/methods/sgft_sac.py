"""SGFT-SAC: model branches from real states, rewards shaped by V_sim, horizons of H steps.

What the parts do is in `sgft_jax/transforms.py`. Source: SGFT (Yin et al., ICLR 2025), Algorithm 2 and Appendix C. The
paper has H = 1, a new critic, no noise, no clipping and no warm-up. Here H = 4 with two branches, because with H = 1
the agent never takes a step that costs V_sim now and pays later, and the critic is kept (docs/lessons.md).
"""

from dataclasses import dataclass

from sgft_jax.train.options import ModelOptions, ShapedOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(ModelOptions, ShapedOptions):
    """Options of `sgft-sac`."""

    horizon: int = 4
    """Steps of a segment and of an imagined branch, the paper's H (there 1)."""
    branches: int = 2
    lr_warmup: int | None = 0
    """Updates over which the critic's learning rate rises from 0. V_sim stands at the end of every segment and
    protects the critic already; warm-up and shortening are substitutes."""
    reset_critic: bool = False
    """Start from a new critic, as in the paper; False keeps the simulator's, read as Q(s, a) - V_sim(s)."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.train.finetuner import sac_finetuner
    from sgft_jax.transforms import branch, clip, shape, shorten

    transforms = (
        branch(config.horizon, config.branches, noise=config.branch_noise),
        shape,
        clip(config.clip_shaped),
        shorten(config.horizon),
    )
    return sac_finetuner(config, prior, task, transforms=transforms, horizon_dim=config.horizon, value_baseline=True)


METHOD = Method(
    "sgft-sac", Online("sgft", "branches of the models, shaped rewards, short horizons", "SGFT 2025", Config, build)
)
