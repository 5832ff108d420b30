"""SGFT-TDMPC-2: plans of H steps that end in a frozen V_sim; dynamics, reward and policy learn.

Source: SGFT (Yin et al., ICLR 2025), Algorithm 3.
"""

from dataclasses import dataclass

from sgft_jax.methods import tdmpc2
from sgft_jax.types import Method, Online


@dataclass(frozen=True)
class Config(tdmpc2.Config):
    """Options of `sgft-tdmpc2`."""

    sgft = True


_ABOUT = "TD-MPC2 whose plans of H steps end in a frozen V_sim"
_ONLINE = Online("sgft", _ABOUT, "SGFT 2025", Config, tdmpc2.build, prior="tdmpc2", zero_shot=False)
METHOD = Method("sgft-tdmpc2", _ONLINE)
