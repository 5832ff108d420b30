"""What describes a network, as data. Command lines read this module, so it imports neither JAX nor Flax."""

from dataclasses import dataclass
from typing import Literal, get_args

from sgft_jax import checks
from sgft_jax.types import UserError, unknown

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
        checks.layers(self, "hidden")
        if self.activation not in (known := get_args(Activation)):
            raise UserError(unknown("activation", self.activation, known))


def two_layers() -> NetworkConfig:
    """Two hidden layers of 256 units: the networks of H2O, H2O+ and their baselines."""
    return NetworkConfig((256, 256))
