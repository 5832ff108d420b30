"""SGFT-TDMPC-2: plans of H steps that end in a frozen V_sim; dynamics, reward and policy learn.

Source: SGFT (Yin et al., ICLR 2025), Algorithm 3.
"""

from dataclasses import dataclass

from sgft_jax.methods import tdmpc2
from sgft_jax.types import Finetuner, Method, Prior, Task


@dataclass(frozen=True)
class Config(tdmpc2.Config):
    """Options of `sgft-tdmpc2`."""

    train_encoder: bool = False
    """Let the encoder learn too; V_sim then changes with it (an ablation)."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    return tdmpc2.planner(config, prior, task, sgft=True, train_encoder=config.train_encoder)


METHOD = Method(
    "sgft-tdmpc2", "sgft", "TD-MPC2 whose plans of H steps end in a frozen V_sim", "SGFT 2025", Config, build,
    prior="tdmpc2",
)  # fmt: skip
