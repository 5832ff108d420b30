"""MBPO on shaped rewards: model branches, V_sim as a potential over the infinite horizon, critic kept."""

from dataclasses import dataclass

from sgft_jax.methods.options import ModelOptions
from sgft_jax.types import Finetuner, Method, Prior, Task


@dataclass(frozen=True)
class Config(ModelOptions):
    """Options of `mbpo-shaped`."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.finetuner import sac_finetuner
    from sgft_jax.transforms import branch, shape

    branches = branch(config.horizon, config.branches, noise=config.branch_noise, segments=False)
    rows = config.batch_size if config.actor_real_only else None
    return sac_finetuner(config, prior, task, transforms=(branches, shape), value_baseline=True, actor_batch=rows)


METHOD = Method("mbpo-shaped", "model-based", "MBPO on shaped rewards", "Ng 1999, Janner 2019", Config, build)
