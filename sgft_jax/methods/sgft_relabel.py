"""SGFT-SAC that also learns at the simulator's states, with what the fitted models expect there."""

from dataclasses import dataclass

from sgft_jax.methods import sgft_sac
from sgft_jax.train.options import SimulatedOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Simulation, Task


@dataclass(frozen=True)
class Config(sgft_sac.Config, SimulatedOptions):
    """Options of `sgft-relabel`."""

    weighted_actor = False

    critic_warmup: int | None = 0
    """Updates at the start in which the critic alone learns. The relabelled rows know of all kinds of actions from the
    first update on, so the actor need not wait."""
    simulated_transitions: int = 200_000
    """Simulated transitions, of the simulator's policy with more and more random actions. Each batch gets as many of
    them as it has real ones."""
    ratio: bool = False
    """Weigh rows that begin at the simulator's states by how much likelier their successors are in the real system than
    in the simulator, at most by 1, as H2O+ does. Two discriminators learn to tell real from simulated rows."""

    @property
    def actor_batch(self) -> int | None:
        """The simulator's states count as sampled rows, too."""
        return 2 * self.batch_size if self.actor_real_only else None


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.data import sources
    from sgft_jax.models.ratio import RatioConfig
    from sgft_jax.train.finetuner import sac_finetuner
    from sgft_jax.transforms import branch, clip, relabel, shape, shorten, weigh

    source = sources.mixture(config.batch_size, config.batch_size)
    transforms = (
        relabel(source.n_real),
        branch(config.horizon, config.branches, noise=config.branch_noise),
        *((weigh(RatioConfig(task.obs_dim, task.act_dim)),) if config.ratio else ()),
        shape,
        clip(config.clip_shaped),
        shorten(config.horizon),
    )
    return sac_finetuner(
        config,
        prior,
        task,
        transforms=transforms,
        horizon_dim=config.horizon,
        value_baseline=True,
        source=lambda state: source,
        simulation=Simulation(config.simulated_transitions, config.simulated_ladder),
    )


METHOD = Method(
    "sgft-relabel",
    Online("sgft", "SGFT-SAC that also learns at the simulator's states", "SGFT 2025, ours", Config, build),
)
