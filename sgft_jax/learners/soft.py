"""Steps that soft actor-critics of real and simulated rows share. Sources: H2O (Niu et al. 2022), H2O+ (2023)."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import optax

from envs.types import Array, Key, PyTree
from sgft_jax.learners.sac import step_temperature
from sgft_jax.math import losses, optim
from sgft_jax.models import normalizer
from sgft_jax.models.networks import Network, tanh_gaussian_action, tanh_gaussian_sample
from sgft_jax.types import Batch, Metrics

OUTPUT_GAIN = 0.01  # of the last layers in the released codes: all values and means begin near 0


def make_act(actor: Network) -> Callable[..., tuple[Array, tuple[()]]]:
    """`Learner.act` of a tanh-Gaussian actor without memory. Its state has `actor` and `normalizer`."""

    def act(
        state: Any, carry: tuple[()], obs: Array, key: Key, *, explore: bool | Array, context: Array | None = None
    ) -> tuple[Array, tuple[()]]:
        del context  # the actor reads the observation alone
        moments = actor.apply(state.actor.params, normalizer.normalize(state.normalizer, obs))
        return tanh_gaussian_action(moments, key, explore=explore), carry

    return act


def step_policy(
    actor: Network,
    critic: Network,
    optimiser: optax.GradientTransformation,
    state: Any,
    batch: Batch,
    key: Key,
    *,
    target_entropy: Array | float | None,
) -> tuple[optim.Fit, optim.Fit, Metrics]:
    """Actor and temperature after a step on the states of all rows, with a ~ pi. Source: H2O+ Eq. (10).

    state: of a learner, with `actor`, `critic`, `log_alpha` and the rates of `hyper`. batch: what its networks read.
    target_entropy: [] nats of a whole action; None keeps the temperature.
    """
    alpha, keys = jnp.exp(state.log_alpha.params), jax.random.split(key, batch.reward.shape[0])

    def one(params: PyTree, obs: Array, key: Key) -> tuple[Array, Array]:
        action, log_prob = tanh_gaussian_sample(actor.apply(params, obs), key)
        return losses.actor_loss(log_prob, critic.apply(state.critic.params, obs, action), alpha=alpha), log_prob

    def loss(params: PyTree) -> tuple[Array, Array]:
        each, log_prob = jax.vmap(one, (None, 0, 0))(params, batch.obs, keys)
        return losses.row_mean(each, batch), log_prob

    (mean, log_prob), grads = jax.value_and_grad(loss, has_aux=True)(state.actor.params)
    fit, log_alpha = optim.step(optimiser, state.actor, grads, state.hyper.lr_actor), state.log_alpha
    if target_entropy is not None:  # the released loss has log alpha in the place of alpha: with Adam nearly the same
        log_alpha = step_temperature(
            optimiser, log_alpha, batch, log_prob, target=target_entropy, rate=state.hyper.lr_alpha
        )
    metrics = {"actor/loss": mean, "actor/entropy": -jnp.mean(log_prob), "actor/alpha": jnp.exp(log_alpha.params)}
    return fit, log_alpha, metrics


def step_critic(
    critic: Network,
    optimiser: optax.GradientTransformation,
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

    def loss(params: PyTree) -> tuple[Array, tuple[Array, ...]]:
        q = jax.vmap(critic.apply, (None, 0, 0))(params, batch.obs, batch.action)
        each = jax.vmap(losses.critic_loss)(q, targets)
        real, simulated = losses.real_mean(each, batch), losses.sim_mean(weights * each, batch)
        further = jnp.float32(0) if penalty is None else penalty(params, q)
        return real + simulated + further, (q, real, simulated, further)

    (total, (q, real, simulated, further)), grads = jax.value_and_grad(loss, has_aux=True)(state.critic.params)
    metrics = {
        "critic/loss": total,
        "critic/real_loss": real,
        "critic/sim_loss": simulated,
        "critic/q_mean": jnp.mean(q),
        "critic/target_mean": jnp.mean(targets),
    }
    if penalty is not None:
        metrics["critic/penalty"] = further
    return optim.step(optimiser, state.critic, grads, state.hyper.lr_critic), metrics
