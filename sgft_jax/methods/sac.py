"""SAC on the task reward: from the simulator's actor and critic, or in a simulator alone, without any real data."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.methods.options import ActorCriticOptions, agent_of, sac_numbers
from sgft_jax.train.options import KeptCriticOptions
from sgft_jax.types import Finetuner, Fixed, HybridAgent, Method, Online, Prior, Simulation, Task


@dataclass(frozen=True)
class Config(KeptCriticOptions):
    """Options of `sac`."""

    utd: float = 1.0
    """Gradient updates per real transition. One did better than eight wherever both were tried (docs/protocol.md)."""
    simulated_share: float = 0.0
    """Share of each batch that is simulated, as in RLPD (Ball et al. 2023); 0 = none."""
    simulated_transitions: int = 200_000
    """Simulated transitions to draw it from, of the simulator's policy with more and more random actions."""
    simulated_ladder: float = 0.6
    """Share of random actions in the last of these episodes; it grows from 0 in the first."""
    ratio: bool = False
    """Weigh simulated rows by how much likelier they are in the real system than in the simulator, at most by 1, as
    H2O+ does. Two discriminators learn to tell real from simulated rows."""
    tune_alpha: bool = False
    """Let the temperature follow a target entropy of -1 nat per action dimension instead of staying at `alpha`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.share(self, "simulated_share", "simulated_ladder")
        checks.at_least(self, 1, "simulated_transitions")
        if self.ratio and not self.simulated_share:
            raise checks.refusal("ratio", True, "off where simulated-share is 0: it weighs simulated rows")


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner; without a prior it learns from nothing."""
    from sgft_jax.data import sources
    from sgft_jax.models.ratio import RatioConfig
    from sgft_jax.train.finetuner import sac_finetuner
    from sgft_jax.transforms import weigh

    simulated = round(config.simulated_share * config.batch_size) if prior is not None else 0
    source = sources.mixture(config.batch_size - simulated, simulated)
    weighs = (weigh(RatioConfig(task.obs_dim, task.act_dim)),) if config.ratio and simulated else ()
    return sac_finetuner(
        config, prior, task, transforms=weighs, weighted_actor=False, tune_alpha=config.tune_alpha,
        source=lambda state: source,
        simulation=Simulation(config.simulated_transitions, config.simulated_ladder) if simulated else None,
    )  # fmt: skip


@dataclass(frozen=True)
class SimulatorConfig(ActorCriticOptions):
    """Options of `sac` in a simulator alone."""

    rows: int = 256
    """Simulated rows of a batch."""

    def __post_init__(self) -> None:
        super().__post_init__()
        checks.rows(self, "rows")


def build_fixed(config: SimulatorConfig, task: Task) -> HybridAgent:
    """The agent: what the imperfect simulator is worth without any real data."""
    from sgft_jax.data import sources
    from sgft_jax.learners.sac import SACConfig, make_sac
    from sgft_jax.models.config import NetworkConfig

    structure = SACConfig(
        task.obs_dim, task.act_dim, network=NetworkConfig(config.hidden), train_value=False, train_dynamics=False
    )
    learner = make_sac(structure, sac_numbers(config))
    return agent_of(learner, config, task, sources.two_buffers(0, config.rows), simulates=True)


METHOD = Method(
    "sac",
    Online("model-free", "SAC on the task reward, critic kept", "Haarnoja 2018", Config, build, needs_prior=False),
    Fixed(
        "simulator",
        "SAC in the simulator alone",
        "Haarnoja et al. 2018",
        {"default": SimulatorConfig()},
        build_fixed,
    ),
)
