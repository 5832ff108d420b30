"""What describes a network, as data. Command lines read this module, so it imports neither JAX nor Flax."""

from dataclasses import dataclass
from typing import Literal

from sgft_jax.types import UserError

type Precision = Literal["default", "float32", "bfloat16"]
Activation = Literal["relu", "tanh", "silu", "elu"]


@dataclass(frozen=True)
class NetworkConfig:
    """The body shared by all networks of a run."""

    hidden: tuple[int, ...] = (512, 512)
    """Widths of the hidden layers."""
    layer_norm: bool = False
    """LayerNorm after each linear layer of critic and value, before the activation (RLPD)."""
    actor_layer_norm: bool = False
    """The same in the actor."""
    activation: Activation = "relu"

    def __post_init__(self) -> None:
        if not self.hidden or min(self.hidden) < 1:
            raise UserError(f"network option hidden is {self.hidden}: name one or more widths, each at least 1")
        if self.activation not in Activation.__args__:
            raise UserError(f"network activation {self.activation!r}: choose one of {', '.join(Activation.__args__)}")
