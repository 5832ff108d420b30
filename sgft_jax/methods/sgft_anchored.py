"""SGFT-SAC at real and simulated states that keeps what the simulator taught.

It first identifies how the real system takes commands and corrects them, so that the simulator's policy acts as in
simulation. Its actor pays for leaving that policy. Simulated states, relabelled by the models that real data correct,
are in every batch.
"""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.methods import sgft_relabel
from sgft_jax.types import Finetuner, Method, Prior, Simulation, Task


@dataclass(frozen=True)
class Config(sgft_relabel.Config):
    """Options of `sgft-anchored`."""

    anchor: float = 0.1
    """Price of the actor's divergence from the simulator's policy, in reward per nat; 0 = free."""
    identify: bool = True
    """Fit how commands move the end effector to the real rollouts, and correct the commands. Cartesian actions only."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.not_negative(self, "anchor")


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.data import sources
    from sgft_jax.finetuner import sac_finetuner
    from sgft_jax.identify import place_of
    from sgft_jax.transforms import branch, clip, relabel, shape, shorten

    source = sources.mixture(config.batch_size, config.batch_size)
    transforms = (
        relabel(source.n_real),
        branch(config.horizon, config.branches, noise=config.branch_noise),
        shape,
        clip(config.clip_shaped),
        shorten(config.horizon),
    )
    return sac_finetuner(
        config, prior, task, transforms=transforms, horizon_dim=config.horizon, reset_critic=config.reset_critic,
        value_baseline=True, source=lambda state: source,
        simulation=Simulation(config.simulated_transitions, config.simulated_ladder),
        actor_batch=source.n_real + source.n_sim if config.actor_real_only else None,
        anchored=config.anchor > 0, anchor=config.anchor, place=place_of(task) if config.identify else None,
    )  # fmt: skip


METHOD = Method(
    "sgft-anchored", "sgft", "SGFT held to the simulator's policy, behind corrected commands", "SGFT 2025, ours",
    Config, build,
)  # fmt: skip
