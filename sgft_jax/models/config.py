"""What describes a network, as data. Command lines read this module, so it imports neither JAX nor Flax."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

from envs.types import UserError, unknown
from sgft_jax import checks

__all__ = ["NetworkConfig"]

type Precision = Literal["default", "float32", "bfloat16"]
Activation = Literal["relu", "tanh", "silu", "elu"]


@dataclass(frozen=True)
class NetworkConfig(checks.Checked):
    """The body shared by all networks of a run."""

    hidden: checks.Layers = (512, 512)
    """Widths of the hidden layers."""
    layer_norm: bool = False
    """LayerNorm after each linear layer of critic and value, before the activation (RLPD)."""
    actor_layer_norm: bool = False
    """The same in the actor."""
    activation: Activation = "relu"
    blind: Annotated[int, checks.least(0), checks.few] = 0
    """Entries at the end of the observation that SAC's actor does not see; pretraining's blind-actor sets it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.activation not in (known := get_args(Activation)):
            raise UserError(unknown("activation", self.activation, known))


def network_of(card: Mapping[str, Any], name: str = "network") -> NetworkConfig:
    """The networks of a prior of SAC; raises UserError where this version knows no such network.

    name: "critic_network" for its critic's, which are the same where the card says nothing else.
    """
    described = card.get(name) or card["network"]
    try:
        fields: dict[str, Any] = {**described, "hidden": tuple(described["hidden"])}
        return NetworkConfig(**fields)
    except (TypeError, KeyError):
        raise UserError(f"this version knows no such network: {described}; pretrain again") from None


def two_layers() -> NetworkConfig:
    """Two hidden layers of 256 units: the networks of H2O, H2O+ and their baselines."""
    return NetworkConfig((256, 256))


@dataclass(frozen=True)
class Size:
    """Widths of the networks of TD-MPC2.

    encoder: hidden layers of the encoder, which has `encoder_layers` linear layers. mlp: the two hidden layers of every
    other network. latent: entries of the latent state. members: heads of the critic.
    """

    encoder: int = 256
    mlp: int = 512
    latent: int = 512
    encoder_layers: int = 2
    members: int = 5


SIZES = {  # by their published number of parameters
    "1M": Size(256, 384, 128, 2, 2),
    "5M": Size(256, 512, 512, 2, 5),
    "19M": Size(1024, 1024, 768, 3, 5),
    "48M": Size(1792, 1792, 768, 4, 5),
    "317M": Size(4096, 4096, 1376, 5, 8),
}
