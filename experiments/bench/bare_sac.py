"""The reference for the speed of updates: pretraining's SAC update written by hand for whole batches, in bare JAX.

The same networks, losses and Adam as the SAC learner has in pretraining (twin critic, actor, temperature, V, dynamics
ensemble, target average), without Flax, Optax, vmap over examples, or metrics. A test checks that both do the same
arithmetic.
"""

from itertools import pairwise
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from envs.types import Array, Key, PyTree, Transition
from sgft_jax.learners.sac import SACHyper
from sgft_jax.learners.steps import LOG_ALPHA_MIN
from sgft_jax.models.networks import LOG_STD_MAX, LOG_STD_MIN, NetworkConfig


class Noise(NamedTuple):
    """What an update draws: normals [B, act_dim] for next and present actions, weights [B, members] of the models."""

    target: Array
    actor: Array
    bootstrap: Array


class Trained(NamedTuple):
    """Parameters with Adam's moments; `count`: [] steps so far."""

    params: PyTree
    first: PyTree
    second: PyTree
    count: Array


class Bare(NamedTuple):
    """The whole agent. Layers are tuples (kernel, bias) or (kernel, bias, scale, offset); ensembles are stacked."""

    actor: Trained
    critic: Trained
    target: PyTree
    log_alpha: Trained
    dynamics: Trained


def init(key: Key, config: NetworkConfig, obs_dim: int, act_dim: int, *, members: int, alpha: float) -> Bare:
    """A fresh agent of those sizes."""
    keys = jax.random.split(key, 4)
    norm = config.layer_norm
    critic = layers(keys[1], obs_dim + act_dim, 1, config.hidden, layer_norm=norm, stack=2)
    return Bare(
        actor=trained(layers(keys[0], obs_dim, 2 * act_dim, config.hidden, layer_norm=config.actor_layer_norm)),
        critic=trained(critic),
        target=jax.tree.map(jnp.copy, critic),
        log_alpha=trained(jnp.log(jnp.float32(alpha))),
        dynamics=trained(layers(keys[3], obs_dim + act_dim, obs_dim, config.hidden, layer_norm=False, stack=members)),
    )


def draw(key: Key, batch: int, act_dim: int, members: int) -> Noise:
    """All random numbers of one update."""
    keys = jax.random.split(key, 3)
    target, actor = (jax.random.normal(k, (batch, act_dim)) for k in keys[:2])
    return Noise(target, actor, jax.random.exponential(keys[2], (batch, members)))


def update(agent: Bare, batch: Transition, noise: Noise, hyper: SACHyper) -> Bare:
    """One update on a batch [B, ...] of normalised observations; relu networks."""
    act_dim, alpha = batch.action.shape[-1], jnp.exp(agent.log_alpha.params)
    both = jnp.concatenate([batch.obs, batch.action], axis=1)
    following, log_prob = _sample(agent.actor.params, batch.next_obs, noise.target)
    next_q = forward(agent.target, jnp.concatenate([batch.next_obs, following], axis=1))[..., 0].min(0)
    target = batch.reward + batch.discount * (next_q - alpha * log_prob)

    def critic_loss(params: PyTree) -> Array:
        return jnp.mean(jnp.sum((forward(params, both)[..., 0] - target) ** 2, axis=0))

    critic = adam(agent.critic, jax.grad(critic_loss)(agent.critic.params), hyper.lr_critic)
    average = jax.tree.map(lambda old, new: old + hyper.tau * (new - old), agent.target, critic.params)

    def actor_loss(params: PyTree) -> tuple[Array, Array]:
        action, log_prob = _sample(params, batch.obs, noise.actor)
        q = forward(critic.params, jnp.concatenate([batch.obs, action], axis=1))[..., 0].min(0)
        return jnp.mean(alpha * log_prob - q), log_prob

    grads, log_prob = jax.grad(actor_loss, has_aux=True)(agent.actor.params)
    actor = adam(agent.actor, grads, hyper.lr_actor)
    log_alpha = temperature(agent.log_alpha, log_prob, hyper.entropy_per_dim * act_dim, hyper.lr_alpha)

    def dynamics_loss(params: PyTree) -> Array:
        errors = jnp.mean((forward(params, both) - (batch.next_obs - batch.obs)) ** 2, axis=-1)
        return jnp.sum(jnp.mean(noise.bootstrap.T * errors, axis=1))

    dynamics = adam(agent.dynamics, jax.grad(dynamics_loss)(agent.dynamics.params), hyper.lr_dynamics)
    return Bare(actor, critic, average, log_alpha, dynamics)


