"""Model-free SGFT: shaped rewards over segments of H steps, no models."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.train.options import ShapedOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(ShapedOptions):
    """Options of `sgft`."""

    horizon: int = 1
    """Steps of a segment, the paper's H."""
    lr_warmup: int | None = 0
    """Updates over which the critic's learning rate rises from 0. V_sim stands at the end of every segment and
    protects the critic already."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.few(self, 1, "horizon")


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.train.finetuner import sac_finetuner
    from sgft_jax.transforms import clip, shape, shorten

    transforms = (shape, clip(config.clip_shaped), shorten(config.horizon))
    return sac_finetuner(config, prior, task, transforms=transforms, horizon_dim=config.horizon, value_baseline=True)


METHOD = Method("sgft", Online("sgft", "shaped rewards over short horizons, no models", "SGFT 2025", Config, build))
