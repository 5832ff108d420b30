"""The actor alone learns, from the simulator's critic, which stays as it is."""

from dataclasses import dataclass

from sgft_jax.train.options import ActorOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(ActorOptions):
    """Options of `frozen-critic`."""

    train_critic = False


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.train.finetuner import sac_finetuner

    return sac_finetuner(config, prior, task)


METHOD = Method(
    "frozen-critic",
    Online("model-free", "the actor alone learns, from the simulator's critic", "SGFT 2025, reviews", Config, build),
)
