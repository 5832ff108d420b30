"""The actor alone learns, from the simulator's critic, which stays as it is."""

import dataclasses
from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.train.options import LoopOptions, SACOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(LoopOptions):
    """Options of `frozen-critic`."""

    lr_actor: float = 1e-4
    """Adam learning rate of the actor."""
    alpha: float = 0.01
    """Entropy temperature."""
    actor_ramp: int = 1000
    """Updates over which the actor's learning rate rises from 0."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.positive(self, "lr_actor", "alpha")
        checks.not_negative(self, "actor_ramp")


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.train.finetuner import sac_finetuner

    options = SACOptions(**dataclasses.asdict(config), critic_warmup=0)
    return sac_finetuner(options, prior, task, train_critic=False)


METHOD = Method(
    "frozen-critic",
    Online("model-free", "the actor alone learns, from the simulator's critic", "SGFT 2025, reviews", Config, build),
)
