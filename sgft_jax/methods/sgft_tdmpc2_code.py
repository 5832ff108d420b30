"""SGFT as its released code has it: TD-MPC2 from nothing, rewards shaped by draws of the simulator's value."""

from dataclasses import dataclass

from sgft_jax.methods import tdmpc2
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(tdmpc2.PlannerOptions):
    """Options of `sgft-tdmpc2-code`."""

    horizon: int = 3
    """Steps of a plan and of a training window."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    return tdmpc2.planner(config, prior, task, shaped=True, fresh=True)


METHOD = Method(
    "sgft-tdmpc2-code",
    Online(
        "sgft",
        "TD-MPC2 from nothing with shaped rewards",
        "SGFT 2025, released code",
        Config,
        build,
        prior="tdmpc2",
        zero_shot=False,
    ),
)
