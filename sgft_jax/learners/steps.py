"""Steps of actors, critics and temperatures that several learners share, each of one network with its own Adam.

Sources: SAC (Haarnoja et al. 2018); for real and simulated rows H2O (Niu et al. 2022) and H2O+ (2023).
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar, NamedTuple

import jax
import jax.numpy as jnp
import optax

from envs.types import Array, Key, PyTree
from sgft_jax import checks
from sgft_jax.math import losses, optim
from sgft_jax.models import networks, normalizer, ratio
from sgft_jax.models.config import NetworkConfig, two_layers
from sgft_jax.models.networks import Network
from sgft_jax.types import Batch, Metrics

LOG_ALPHA_MIN = -10.0  # dense negative rewards would drive an auto-tuned temperature to zero
OUTPUT_GAIN = 0.01  # of the last layers in the released codes of H2O: all values and means begin near 0

Critic = Callable[[PyTree, Array, Array], Array]  # (params of members, obs, action) -> [members]
Sampler = Callable[[Array, Key], tuple[Array, Array]]  # (obs, key) -> (action of the policy, its log pi [])


class Networks(NamedTuple):
    """A configuration with the networks and the optimiser that it describes; None where it has no such network."""

    config: Any
    actor: Network
    critic: Network
    optimiser: optax.GradientTransformation
    value: Any = None
    dynamics: Any = None
    ratio: Any = None
    memory: Any = None


# In this file `state` is that of a learner, with a network in training for actor and critic, the temperature
# `log_alpha`, and `normalizer`, `hyper`.


def begin(nets: Networks, key_actor: Key, key_critic: Key) -> dict[str, Any]:
    """What is part of every fresh agent. Its statistics leave observations as they are."""
    critic = nets.critic.init(key_critic)
    return {
        "actor": optim.start(nets.optimiser, nets.actor.init(key_actor)),
        "critic": optim.start(nets.optimiser, critic),
        "target_critic": jax.tree.map(jnp.copy, critic),  # its own buffers: a donated state must not hold one twice
        "normalizer": normalizer.identity(nets.config.obs_dim),
        "step": jnp.int32(0),
    }


# --- agents of real and simulated rows --------------------------------------------------------------------------------


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


def mixed_networks(config: MixedConfig) -> Networks:
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
    actor, obs = mixed_networks(config).actor, normalizer.normalize(state.normalizer, obs)
    return networks.tanh_gaussian_action(actor.apply(state.actor.params, obs), key, explore=explore), carry


# --- critics ----------------------------------------------------------------------------------------------------------


def sample(nets: Networks, state: Any, obs: Array, key: Key) -> tuple[Array, Array]:
    """An action [act_dim] of the policy and its log pi []. obs: what the actor reads."""
    return networks.tanh_gaussian_sample(nets.actor.apply(state.actor.params, obs), key)


def soft_targets(
    nets: Networks, state: Any, batch: Batch, key: Key, *, alpha: Array | float, members: Array | slice = slice(None)
) -> Array:
    """Targets r + discount (min_i Q_i(s', a') - alpha log pi(a'|s')) [B] with a' ~ pi.

    batch: what the networks read. members: of the target critic, over which the minimum is taken.
    """

    def target(row: Batch, key: Key) -> Array:
        action, log_prob = sample(nets, state, row.next_obs, key)
        next_q = nets.critic.apply(state.target_critic, row.next_obs, action)[members]
        return losses.td_target(row.reward, row.discount, next_q, log_prob, alpha=alpha)

    return jax.vmap(target)(batch, jax.random.split(key, batch.reward.shape[0]))


def step_critic(
    nets: Networks,
    state: Any,
    batch: Batch,
    targets: Array,
    *,
    rate: Array | float,
    term: Callable[[PyTree], Array] | None = None,
) -> tuple[optim.Fit, Metrics]:
    """The critics after a step on their squared errors. targets: [B]. term(params) -> [] joins the loss."""

    def loss(params: PyTree) -> tuple[Array, Array]:
        q = jax.vmap(nets.critic.apply, (None, 0, 0))(params, batch.obs, batch.action)
        error = losses.row_mean(jax.vmap(losses.critic_loss)(q, targets), batch)
        return error if term is None else error + term(params), q

    fit, value, q = optim.minimise(nets.optimiser, loss, state.critic, rate)
    return fit, {"critic/loss": value, "critic/q_mean": jnp.mean(q), "critic/target_mean": jnp.mean(targets)}


def step_mixed_critic(
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


def step_value(
    nets: Networks,
    state: Any,
    batch: Batch,
    row_losses: Callable[[Array], Array],
    mean: Callable[[Array, Batch], Array] = losses.row_mean,
) -> tuple[optim.Fit, Metrics]:
    """V after a step on the mean of row_losses(values [B]) -> [B]. mean: over the rows that count."""

    def loss(params: PyTree) -> tuple[Array, Array]:
        values = jax.vmap(nets.value.apply, (None, 0))(params, batch.obs)
        return mean(row_losses(values), batch), values

    fit, value, values = optim.minimise(nets.optimiser, loss, state.value, state.hyper.lr_value)
    return fit, {"value/loss": value, "value/mean": mean(values, batch)}


def lowest_target(nets: Networks, state: Any, batch: Batch) -> Array:
    """min_i Q_i(s, a) [B] of the target critic at the rows' own actions."""
    return jnp.min(jax.vmap(nets.critic.apply, (None, 0, 0))(state.target_critic, batch.obs, batch.action), axis=1)


