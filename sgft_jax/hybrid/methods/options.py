"""Options that methods share, each with its help. Imports no JAX: command lines read it."""

from dataclasses import dataclass

from sgft_jax import checks


@dataclass(frozen=True)
class ActorCriticOptions:
    """Options of soft actor-critics; the defaults are those of H2O+'s released code."""

    lr: float = 3e-4
    """Adam learning rate of every network."""
    tau: float = 0.005
    """Averaging rate of the target critics."""
    hidden: tuple[int, ...] = (256, 256)
    """Widths of the hidden layers of actor, critics and value."""
    gamma: float = 0.99
    """Discount factor per control step."""

    def __post_init__(self) -> None:
        checks.positive(self, "lr")
        checks.share(self, "tau")
        checks.layers(self, "hidden")
        checks.below_one(self, "gamma")
