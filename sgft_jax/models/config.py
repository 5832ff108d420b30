"""Settings of networks. Imports neither JAX nor MuJoCo, so that commands can list them at once."""

from dataclasses import dataclass
from typing import Literal, get_args

from sgft_jax import checks

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
    """What follows each hidden layer."""

    def __post_init__(self) -> None:
        checks.layers(self, "hidden")
        checks.one_of(self, "activation", get_args(Activation))
