"""The reference for the speed of hybrid runs: the update of H2O+ written by hand for whole batches, in bare JAX.

The paper's agent: discriminators, twin critic, value by expectile, actor, temperature, target average. What no result
depends on is left out: each network reads only the rows whose errors count. A test checks that it leaves the same
parameters as the learner.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Array, Key, PyTree, Transition
from experiments.bench.bare_sac import Trained, adam, forward, layers, squashed, temperature, trained
from sgft_jax.learners.h2oplus import H2OPlusHyper
from sgft_jax.models.networks import LOG_STD_MAX

BOUND, RATIO_NOISE = 2.0, 0.1  # of the discriminators' logits and inputs


class Noise(NamedTuple):
    """What an update draws: normals [B, act_dim] for actions at the next and present states; [R, ...] of the
    discriminators' rows, for s, a and s'.
    """

    target: Array
    actor: Array
    ratio: tuple[Array, Array, Array]


class Bare(NamedTuple):
    """The whole agent. actor: (layers, scale, offset) of its log std. joint, pair: the discriminators."""

    actor: Trained
    critic: Trained
    target: PyTree
    value: Trained
    log_alpha: Trained
    joint: Trained
    pair: Trained


def init(key: Key, hidden: tuple[int, ...], obs_dim: int, act_dim: int) -> Bare:
    """A fresh agent of those sizes."""
    keys, both = jax.random.split(key, 5), obs_dim + act_dim
    plain = functools.partial(layers, hidden=hidden, layer_norm=False)
    critic = plain(keys[1], both, 1, stack=2)
    return Bare(
        actor=trained((plain(keys[0], obs_dim, 2 * act_dim), jnp.float32(1.0), jnp.float32(-1.0))),
        critic=trained(critic),
        target=jax.tree.map(jnp.copy, critic),
        value=trained(plain(keys[2], obs_dim, 1)),
        log_alpha=trained(jnp.float32(0.0)),
        joint=trained(plain(keys[3], both + obs_dim, 2)),
        pair=trained(plain(keys[4], both, 2)),
    )


def draw(key: Key, rows: int, ratio_rows: int, obs_dim: int, act_dim: int) -> Noise:
    """All random numbers of one update. rows, ratio_rows: of both origins together."""
    keys = jax.random.split(key, 5)
    target, actor = (jax.random.normal(k, (rows, act_dim)) for k in keys[:2])
    sizes = (obs_dim, act_dim, obs_dim)
    obs, action, next_obs = (jax.random.normal(k, (ratio_rows, n)) for k, n in zip(keys[2:], sizes, strict=True))
    return Noise(target, actor, (obs, action, next_obs))


def update(agent: Bare, batch: Transition, for_ratio: Transition, noise: Noise, hyper: H2OPlusHyper) -> Bare:
    """One update on a batch [B, ...] and the discriminators' rows [R, ...]; the first half of each is real."""
    n, alpha = batch.reward.shape[0] // 2, jnp.exp(agent.log_alpha.params)
    joint, pair = _discriminators(agent, for_ratio, noise, hyper)
    of_sim = _bounded(joint.params, batch.obs[n:], batch.action[n:], batch.next_obs[n:])
    weights = jnp.exp(jnp.minimum(of_sim[:, 0] - of_sim[:, 1], 0.0))  # the pair's logits are in both, and cancel

    def actor_loss(params: PyTree) -> tuple[Array, Array]:
        action, log_prob = _sample(params, batch.obs, noise.actor)
        return jnp.mean(alpha * log_prob - _q(agent.critic.params, batch.obs, action).min(0)), log_prob

    grads, log_prob = jax.grad(actor_loss, has_aux=True)(agent.actor.params)
    actor = adam(agent.actor, grads, hyper.lr_actor)
    entropy = hyper.entropy_per_dim * batch.action.shape[-1]
    log_alpha = temperature(agent.log_alpha, log_prob, entropy, hyper.lr_alpha)

    q_real = _q(agent.target, batch.obs[:n], batch.action[:n]).min(0)

    def value_loss(params: PyTree) -> Array:
        error = q_real - forward(params, batch.obs[:n])[:, 0]
        return jnp.mean(jnp.where(error < 0, 1 - hyper.expectile, hyper.expectile) * error**2)

    value = adam(agent.value, jax.grad(value_loss)(agent.value.params), hyper.lr_value)

    following, next_log_prob = _sample(agent.actor.params, batch.next_obs, noise.target)
    online = _q(agent.target, batch.next_obs, following).min(0) - alpha * next_log_prob
    in_sample = forward(agent.value.params, batch.next_obs)[:, 0]
    share = hyper.value_share
    target = batch.reward + batch.discount * (share * in_sample + (1 - share) * online)

    def critic_loss(params: PyTree) -> Array:
        errors = jnp.sum((_q(params, batch.obs, batch.action) - target) ** 2, axis=0)
        return jnp.mean(errors[:n]) + jnp.mean(weights * errors[n:])

    critic = adam(agent.critic, jax.grad(critic_loss)(agent.critic.params), hyper.lr_critic)
    average = jax.tree.map(lambda old, new: old + hyper.tau * (new - old), agent.target, critic.params)
    return Bare(actor, critic, average, value, log_alpha, joint, pair)


def _discriminators(agent: Bare, rows: Transition, noise: Noise, hyper: H2OPlusHyper) -> tuple[Trained, Trained]:
    """Both after one step."""
    inputs = (rows.obs, rows.action, rows.next_obs)
    obs, action, next_obs = (x + RATIO_NOISE * e for x, e in zip(inputs, noise.ratio, strict=True))
    n = rows.reward.shape[0] // 2

    def loss(params: tuple[PyTree, PyTree]) -> Array:
        of_pair = _bounded(params[1], obs, action)
        of_joint = _bounded(params[0], obs, action, next_obs) + of_pair
        likely = jax.nn.log_softmax(of_pair) + jax.nn.log_softmax(of_joint)
        return -jnp.mean(likely[:n, 0]) - jnp.mean(likely[n:, 1])

    grads = jax.grad(loss)((agent.joint.params, agent.pair.params))
    return adam(agent.joint, grads[0], hyper.lr_ratio), adam(agent.pair, grads[1], hyper.lr_ratio)


def _bounded(network: PyTree, *parts: Array) -> Array:
    """Logits [B, 2] of a discriminator."""
    return BOUND * jnp.tanh(forward(network, jnp.concatenate(parts, axis=1)))


def _q(critic: PyTree, obs: Array, action: Array) -> Array:
    """Values [2, B]."""
    return forward(critic, jnp.concatenate([obs, action], axis=1))[..., 0]


def _sample(actor: PyTree, obs: Array, noise: Array) -> tuple[Array, Array]:
    """Actions [B, act_dim] of the policy and their log-probabilities [B]."""
    network, scale, offset = actor
    mean, output = jnp.split(forward(network, obs), 2, axis=-1)
    return squashed(mean, jnp.clip(scale * output + offset, -20.0, LOG_STD_MAX), noise)
