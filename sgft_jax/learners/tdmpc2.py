"""TD-MPC2: planning in the latent space of a learned world model; and its fine-tuning by SGFT, with a frozen critic.

The world model is in `tdmpc2_model.py`, the search in `planning.py`; here is how an agent acts and learns. Source:
Hansen et al. 2024; SGFT section 8.4. Left out: the termination head of tasks that end early. The TD target knows
termination by `discount`, the planner assumes that an episode goes on for its horizon.
"""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
import optax

from envs.types import Array, Key, PyTree, UserError
from sgft_jax import planning
from sgft_jax.learners import tdmpc2_model as model
from sgft_jax.learners.tdmpc2_model import NETWORKS, Networks, TDMPC2Config, TDMPC2Hyper, TDMPC2Params, TDMPC2State
from sgft_jax.math import optim
from sgft_jax.models import normalizer, twohot
from sgft_jax.models.networks import check_params, tanh_gaussian_action
from sgft_jax.types import Batch, Learner, Metrics

__all__ = ["act", "check_params_of_prior", "clip_by_norm", "discounted_mean", "extract_params", "init", "init_carry"]
__all__ += ["make_tdmpc2", "policy_action", "scaled_entropy_sample", "state_from_prior", "update"]


# --- losses of one window ---------------------------------------------------------------------------------------------


def discounted_mean(values: Array, valid: Array, rho: Array | float, weight: Array | None = None) -> Array:
    """Mean [] over the valid of values [B, T], step t weighing rho^t; with all valid, 1/T sum_t rho^t mean_B.

    weight: [B] how much each row counts, mean 1.
    """
    decay = rho ** jnp.arange(values.shape[1])
    counts = valid * decay[None]
    total = jnp.maximum(jnp.sum(counts), 1e-6)
    counts = counts if weight is None else counts * weight[:, None]
    return jnp.mean(decay) * jnp.sum(jnp.where(valid, values, 0.0) * counts) / total


def scaled_entropy_sample(moments: Array, key: Key) -> tuple[Array, Array]:
    """An action [act_dim] of the policy, with gradients, and its scaled entropy [].

    moments: [2, act_dim] pre-tanh mean and log-std. The scaled entropy is -act_dim times the Gaussian log-density
    before the tanh: what the quotient of log-densities in the original comes to.
    """
    mean, log_std = moments
    noise = jax.random.normal(key, mean.shape)
    log_prob = jnp.sum(-0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi))
    return jnp.tanh(mean + jnp.exp(log_std) * noise), -mean.shape[0] * log_prob


def _window_losses(
    nets: Networks, params: dict[str, PyTree], rows: Batch, ahead: Array, q_target: Array, dropout: Key
) -> tuple[dict[str, Array], Array]:
    """Losses [H] of one window, by the name of their weight, and its rolled-out latents [H + 1, latent].

    rows: [H, ...]; ahead: [H, latent] encoded successors; q_target: [H]; dropout: [H] keys.
    """

    def advance(z: Array, action: Array) -> tuple[Array, Array]:
        z = nets.dynamics.apply(params["dynamics"], z, action)
        return z, z

    def classify(logits: Array, x: Array) -> Array:
        return twohot.cross_entropy(logits, x, nets.config.bins)

    def value(z: Array, action: Array, target: Array, key: Key) -> Array:
        keys = jax.random.split(key, nets.config.size.members)
        logits = nets.critic.apply(params["critic"], z, action, keys=keys)
        return jnp.mean(jax.vmap(classify, (0, None))(logits, target))

    first = nets.encoder.apply(params["encoder"], rows.obs[0])
    rolled = jax.lax.scan(advance, first, rows.action)[1]
    zs = jnp.concatenate([first[None], rolled])
    logits = jax.vmap(nets.reward.apply, (None, 0, 0))(params["reward"], zs[:-1], rows.action)
    losses = {"consistency": jnp.mean((rolled - ahead) ** 2, axis=1), "reward": jax.vmap(classify)(logits, rows.reward)}
    if not nets.config.sgft:
        losses["value"] = jax.vmap(value)(zs[:-1], rows.action, q_target, dropout)
    return losses, zs


def _promise(nets: Networks, state: TDMPC2State, z: Array, action: Array, heads: Array, dropout: Key) -> Array:
    """What the policy maximises []: Q by two random heads, or one step of the model to V_sim."""
    if not nets.config.sgft:
        keys = jax.random.split(dropout, nets.config.size.members)[heads]
        return jnp.mean(model.q_values(nets, model.heads_of(state.critic.params, heads), z, action, keys))
    ahead = nets.dynamics.apply(state.dynamics.params, z, action)
    return model.reward_of(nets, state, z, action) + state.hyper.gamma * model.v_sim(nets, state, ahead)


