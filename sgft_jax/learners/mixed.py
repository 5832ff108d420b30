"""What learners of real and simulated rows share: two discriminators tell the rows apart, and both train one critic.

`state` is that of a learner, as in `steps.py`. Sources: H2O (Niu et al. 2022) and H2O+ (2023).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ClassVar

import jax
import jax.numpy as jnp

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.learners import steps
from sgft_jax.learners.steps import Networks
from sgft_jax.math import losses, optim
from sgft_jax.models import networks, normalizer, ratio
from sgft_jax.models.config import NetworkConfig, two_layers
from sgft_jax.types import Batch, Metrics

OUTPUT_GAIN = 0.01  # of the last layers in the released codes of H2O: all values and means begin near 0


@dataclass(frozen=True)
class MixedConfig(checks.Checked):
    """The structure of an agent that learns from real and simulated rows, which two discriminators tell apart.

    obs_dim, act_dim: sizes of what the environment gives and takes.
    network: body of actor, critics and value. critics: members.
    tune_alpha: follow the target entropy; False keeps the temperature at `alpha`.
    ratio_network: body of the discriminators. ratio_noise: std of their training noise, in units of what they read.
    ratio_rows: the last so many rows of a batch train the discriminators and nothing else; None = all rows train all.
    """

    obs_dim: int
    act_dim: int
    network: NetworkConfig = field(default_factory=two_layers)
    tune_alpha: bool = True
    ratio_network: NetworkConfig = field(default_factory=two_layers)
    ratio_noise: float = 0.1
    ratio_rows: checks.Count | None = None
    critics: ClassVar[int] = 2

    @property
    def discriminators(self) -> ratio.RatioConfig:
        """Their part."""
        return ratio.RatioConfig(self.obs_dim, self.act_dim, self.ratio_network, noise=self.ratio_noise)


def make_networks(config: MixedConfig) -> Networks:
    """Those of H2O's released codes."""
    sizes, gain = (config.obs_dim, config.act_dim), OUTPUT_GAIN
    return Networks(
        config=config,
        actor=networks.make_affine_actor(*sizes, config.network, output_gain=gain),
        critic=networks.make_critic(*sizes, config.network, members=config.critics, output_gain=gain),
        optimiser=optim.adam(),
        value=networks.make_value(config.obs_dim, config.network, output_gain=gain),
        ratio=config.discriminators,
    )


def act(
    config: MixedConfig, state: Any, carry: tuple[()], obs: Array, key: Key, *, explore: bool | Array
) -> tuple[Array, tuple[()]]:
    """Action [act_dim] in [-1, 1] for a raw obs [obs_dim], and the carry as it was."""
    actor, obs = make_networks(config).actor, normalizer.normalize(state.normalizer, obs)
    return networks.tanh_gaussian_action(actor.apply(state.actor.params, obs), key, explore=explore), carry


def step_critic(
    nets: Networks,
    state: Any,
    batch: Batch,
    targets: Array,
    weights: Array,
    *,
    penalty: Callable[[PyTree, Array], Array] | None = None,
) -> tuple[optim.Fit, Metrics]:
    """The critics after a step on real and weighted simulated errors, a mean of each. Source: H2O+ Eq. (8).

    targets: [B]. weights: [B], of which those of simulated rows count. penalty(params, q) -> [] joins the loss; it is
    given the critics' parameters and their values [B, members].
    """

    def loss(params: PyTree) -> tuple[Array, Metrics]:
        q = jax.vmap(nets.critic.apply, (None, 0, 0))(params, batch.obs, batch.action)
        errors = jax.vmap(losses.critic_loss)(q, targets)
        real, simulated = losses.real_mean(errors, batch), losses.sim_mean(weights * errors, batch)
        metrics = {"critic/real_loss": real, "critic/sim_loss": simulated, "critic/q_mean": jnp.mean(q)}
        if penalty is None:
            return real + simulated, metrics
        metrics["critic/penalty"] = penalty(params, q)
        return real + simulated + metrics["critic/penalty"], metrics

    fit, total, metrics = optim.minimise(nets.optimiser, loss, state.critic, state.hyper.lr_critic)
    return fit, metrics | {"critic/loss": total, "critic/target_mean": jnp.mean(targets)}


def step_policy(nets: Networks, state: Any, batch: Batch, key: Key) -> tuple[optim.Fit, optim.Fit, Metrics]:
    """Actor, and temperature where `nets.config.tune_alpha`, after a step on the states of all rows."""
    fit, log_prob, metrics = steps.step_actor(nets, state, batch, key, rate=state.hyper.lr_actor)
    log_alpha = state.log_alpha
    if nets.config.tune_alpha:  # the released loss has log alpha in the place of alpha: with Adam nearly the same
        target, rate = state.hyper.entropy_per_dim * nets.config.act_dim, state.hyper.lr_alpha
        log_alpha = steps.step_temperature(nets, state, batch, log_prob, target=target, rate=rate)
    return fit, log_alpha, metrics | {"actor/alpha": jnp.exp(log_alpha.params)}
