"""The actor alone learns, from the simulator's critic, which stays as it is."""

from dataclasses import dataclass

from sgft_jax.methods.options import SACOptions
from sgft_jax.types import Finetuner, Method, Prior, Task


@dataclass(frozen=True)
class Config(SACOptions):
    """Options of `frozen-critic`."""

    critic_warmup: int | None = 0
    """Updates at the start before the actor moves; the critic never does."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.finetuner import sac_finetuner

    return sac_finetuner(config, prior, task, train_critic=False)


METHOD = Method(
    "frozen-critic", "model-free", "the actor alone learns, from the simulator's critic", "SGFT 2025, reviews", Config,
    build,
)  # fmt: skip
