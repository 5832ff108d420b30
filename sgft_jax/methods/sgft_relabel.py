"""SGFT-SAC that also learns at the simulator's states, with what the fitted models expect there."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.methods import sgft_sac
from sgft_jax.types import Finetuner, Method, Online, Prior, Simulation, Task


@dataclass(frozen=True)
class Config(sgft_sac.Config):
    """Options of `sgft-relabel`."""

    critic_warmup: int | None = 0
    """Updates at the start in which the critic alone learns. The relabelled rows know of all kinds of actions from the
    first update on, so the actor need not wait."""
    simulated_transitions: int = 200_000
    """Simulated transitions, of the simulator's policy with more and more random actions. Each batch gets as many of
    them as it has real ones."""
    simulated_ladder: float = 0.6
    """Share of random actions in the last of these episodes; it grows from 0 in the first."""
    ratio: bool = False
    """Weigh rows that begin at the simulator's states by how much likelier their successors are in the real system than
    in the simulator, at most by 1, as H2O+ does. Two discriminators learn to tell real from simulated rows."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.share(self, "simulated_ladder")
        checks.at_least(self, 1, "simulated_transitions")


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
        config, prior, task, transforms=transforms, horizon_dim=config.horizon, reset_critic=config.reset_critic,
        value_baseline=True, source=lambda state: source,
        simulation=Simulation(config.simulated_transitions, config.simulated_ladder),
        actor_batch=source.n_real + source.n_sim if config.actor_real_only else None,
        weighted_actor=False,
    )  # fmt: skip


METHOD = Method(
    "sgft-relabel",
    Online("sgft", "SGFT-SAC that also learns at the simulator's states", "SGFT 2025, ours", Config, build),
)
