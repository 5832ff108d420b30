"""SGFT-SAC with each of its parts on or off and all else equal, for `experiments.studies.factorial`.

What a kept critic means depends on the parts. Shaped, it is read as Q(s, a) - V_sim(s), which is exact in simulation.
Unshaped, it is the simulator's Q. Unshaped and shortened, it begins too high, because it promises what comes after the
segment too; that is a property of shortening without V_sim, and stays as it is.
"""

from dataclasses import dataclass

from sgft_jax.train.options import ModelOptions
from sgft_jax.types import Finetuner, Method, Online, Prior, Task


@dataclass(frozen=True)
class Config(ModelOptions):
    """Options of `sgft-parts`."""

    shape: bool = True
    """Rewards are r + gamma V_sim(s') - V_sim(s), never clipped: a bound would break what shaping keeps."""
    shorten: bool = True
    """Segments end after `horizon` steps."""
    reset_critic: bool = False
    """Start from a new critic; False keeps the simulator's."""


def build(config: Config, prior: Prior | None, task: Task) -> Finetuner:
    """The finetuner."""
    from sgft_jax.train.finetuner import sac_finetuner
    from sgft_jax.transforms import branch, shape, shorten

    imagined = branch(config.horizon, config.branches, noise=config.branch_noise, segments=config.shorten)
    shaped, short = (shape,) * config.shape, (shorten(config.horizon),) * config.shorten
    return sac_finetuner(
        config,
        prior,
        task,
        transforms=(imagined, *shaped, *short),
        horizon_dim=config.horizon if config.shorten else 0,
        value_baseline=config.shape,
    )


_ABOUT = "SGFT-SAC with shaping and shortening on or off, for comparisons"
METHOD = Method("sgft-parts", Online("sgft", _ABOUT, "SGFT 2025", Config, build))