# --- the learner ------------------------------------------------------------------------------------------------------


def init(config: TDMPC2Config, key: Key, hyper: TDMPC2Hyper | None = None) -> TDMPC2State:
    """A fresh agent. Set the observation statistics with `state.replace(normalizer=...)`."""
    nets, keys = model.make_networks(config), dict(zip(NETWORKS, jax.random.split(key, len(NETWORKS)), strict=True))
    params = {name: getattr(nets, name).init(keys[name]) for name in NETWORKS}
    statistics = normalizer.identity(config.obs_dim)
    prior = TDMPC2Params(**params, normalizer=statistics, scale=jnp.float32(1))
    return _assemble(nets, hyper, prior)


def init_carry(config: TDMPC2Config) -> Array:
    """At the start of an episode: the mean [horizon, act_dim] of a plan that nobody has made."""
    return jnp.zeros((config.horizon, config.act_dim))


def act(
    config: TDMPC2Config, state: TDMPC2State, carry: Array, obs: Array, key: Key, *, explore: bool | Array
) -> tuple[Array, Array]:
    """First action [act_dim] of a plan, and the plan's mean [horizon, act_dim], which the next one begins with.

    obs: [obs_dim] raw. carry: the mean of the plan before.
    """
    nets, (key_policy, key_score, key_search) = model.make_networks(config), jax.random.split(key, 3)
    z = model.encode(nets, state, obs)
    keys = jax.random.split(key_policy, (config.horizon, config.policy_samples))
    proposals = jax.vmap(lambda keys: _proposal(nets, state, z, keys), in_axes=1)(keys)
    score = _score(nets, state, z, key_score)
    return planning.plan(config.planner, state.hyper.planner, score, proposals, carry, key_search, explore=explore)


def update(config: TDMPC2Config, state: TDMPC2State, batch: Batch, key: Key) -> tuple[TDMPC2State, Metrics]:
    """One step of world model with critic, then of the policy on the latents rolled out, then of the target critic.

    batch: windows [B, horizon, ...] raw; raises UserError for others. metrics: [] each.
    """
    if batch.reward.shape[1] != config.horizon:
        raise UserError(f"TD-MPC2 windows have {batch.reward.shape[1]} steps: must be {config.horizon}, the horizon")
    nets, (key_model, key_policy) = model.make_networks(config), jax.random.split(key)
    valid = jnp.ones(batch.reward.shape, bool) if batch.valid is None else batch.valid
    batch = jax.vmap(normalizer.normalize_rows, (None, 0))(state.normalizer, batch)

    state, zs, of_model = _update_model(nets, state, batch, valid, key_model)
    state, of_policy = _update_policy(nets, state, zs, valid, batch.weight, key_policy)
    if not config.sgft:
        average = optax.incremental_update(state.critic.params, state.target_critic, state.hyper.tau)
        state = state.replace(target_critic=average)
    return state.replace(step=state.step + 1), of_model | of_policy


def make_tdmpc2(config: TDMPC2Config, hyper: TDMPC2Hyper | None = None) -> Learner:
    """The functions of this module for one configuration: `update` takes windows [B, horizon]."""
    start, first = partial(init, config, hyper=hyper), partial(init_carry, config)
    return Learner(start, first, partial(act, config), partial(update, config))


# --- acting -----------------------------------------------------------------------------------------------------------


def policy_action(config: TDMPC2Config, state: TDMPC2State, obs: Array, key: Key, *, explore: bool | Array) -> Array:
    """Action [act_dim] of the policy alone, some thousand times cheaper than a plan. obs: [obs_dim] raw."""
    nets = model.make_networks(config)
    moments = nets.policy.apply(state.policy.params, model.encode(nets, state, obs))
    return tanh_gaussian_action(moments, key, explore=explore)


def _proposal(nets: Networks, state: TDMPC2State, z: Array, keys: Key) -> Array:
    """Actions [H, act_dim] of the policy as the model sees the future; one of the keys [H] a step."""

    def step(z: Array, key: Key) -> tuple[Array, Array]:
        action = tanh_gaussian_action(nets.policy.apply(state.policy.params, z), key, explore=True)
        return nets.dynamics.apply(state.dynamics.params, z, action), action

    return jax.lax.scan(step, z, keys)[1]


