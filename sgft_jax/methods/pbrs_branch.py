"""Shaped rewards and model branches over the infinite horizon, with a new critic."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.train.options import ModelOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(ModelOptions):
    """Options of `pbrs-branch`."""

    clip_shaped: float | None = 2.0
    """Bound on the shaped reward; None = no bound."""
    reset_critic: bool = True
    """Start from a new critic; False keeps the simulator's, read as Q(s, a) - V_sim(s)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.positive(self, "clip_shaped")


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.train.finetuner import sac_finetuner
    from sgft_jax.transforms import branch, clip, shape

    imagined = branch(config.horizon, config.branches, noise=config.branch_noise, segments=False)
    return sac_finetuner(
        config, prior, task, transforms=(imagined, shape, clip(config.clip_shaped)), reset_critic=config.reset_critic,
        value_baseline=True, actor_batch=config.batch_size if config.actor_real_only else None,
    )  # fmt: skip


METHOD = Method(
    "pbrs-branch",
    Online("model-based", "shaped rewards and branches, infinite horizon, new critic", "SGFT 2025", Config, build),
)
