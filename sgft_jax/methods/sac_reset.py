"""SAC on the task reward, from the simulator's actor and a new critic."""

from dataclasses import dataclass

from sgft_jax.train.options import SACOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(SACOptions):
    """Options of `sac-reset`."""

    reset_critic = True


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.train.finetuner import sac_finetuner

    return sac_finetuner(config, prior, task)


METHOD = Method("sac-reset", Online("model-free", "SAC on the task reward, new critic", "Haarnoja 2018", Config, build))