def _score(nets: Networks, state: TDMPC2State, z: Array, key: Key) -> Callable[[Array], Array]:
    """What a plan [H, act_dim] from z promises: sum of gamma^t R, then gamma^H times a value.

    The value is V_sim with sgft, else the mean of 2 random heads at a drawn action. One draw for all candidates
    of a plan, where the original draws for each, so that they differ by their actions alone.
    """
    key_heads, key_action = jax.random.split(key)
    critic, gamma = model.heads_of(state.critic.params, model.two_heads(nets.config, key_heads)), state.hyper.gamma
    noise = jax.random.normal(key_action, (nets.config.act_dim,))

    def final(z: Array) -> Array:
        if nets.config.sgft:
            return model.v_sim(nets, state, z)
        mean, log_std = nets.policy.apply(state.policy.params, z)
        return jnp.mean(model.q_values(nets, critic, z, jnp.tanh(mean + jnp.exp(log_std) * noise)))

    def step(carry: tuple[Array, Array], action: Array) -> tuple[tuple[Array, Array], Array]:
        z, weight = carry
        reward = weight * model.reward_of(nets, state, z, action)
        return (nets.dynamics.apply(state.dynamics.params, z, action), weight * gamma), reward

    def score(actions: Array) -> Array:
        # The first step by itself: all candidates share its latent, which a loop would have to carry for each.
        ahead, first = step((z, jnp.float32(1)), actions[0])
        (last, weight), rewards = jax.lax.scan(step, ahead, actions[1:])
        return first + jnp.sum(rewards) + weight * final(last)

    return score


# --- one update -------------------------------------------------------------------------------------------------------


def _update_model(
    nets: Networks, state: TDMPC2State, batch: Batch, valid: Array, key: Key
) -> tuple[TDMPC2State, Array, Metrics]:
    """Also returns the latents [B, H + 1, latent] rolled out by the model as it was."""
    key_heads, key_action, key_dropout = jax.random.split(key, 3)
    judges, hyper = model.heads_of(state.target_critic, model.two_heads(nets.config, key_heads)), state.hyper

    def target(next_obs: Array, reward: Array, discount: Array, key: Key) -> tuple[Array, Array]:
        # The successor's latent is encoded, while losses are taken at rolled-out ones.
        ahead = nets.encoder.apply(state.encoder.params, next_obs)
        action = tanh_gaussian_action(nets.policy.apply(state.policy.params, ahead), key, explore=True)
        return ahead, reward + discount * jnp.min(model.q_values(nets, judges, ahead, action))

    keys = jax.random.split(key_action, valid.shape)
    ahead, q_target = jax.vmap(jax.vmap(target))(batch.next_obs, batch.reward, batch.discount, keys)
    dropout = jax.random.split(key_dropout, valid.shape)
    frozen = {name: getattr(state, name).params for name in NETWORKS}

    def loss(learned: dict[str, PyTree]) -> tuple[Array, tuple[dict[str, Array], Array]]:
        window_losses = jax.vmap(partial(_window_losses, nets, frozen | learned))
        steps, zs = window_losses(batch, ahead, q_target, dropout)
        mean = {name: discounted_mean(x, valid, hyper.rho, batch.weight) for name, x in steps.items()}
        return sum((getattr(hyper, name) * x for name, x in mean.items()), jnp.float32(0)), (mean, zs)

    fits = {name: getattr(state, name) for name in nets.config.learned}
    grads, (mean, zs) = jax.grad(loss, has_aux=True)({name: fit.params for name, fit in fits.items()})
    grads, norm = clip_by_norm(grads, hyper.max_grad_norm)
    rates = {name: _rate(state) * (hyper.encoder_lr_scale if name == "encoder" else 1.0) for name in fits}
    fits = {name: optim.step(nets.adam, fit, grads[name], rates[name]) for name, fit in fits.items()}
    metrics = {f"model/{name}_loss": x for name, x in mean.items()} | {"model/grad_norm": norm}
    if not nets.config.sgft:
        metrics["critic/target_mean"] = jnp.mean(q_target, where=valid)
    return state.replace(**fits), zs, metrics


