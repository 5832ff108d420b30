"""Potential-based reward shaping: SAC with rewards shaped by V_sim over the infinite horizon."""

from dataclasses import dataclass

from sgft_jax.train.options import ShapedOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(ShapedOptions):
    """Options of `pbrs`."""

    clip_shaped: float | None = None
    """Bound on the shaped reward; None = no bound, as published. A bound breaks the invariance of the best policy."""
    reset_critic: bool = False
    """Start from a new critic, as in the SGFT paper; False keeps the simulator's, read as Q(s, a) - V_sim(s), and did
    better in tuning (docs/rules.md)."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.train.finetuner import sac_finetuner
    from sgft_jax.transforms import clip, shape

    transforms = (shape, clip(config.clip_shaped))
    return sac_finetuner(config, prior, task, transforms=transforms, value_baseline=True)


METHOD = Method(
    "pbrs", Online("model-free", "SAC on shaped rewards, infinite horizon, critic kept", "Ng 1999", Config, build)
)