def temperature(log_alpha: Trained, log_prob: Array, entropy: float | Array, rate: Any) -> Trained:
    """The temperature's logarithm after one step towards that entropy. log_prob: [B] of the policy's actions."""
    slope = jnp.exp(log_alpha.params) * jnp.mean(-log_prob - entropy)
    log_alpha = adam(log_alpha, slope, rate)
    return log_alpha._replace(params=jnp.maximum(log_alpha.params, LOG_ALPHA_MIN))


def layers(
    key: Key, inputs: int, outputs: int, hidden: tuple[int, ...], *, layer_norm: bool, stack: int | None = None
) -> list[tuple[Array, ...]]:
    """A network of such sizes, or `stack` of them: tuples (kernel, bias) or (kernel, bias, scale, offset)."""
    lead, sizes = (() if stack is None else (stack,)), [inputs, *hidden, outputs]
    made = []
    for i, (n, m) in enumerate(pairwise(sizes)):
        kernel = jax.random.normal(jax.random.fold_in(key, i), (*lead, n, m)) / jnp.sqrt(n)
        norm = (jnp.ones((*lead, m)), jnp.zeros((*lead, m))) if layer_norm and i < len(hidden) else ()
        made.append((kernel, jnp.zeros((*lead, m)), *norm))
    return made


def forward(network: list[tuple[Array, ...]], x: Array) -> Array:
    """x: [B, inputs] -> [B, outputs], or [members, B, outputs] through stacked layers."""
    for i, (kernel, bias, *norm) in enumerate(network):
        x = x @ kernel + bias[..., None, :]
        if norm:
            scale, offset = (v[..., None, :] for v in norm)
            mean = jnp.mean(x, axis=-1, keepdims=True)
            variance = jnp.maximum(jnp.mean(x**2, axis=-1, keepdims=True) - mean**2, 0.0)
            x = (x - mean) * (jax.lax.rsqrt(variance + 1e-6) * scale) + offset
        if i < len(network) - 1:
            x = jnp.maximum(x, 0.0)
    return x


def _sample(actor: list[tuple[Array, ...]], obs: Array, noise: Array) -> tuple[Array, Array]:
    """Actions [B, act_dim] of the tanh-Gaussian policy and their log-probabilities [B]."""
    mean, log_std = jnp.split(forward(actor, obs), 2, axis=-1)
    return squashed(mean, jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX), noise)


def squashed(mean: Array, log_std: Array, noise: Array) -> tuple[Array, Array]:
    """The tanh of a Gaussian's draws [B, act_dim], given standard normal noise, and their log-probabilities [B]."""
    u = mean + jnp.exp(log_std) * noise
    normal = -0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    squash = 2 * (jnp.log(2.0) - u - jax.nn.softplus(-2 * u))
    return jnp.tanh(u), jnp.sum(normal - squash, axis=-1)


def trained(params: PyTree) -> Trained:
    """Parameters with fresh moments."""
    first, second = (jax.tree.map(jnp.zeros_like, params) for _ in range(2))
    return Trained(params, first, second, jnp.int32(0))


def adam(old: Trained, grads: PyTree, rate: Any) -> Trained:
    """Parameters and moments after one step of Adam."""
    count = old.count + 1
    first = jax.tree.map(lambda m, g: 0.9 * m + 0.1 * g, old.first, grads)
    second = jax.tree.map(lambda v, g: 0.999 * v + 0.001 * g**2, old.second, grads)
    scale = jnp.sqrt(1 - 0.999**count) / (1 - 0.9**count)

    def step(p: Array, m: Array, v: Array) -> Array:
        return p - rate * scale * m / (jnp.sqrt(v) + 1e-8 * jnp.sqrt(1 - 0.999**count))

    return Trained(jax.tree.map(step, old.params, first, second), first, second, count)
