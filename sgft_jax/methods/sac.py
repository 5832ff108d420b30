"""SAC on the task reward: from the simulator's actor and critic, or in a simulator alone, without any real data."""

from dataclasses import dataclass

from sgft_jax import checks
from sgft_jax.methods.options import RowsOptions, agent_of
from sgft_jax.train.options import KeptCriticOptions, MixedOptions
from sgft_jax.types import Finetuner, Fixed, HybridAgent, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(KeptCriticOptions, MixedOptions):
    """Options of `sac`."""

    weighted_actor = False

    utd: float = 1.0
    """Gradient updates per real transition. One did better than eight wherever both were tried (docs/rules.md)."""
    simulated_share: float = 0.0
    """Share of each batch that is simulated, as in RLPD (Ball et al. 2023); 0 = none."""
    ratio: bool = False
    """Weigh simulated rows by how much likelier they are in the real system than in the simulator, at most by 1, as
    H2O+ does. Two discriminators learn to tell real from simulated rows."""
    tune_alpha: bool = False
    """Let the temperature follow a target entropy of -1 nat per action dimension instead of staying at `alpha`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.ratio and not self.simulated_share:
            raise checks.refusal("ratio", True, "off where simulated-share is 0: it weighs simulated rows")


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner; without a prior it learns from nothing."""
    from sgft_jax.models.ratio import RatioConfig
    from sgft_jax.train.finetuner import mixed_rows, sac_finetuner
    from sgft_jax.transforms import weigh

    source, simulation = mixed_rows(config, prior)
    weighs = (weigh(RatioConfig(task.obs_dim, task.act_dim)),) if config.ratio and simulation else ()
    return sac_finetuner(config, prior, task, transforms=weighs, source=lambda state: source, simulation=simulation)


@dataclass(frozen=True)
class SimulatorConfig(RowsOptions):
    """Options of `sac` in a simulator alone."""

    rows: int = 256
    """Simulated rows of a batch."""


def build_fixed(config: SimulatorConfig, task: Task) -> HybridAgent:
    """The agent: what the imperfect simulator is worth without any real data."""
    from sgft_jax.data import sources
    from sgft_jax.learners.sac import SACConfig, SACHyper, make_sac

    structure = SACConfig(task.obs_dim, task.act_dim, network=config.network, train_dynamics=False)
    learner = make_sac(structure, SACHyper.chosen(config))
    return agent_of(learner, config, task, sources.two_buffers(0, config.rows), simulates=True)


_ABOUT, _ABOUT_FIXED = "SAC on the task reward, critic kept", "SAC in the simulator alone"
METHOD = Method(
    "sac",
    Online("model-free", _ABOUT, "Haarnoja 2018", Config, build, needs_prior=False),
    Fixed("simulator", _ABOUT_FIXED, "Haarnoja et al. 2018", {"default": SimulatorConfig()}, build_fixed),
)
