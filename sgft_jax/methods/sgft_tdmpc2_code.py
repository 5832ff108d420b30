"""SGFT as its released code has it: TD-MPC2 from nothing, rewards shaped by draws of the simulator's value."""

from dataclasses import dataclass

from sgft_jax.methods import tdmpc2
from sgft_jax.types import Method, Online


@dataclass(frozen=True)
class Config(tdmpc2.PlannerOptions):
    """Options of `sgft-tdmpc2-code`."""

    shaped = True
    fresh = True

    horizon: int = 3


_ABOUT = "TD-MPC2 from nothing with shaped rewards"
_ONLINE = Online("sgft", _ABOUT, "SGFT 2025, released code", Config, tdmpc2.build, prior="tdmpc2", zero_shot=False)
METHOD = Method("sgft-tdmpc2-code", _ONLINE)
