"""DARC: SAC in a simulator that pays less where it does what the real system would not.

The reward of simulated rows gains log w, the logarithm of the ratio of the dynamics; real rows train the discriminators
alone. Source: Eysenbach et al. 2021, with a fixed set of real data as in the baseline of H2O+ (Niu et al. 2023).
"""

from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
from flax import struct

from envs.types import Array, Key
from sgft_jax import checks
from sgft_jax.data import sources
from sgft_jax.learners.sac import SACConfig, SACHyper, SACState, make_sac
from sgft_jax.math import losses
from sgft_jax.models import ratio
from sgft_jax.models.config import NetworkConfig, two_layers
from sgft_jax.types import Batch, Learner, Metrics, Source


@dataclass(frozen=True)
class DARCConfig:
    """The structure of an agent. The defaults are those of the baseline of H2O+.

    obs_dim, act_dim: sizes of what the environment gives and takes.
    network: body of actor and critics; ratio_network: of the discriminators. ratio_noise: std of their training noise.
    ratio_rows: the last so many rows of a batch train the discriminators and nothing else; None = all rows train them.
    tune_alpha: follow the target entropy; False keeps the temperature.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=two_layers)
    ratio_network: NetworkConfig = field(default_factory=two_layers)
    ratio_noise: float = 0.1
    ratio_rows: int | None = None
    tune_alpha: bool = True

    def __post_init__(self) -> None:
        checks.at_least(self, 1, "ratio_rows")


class DARCState(struct.PyTreeNode):
    """An agent in training. sac: of the simulated rows. ratio: the discriminators. lr_ratio: [] their Adam rate."""

    sac: SACState
    ratio: ratio.RatioState
    lr_ratio: Array


def batches(rows: int = 256, ratio_rows: int = 256) -> Source:
    """Simulated rows for SAC, then real and as many simulated ones for the discriminators (`sources.two_buffers`).

    Its learner needs `DARCConfig.ratio_rows = 2 * ratio_rows`.
    """
    return sources.beside(sources.two_buffers(0, rows), sources.two_buffers(ratio_rows, ratio_rows))


def make_darc(config: DARCConfig, hyper: SACHyper | None = None, *, lr_ratio: float = 3e-4) -> Learner:
    """The learner of a configuration. Its batches must say which rows are simulated (`Batch.is_sim`)."""
    sizes = config.obs_dim, config.act_dim
    structure = SACConfig(
        *sizes, network=config.network, tune_alpha=config.tune_alpha, train_value=False, train_dynamics=False
    )
    sac = make_sac(structure, hyper)
    discriminators = ratio.make_ratio(ratio.RatioConfig(*sizes, config.ratio_network, noise=config.ratio_noise))

    def init(key: Key) -> DARCState:
        key_sac, key_ratio = jax.random.split(key)
        return DARCState(sac.init(key_sac), discriminators.init(key_ratio), jnp.float32(lr_ratio))

    def act(state: DARCState, carry: tuple[()], obs: Array, key: Key, **options: Any) -> tuple[Array, tuple[()]]:
        return sac.act(state.sac, carry, obs, key, **options)

    def update(state: DARCState, batch: Batch, key: Key) -> tuple[DARCState, Metrics]:
        key_ratio, key_sac = jax.random.split(key)
        batch, for_ratio = ratio.split_rows(batch, config.ratio_rows)
        fit, log_w, metrics = ratio.step(discriminators, state.ratio, batch, for_ratio, key_ratio, rate=state.lr_ratio)
        agent, of_sac = sac.update(state.sac, paid(batch, log_w), key_sac)
        return state.replace(sac=agent, ratio=fit), metrics | of_sac

    return Learner(init, lambda: (), act, update)


def paid(batch: Batch, log_w: Array) -> Batch:
    """The simulated rows of a batch with rewards r + log w; the real rows do not count. log_w: [B].

    Source: Eysenbach et al. 2021.
    """
    return batch._replace(reward=batch.reward + log_w, valid=losses.sim_rows(batch))
