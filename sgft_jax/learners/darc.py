"""DARC: SAC in a simulator that pays less where it does what the real system would not.

The reward of simulated rows gains log w, the logarithm of the ratio of the dynamics; real rows train the discriminators
alone. Source: Eysenbach et al. 2021, with a fixed set of real data as in the baseline of H2O+ (Niu et al. 2023).
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
from flax import struct

from envs.types import Array, Key
from sgft_jax.data import sources
from sgft_jax.learners import sac
from sgft_jax.learners.mixed import MixedConfig
from sgft_jax.learners.sac import SACConfig, SACHyper, SACState
from sgft_jax.math import losses
from sgft_jax.models import ratio
from sgft_jax.types import Batch, Learner, Metrics, Source

__all__ = ["DARCConfig", "DARCState", "act", "batches", "init", "make_darc", "paid", "update"]


@dataclass(frozen=True)
class DARCConfig(MixedConfig):
    """The structure of an agent. The defaults are those of the baseline of H2O+."""


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


def paid(batch: Batch, log_w: Array) -> Batch:
    """The simulated rows of a batch with rewards r + log w; the real rows do not count. log_w: [B].

    Source: Eysenbach et al. 2021.
    """
    return batch._replace(reward=batch.reward + log_w, valid=losses.sim_rows(batch))


# --- the learner ------------------------------------------------------------------------------------------------------


def _sac_of(config: DARCConfig) -> SACConfig:
    sizes = config.obs_dim, config.act_dim, config.network
    return SACConfig(*sizes, tune_alpha=config.tune_alpha, train_dynamics=False)


def init(config: DARCConfig, key: Key, hyper: SACHyper | None = None, *, lr_ratio: float = 3e-4) -> DARCState:
    """A fresh agent. lr_ratio: Adam learning rate of the discriminators."""
    key_sac, key_ratio = jax.random.split(key)
    agent = sac.init(_sac_of(config), key_sac, hyper)
    return DARCState(agent, ratio.init(config.discriminators, key_ratio), jnp.float32(lr_ratio))


def act(
    config: DARCConfig, state: DARCState, carry: tuple[()], obs: Array, key: Key, *, explore: bool | Array
) -> tuple[Array, tuple[()]]:
    """Action [act_dim] in [-1, 1] for a raw obs [obs_dim], and the carry as it was."""
    return sac.act(_sac_of(config), state.sac, carry, obs, key, explore=explore)


def update(config: DARCConfig, state: DARCState, batch: Batch, key: Key) -> tuple[DARCState, Metrics]:
    """One step of the discriminators, then one update of SAC on the simulated rows as they pay by the new ones.

    batch: [B, ...] raw, which says which rows are simulated (`Batch.is_sim`). metrics: [] each.
    """
    key_ratio, key_sac = jax.random.split(key)
    batch, for_ratio = ratio.split_rows(batch, config.ratio_rows)
    fit, log_w, metrics = ratio.step(
        config.discriminators, state.ratio, batch, for_ratio, key_ratio, rate=state.lr_ratio
    )
    agent, of_sac = sac.update(_sac_of(config), state.sac, paid(batch, log_w), key_sac)
    return state.replace(sac=agent, ratio=fit), metrics | of_sac


def make_darc(config: DARCConfig, hyper: SACHyper | None = None, *, lr_ratio: float = 3e-4) -> Learner:
    """The functions of this module for one configuration."""
    start = partial(init, config, hyper=hyper, lr_ratio=lr_ratio)
    return Learner(start, lambda: (), partial(act, config), partial(update, config))
