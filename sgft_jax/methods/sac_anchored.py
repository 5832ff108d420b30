"""SAC from the simulator's actor and critic that keeps what the simulator taught: its data, its policy as an anchor.

Half of each batch is simulated, as in RLPD (Ball et al. 2023). The actor pays for its divergence from the simulator's
policy, as in KL-regularised control (Todorov 2006).
"""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.methods.options import KeptCriticOptions
from sgft_jax.types import Finetuner, Method, Prior, Simulation, Task


@dataclass(frozen=True)
class Config(KeptCriticOptions):
    """Options of `sac-anchored`."""

    anchor: float = 0.1
    """Price of the actor's divergence from the simulator's policy, in reward per nat; 0 = free."""
    identify: bool = False
    """Fit how commands move the end effector to the real rollouts, and correct the commands. Cartesian actions only."""
    simulated_share: float = 0.5
    """Share of each batch that is simulated."""
    simulated_transitions: int = 200_000
    """Simulated transitions, of the simulator's policy with more and more random actions."""
    simulated_ladder: float = 0.6
    """Share of random actions in the last of these episodes; it grows from 0 in the first."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.not_negative(self, "anchor")
        checks.share(self, "simulated_share", "simulated_ladder")
        checks.at_least(self, 1, "simulated_transitions")


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.data import sources
    from sgft_jax.finetuner import sac_finetuner
    from sgft_jax.identify import place_of

    simulated = round(config.simulated_share * config.batch_size)
    source = sources.mixture(config.batch_size - simulated, simulated)
    return sac_finetuner(
        config, prior, task, source=lambda state: source, anchored=config.anchor > 0, anchor=config.anchor,
        place=place_of(task) if config.identify else None,
        simulation=Simulation(config.simulated_transitions, config.simulated_ladder) if simulated else None,
    )  # fmt: skip


METHOD = Method(
    "sac-anchored", "model-free", "SAC with simulated rows, held to the simulator's policy", "Ball 2023, Todorov 2006",
    Config, build,
)  # fmt: skip