def _update_policy(
    nets: Networks, state: TDMPC2State, zs: Array, valid: Array, weight: Array | None, key: Key
) -> tuple[TDMPC2State, Metrics]:
    """zs: [B, H + 1, latent]; valid: [B, H] of the steps between them; weight: [B] or None."""
    key_heads, key_action, key_dropout = jax.random.split(key, 3)
    heads, hyper = model.two_heads(nets.config, key_heads), state.hyper
    reached = jnp.concatenate([valid[:, :1], valid], axis=1)
    keys = jax.random.split(key_action, reached.shape), jax.random.split(key_dropout, reached.shape)

    def promise(params: PyTree, z: Array, key: Key, dropout: Key) -> tuple[Array, Array]:
        action, entropy = scaled_entropy_sample(nets.policy.apply(params, z), key)
        return _promise(nets, state, z, action, heads, dropout), entropy

    def loss(params: PyTree) -> tuple[Array, tuple[Array, Array, Array]]:
        value, entropy = jax.vmap(jax.vmap(partial(promise, params)))(zs, *keys)
        low, high = jnp.quantile(jax.lax.stop_gradient(value[:, 0]), jnp.array([0.05, 0.95]))
        scale = state.scale + hyper.tau * (jnp.maximum(high - low, 1.0) - state.scale)
        losses = -value / scale - hyper.entropy * entropy
        return discounted_mean(losses, reached, hyper.rho, weight), (value, entropy, scale)

    (total, (value, entropy, scale)), grads = jax.value_and_grad(loss, has_aux=True)(state.policy.params)
    grads, norm = clip_by_norm(grads, hyper.max_grad_norm)
    fit = optim.step(nets.policy_adam, state.policy, grads, _rate(state))
    metrics = {
        "actor/loss": total,
        "actor/value_mean": jnp.mean(value, where=reached),
        "actor/entropy": jnp.mean(entropy, where=reached) / nets.config.act_dim,
        "actor/scale": scale,
        "actor/grad_norm": norm,
    }
    return state.replace(policy=fit, scale=scale), metrics


def clip_by_norm(grads: PyTree, limit: Array | float) -> tuple[PyTree, Array]:
    """The gradients, scaled down to a global norm of at most `limit` [], and the norm [] they had."""
    norm = optax.tree.norm(grads)
    factor = jnp.minimum(1.0, limit / (norm + 1e-6))
    return jax.tree.map(lambda g: g * factor, grads), norm


def _rate(state: TDMPC2State) -> Array:
    """The learning rate [] of this update."""
    return state.hyper.lr * optim.warmup_factor(state.step, state.hyper.lr_warmup)


# --- between simulation and reality -----------------------------------------------------------------------------------


def _assemble(nets: Networks, hyper: TDMPC2Hyper | None, prior: TDMPC2Params) -> TDMPC2State:
    """Fresh moments around given parameters."""

    def start(name: str) -> optim.Fit:
        return optim.start(nets.policy_adam if name == "policy" else nets.adam, getattr(prior, name))

    return TDMPC2State(
        **{name: start(name) for name in NETWORKS},
        target_critic=jax.tree.map(jnp.copy, prior.critic),  # own buffers: a donated state must not hold one twice
        anchor=jax.tree.map(jnp.copy, prior.anchor or prior.policy) if nets.config.sgft else None,
        scale=prior.scale,
        normalizer=prior.normalizer,
        hyper=optim.as_leaves(TDMPC2Hyper, hyper),
        step=jnp.int32(0),
    )


def extract_params(state: TDMPC2State) -> TDMPC2Params:
    """What a pretrained agent hands over."""
    params = {name: getattr(state, name).params for name in NETWORKS}
    return TDMPC2Params(**params, normalizer=state.normalizer, scale=state.scale, anchor=state.anchor)


def state_from_prior(config: TDMPC2Config, hyper: TDMPC2Hyper, params: TDMPC2Params) -> TDMPC2State:
    """An agent that starts from a prior: all its networks, its normaliser (frozen), fresh optimiser moments.

    With `config.sgft` its policy becomes the anchor of V_sim, unless it brings one. The horizon may be another one.
    """
    check_params_of_prior(config, params)
    params = jax.tree.map(jnp.copy, params)  # the caller may donate the state; the prior must survive it
    return _assemble(model.make_networks(config), hyper, params)


def check_params_of_prior(config: TDMPC2Config, params: TDMPC2Params) -> None:
    """Raise UserError where a network of the prior is not the one that `config` describes."""
    nets = model.make_networks(config)
    owner = f"obs_dim {config.obs_dim}, act_dim {config.act_dim}, {config.size}"
    for name in NETWORKS:
        check_params(name, getattr(nets, name), getattr(params, name), f"{owner}: use the prior's own task and size")