# --- policies ---------------------------------------------------------------------------------------------------------


def step_actor(
    nets: Networks,
    state: Any,
    rows: Batch,
    key: Key,
    *,
    rate: Array | float,
    mean: bool = False,
    penalty: Callable[[PyTree, Array], Array] | None = None,
) -> tuple[optim.Fit, Array, Array, Metrics]:
    """The actor after a step on alpha log pi(a|s) - min_i Q_i(s, a) with a ~ pi. Source: H2O+ Eq. (10).

    Also returns q [B, members] and log pi [B] of the actions drawn. mean: follow the members' mean, not their minimum.
    penalty(params, obs) -> [] joins the loss of each row.
    """
    alpha, keys = jnp.exp(state.log_alpha.params), jax.random.split(key, rows.reward.shape[0])

    def row_loss(params: PyTree, obs: Array, key: Key) -> tuple[Array, Array, Array]:
        action, log_prob = networks.tanh_gaussian_sample(nets.actor.apply(params, obs), key)
        q = nets.critic.apply(state.critic.params, obs, action)
        loss = losses.actor_loss(log_prob, jnp.mean(q, keepdims=True) if mean else q, alpha=alpha)
        return loss if penalty is None else loss + penalty(params, obs), q, log_prob

    def loss(params: PyTree) -> tuple[Array, tuple[Array, Array]]:
        values, q, log_prob = jax.vmap(row_loss, (None, 0, 0))(params, rows.obs, keys)
        return losses.row_mean(values, rows), (q, log_prob)

    fit, value, (q, log_prob) = optim.minimise(nets.optimiser, loss, state.actor, rate)
    return fit, q, log_prob, {"actor/loss": value, "actor/entropy": -jnp.mean(log_prob)}


def step_policy(nets: Networks, state: Any, batch: Batch, key: Key) -> tuple[optim.Fit, optim.Fit, Metrics]:
    """Actor, and temperature where `nets.config.tune_alpha`, after a step on the states of all rows."""
    fit, _, log_prob, metrics = step_actor(nets, state, batch, key, rate=state.hyper.lr_actor)
    log_alpha = state.log_alpha
    if nets.config.tune_alpha:  # the released loss has log alpha in the place of alpha: with Adam nearly the same
        target, rate = state.hyper.entropy_per_dim * nets.config.act_dim, state.hyper.lr_alpha
        log_alpha = step_temperature(nets, state, batch, log_prob, target=target, rate=rate)
    return fit, log_alpha, metrics | {"actor/alpha": jnp.exp(log_alpha.params)}


def step_temperature(
    nets: Networks, state: Any, rows: Batch, log_prob: Array, *, target: float | Array, rate: float | Array
) -> optim.Fit:
    """One step of the temperature's logarithm. log_prob: [B] of the actions drawn. target: [] entropy, nats."""

    def loss(log_alpha: Array) -> tuple[Array, tuple[()]]:
        row_loss = partial(losses.temperature_loss, log_alpha, target_entropy=target)
        return losses.row_mean(jax.vmap(row_loss)(log_prob), rows), ()

    fit, _, _ = optim.minimise(nets.optimiser, loss, state.log_alpha, rate)
    return fit._replace(params=jnp.maximum(fit.params, LOG_ALPHA_MIN))
