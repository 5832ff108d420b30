"""SAC from kept networks and simulated data, with many critic updates for each slow actor update."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.train.options import KeptCriticOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Simulation, Task


@dataclass(frozen=True)
class Config(KeptCriticOptions):
    """Options of `sac-online`; defaults of As et al. 2026, with four changes that tuning made (docs/protocol.md).

    The paper has 5 updates per transition, actor and critic rates of 1e-5 and 3e-4, and no `lr_warmup`.
    """

    utd: float = 2.0
    """Gradient updates per real transition."""
    lr_actor: float = 3e-5
    """Adam learning rate of the actor."""
    lr_critic: float = 1e-3
    """Adam learning rate of the critic."""
    policy_delay: int | None = 20
    """Critic updates per update of the actor; None = `utd`."""
    critic_warmup: int | None = 0
    """Updates at the start in which the critic alone learns."""
    actor_ramp: int = 0
    """Updates over which the actor's learning rate rises from 0."""
    simulated_share: float = 0.5
    """Share of each batch that is simulated, at the start."""
    simulated_share_end: float = 0.0
    """The same after `simulated_anneal` updates; it changes linearly."""
    simulated_anneal: int = 10_000
    """Updates over which the share changes."""
    simulated_transitions: int = 200_000
    """Simulated transitions, of the simulator's policy with more and more random actions."""
    simulated_ladder: float = 0.6
    """Share of random actions in the last of these episodes; it grows from 0 in the first."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.share(self, "simulated_share", "simulated_share_end", "simulated_ladder")
        checks.at_least(self, 1, "simulated_anneal", "simulated_transitions")


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    import jax.numpy as jnp

    from sgft_jax.data import sources
    from sgft_jax.train.finetuner import FinetuneState, sac_finetuner
    from sgft_jax.types import Source

    both = sources.mixture(config.batch_size, config.batch_size)

    def source(state: FinetuneState) -> Source:
        passed = jnp.minimum(state.learner.step / config.simulated_anneal, 1.0)
        change = config.simulated_share_end - config.simulated_share
        return sources.blend(both, config.simulated_share + change * passed)

    simulation = Simulation(config.simulated_transitions, config.simulated_ladder)
    return sac_finetuner(config, prior, task, source=source, simulation=simulation, actor_mean=True)


METHOD = Method(
    "sac-online",
    Online("model-free", "SAC from kept networks and simulated data, slow actor", "As 2026", Config, build),
)
