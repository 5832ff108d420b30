"""SAC from kept networks and simulated data, with many critic updates for each slow actor update."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.train.options import KeptCriticOptions, MixedOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Simulation, Source, Task


@dataclass(frozen=True)
class Config(KeptCriticOptions, MixedOptions):
    """Options of `sac-online`; defaults of As et al. 2026, with four changes that tuning made (docs/rules.md).

    The paper has 5 updates per transition, actor and critic rates of 1e-5 and 3e-4, and no `lr_warmup`.
    """

    actor_mean = True

    utd: float = 2.0
    lr_actor: float = 3e-5
    lr_critic: float = 1e-3
    policy_delay: int | None = 20
    critic_warmup: int | None = 0
    actor_ramp: int = 0
    simulated_share: float = 0.5
    """Share of each batch that is simulated, at the start."""
    simulated_share_end: checks.Share = 0.0
    """The same after `simulated_anneal` updates; it changes linearly."""
    simulated_anneal: checks.Count = 10_000
    """Updates over which the share changes."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    import jax.numpy as jnp

    from sgft_jax.data import sources
    from sgft_jax.train.finetuner import FinetuneState, sac_finetuner

    both = sources.mixture(config.batch_size, config.batch_size)

    def source(state: FinetuneState) -> Source:
        passed = jnp.minimum(state.learner.step / config.simulated_anneal, 1.0)
        change = config.simulated_share_end - config.simulated_share
        return sources.blend(both, config.simulated_share + change * passed)

    simulation = Simulation(config.simulated_transitions, config.simulated_ladder)
    return sac_finetuner(config, prior, task, source=source, simulation=simulation)


_ABOUT = "SAC from kept networks and simulated data, slow actor"
METHOD = Method("sac-online", Online("model-free", _ABOUT, "As 2026", Config, build))
