"""TD-MPC2: planning in the latent space of a learned world model; and its fine-tuning by SGFT, with a frozen critic.

Structure (shapes, what learns) is static in `TDMPC2Config`; every number is a leaf of the state in `TDMPC2Hyper`, so
that they vmap like seeds do. Source: Hansen et al. 2024; SGFT section 8.4. Left out: the termination head of tasks that
end early. The TD target knows termination by `discount`, the planner assumes that an episode goes on for its horizon.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct

from sgft_jax import mppi, normalizer, optim, twohot
from sgft_jax.networks import Network, check_params, tanh_gaussian_action
from sgft_jax.sequences import Sequences
from sgft_jax.types import Array, Key, Learner, Metrics, Normalizer, PyTree, Transition, UserError, unknown

LOG_STD_MIN, LOG_STD_MAX = -10.0, 2.0
_NETWORKS = ("encoder", "dynamics", "reward", "policy", "critic")


@dataclass(frozen=True)
class Size:
    """Widths of the networks.

    encoder: hidden layers of the encoder, which has `encoder_layers` linear layers. mlp: the two hidden layers of every
    other network. latent: entries of the latent state. members: heads of the critic.
    """

    encoder: int = 256
    mlp: int = 512
    latent: int = 512
    encoder_layers: int = 2
    members: int = 5


SIZES = {
    "1M": Size(256, 384, 128, 2, 2),
    "5M": Size(256, 512, 512, 2, 5),
    "19M": Size(1024, 1024, 768, 3, 5),
    "48M": Size(1792, 1792, 768, 4, 5),
    "317M": Size(4096, 4096, 1376, 5, 8),
}


@dataclass(frozen=True)
class TDMPC2Config:
    """The structure of an agent.

    obs_dim, act_dim: sizes of what the environment gives and takes. horizon: steps of plans and of training windows.
    size: one of `SIZES`, or another. simnorm_group: latent entries per group of SimNorm. bins: of reward and critic.
    dropout: rate after the critic's first layer, in training only.
    samples, elites, policy_samples, iterations: of the planner; policy_samples are sequences proposed by the policy;
        iterations None = 6, and 8 from 20 action entries on.
    sgft: encoder, critic and a copy of the first policy never change. They make V_sim, the frozen value that ends plans
        and teaches the policy; dynamics, reward head and policy learn. False: everything learns, as published.
    train_encoder: with sgft, learn the encoder, too. An ablation: the frozen critic then reads latents that drift.
    """

    obs_dim: int
    act_dim: int
    horizon: int = 3
    size: Size = SIZES["5M"]
    simnorm_group: int = 8
    bins: twohot.Bins = field(default_factory=twohot.Bins)
    dropout: float = 0.01
    samples: int = 512
    elites: int = 64
    policy_samples: int = 24
    iterations: int | None = None
    sgft: bool = False
    train_encoder: bool = False

    def __post_init__(self) -> None:
        for name in ("obs_dim", "act_dim", "horizon", "simnorm_group"):
            if getattr(self, name) < 1:
                raise UserError(f"TD-MPC2 option {name} is {getattr(self, name)}: must be at least 1")
        if self.size.latent % self.simnorm_group:
            raise UserError(f"TD-MPC2 latent size {self.size.latent}: not a multiple of {self.simnorm_group=}")
        if self.size.members < 2:
            raise UserError(f"TD-MPC2 size members is {self.size.members}: targets take the lower of 2")
        if not 0 <= self.dropout < 1:
            raise UserError(f"TD-MPC2 option dropout is {self.dropout}: must be in [0, 1)")
        if not 0 <= self.policy_samples < self.samples:
            raise UserError(f"TD-MPC2 option policy_samples is {self.policy_samples}: must be in [0, {self.samples=})")
        if self.train_encoder and not self.sgft:
            raise UserError("TD-MPC2 option train_encoder belongs to sgft: without it the encoder always learns")
        _ = self.planner  # complains about the rest

    @property
    def planner(self) -> mppi.MPPIConfig:
        """The planner's part."""
        iterations = (8 if self.act_dim >= 20 else 6) if self.iterations is None else self.iterations
        return mppi.MPPIConfig(self.samples, self.elites, iterations)

    @property
    def learned(self) -> tuple[str, ...]:
        """The networks of the world model that learn; one limit on their gradients' common norm."""
        if not self.sgft:
            return ("encoder", "dynamics", "reward", "critic")
        return ("encoder", "dynamics", "reward") if self.train_encoder else ("dynamics", "reward")


def named_config(obs_dim: int, act_dim: int, *, size: str, plan_samples: int, **structure: Any) -> TDMPC2Config:
    """A configuration by the name of its size. plan_samples: of them an eighth are elites, 24 in 512 the policy's."""
    if size not in SIZES:
        raise UserError(unknown("size of TD-MPC2", size, SIZES))
    planner = {"samples": plan_samples, "elites": max(plan_samples // 8, 1), "policy_samples": plan_samples * 24 // 512}
    return TDMPC2Config(obs_dim, act_dim, size=SIZES[size], **planner, **structure)


class TDMPC2Hyper(NamedTuple):
    """The numbers of an agent, each [] (but for `planner`, which holds its own).

    lr: Adam learning rate, times encoder_lr_scale for the encoder. tau: averaging rate of target critic and scale.
    gamma: discount factor per step in plans; rows carry their own. rho: weight of a step relative to the one before.
    consistency, reward, value: weights of the losses. entropy: weight of the policy's scaled entropy.
    max_grad_norm: of the world model with the critic, and of the policy.
    """

    lr: float | Array = 3e-4
    encoder_lr_scale: float | Array = 0.3
    tau: float | Array = 0.01
    gamma: float | Array = 0.99
    rho: float | Array = 0.5
    consistency: float | Array = 20.0
    reward: float | Array = 0.1
    value: float | Array = 0.1
    entropy: float | Array = 1e-4
    max_grad_norm: float | Array = 20.0
    planner: mppi.MPPIHyper = mppi.MPPIHyper()


class TDMPC2State(struct.PyTreeNode):
    """An agent in training. anchor: the frozen policy of V_sim, None without sgft. scale: [] running value range."""

    encoder: optim.Fit
    dynamics: optim.Fit
    reward: optim.Fit
    policy: optim.Fit
    critic: optim.Fit
    target_critic: PyTree
    anchor: PyTree
    scale: Array
    normalizer: Normalizer
    hyper: TDMPC2Hyper
    step: Array


@struct.dataclass
class TDMPC2Prior:
    """What pretraining hands to fine-tuning: parameters, observation statistics, and the scale [] of values."""

    encoder: PyTree
    dynamics: PyTree
    reward: PyTree
    policy: PyTree
    critic: PyTree
    normalizer: Normalizer
    scale: Array


# --- networks -------------------------------------------------------------------------------------------------------


def simnorm(x: Array, group: int) -> Array:
    """Softmax within each group of `group` consecutive entries of x [latent]: latents are bounded and sparse."""
    return jax.nn.softmax(x.reshape(-1, group)).reshape(-1)


def mish(x: Array) -> Array:
    """Activation x tanh(softplus(x)) with one exponential: tanh(log(1 + e)) = w / (w + 2) for w = e (e + 2)."""
    e = jnp.exp(jnp.minimum(x, 20.0))  # from there on the factor is 1, and the exponential may overflow
    w = e * (e + 2)
    return x * (w / (w + 2))


class _Body(nn.Module):
    """Linear, dropout (first layer), LayerNorm, Mish; at the end linear alone, or linear, LayerNorm, SimNorm."""

    hidden: tuple[int, ...]
    outputs: int
    simnorm_group: int | None = None
    dropout: float = 0.0
    zero: bool = False

    @nn.compact
    def __call__(self, x: Array, *, train: bool) -> Array:
        """x: [inputs] -> [outputs]."""
        # Published as a truncated normal whose bounds, +-2, are 100 standard deviations away.
        weights = nn.initializers.normal(0.02)
        for layer, width in enumerate(self.hidden):
            x = nn.Dense(width, kernel_init=weights)(x)
            if layer == 0:
                x = nn.Dropout(self.dropout, deterministic=not train)(x)
            x = mish(nn.LayerNorm(epsilon=1e-5)(x))
        # Zeros that XLA cannot know to be zeros: in a program that makes constant ones and uses them (init and update
        # in one jit), jaxlib 0.12.0 for CPUs reads memory that nobody wrote, and losses are NaN at times.
        last = nn.initializers.normal(0.0) if self.zero else weights
        x = nn.Dense(self.outputs, kernel_init=last)(x)
        if self.simnorm_group is None:
            return x
        return simnorm(nn.LayerNorm(epsilon=1e-5)(x), self.simnorm_group)


class _Parts(NamedTuple):
    """The networks, each for one example, and the optimisers that a configuration describes.

    encoder(obs) -> z [latent]; dynamics(z, action) -> z; reward(z, action) -> [bins] logits;
    policy(z) -> [2, act_dim] pre-tanh mean and log-std; critic(z, action, key=None) -> [members, bins] logits, with
    dropout where there is a key.
    """

    encoder: Network
    dynamics: Network
    reward: Network
    policy: Network
    critic: Network
    adam: optax.GradientTransformation
    policy_adam: optax.GradientTransformation


def _parts(config: TDMPC2Config) -> _Parts:
    size, act_dim, group, bins = config.size, config.act_dim, config.simnorm_group, config.bins.count
    hidden = (size.mlp, size.mlp)
    policy = _network(_Body(hidden, 2 * act_dim), size.latent)

    def moments(params: PyTree, z: Array) -> Array:
        mean, x = jnp.split(policy.apply(params, z), 2)
        return jnp.stack([mean, LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (jnp.tanh(x) + 1)])

    return _Parts(
        encoder=_network(_Body((size.encoder,) * max(size.encoder_layers - 1, 1), size.latent, group), config.obs_dim),
        dynamics=_network(_Body(hidden, size.latent, group), size.latent + act_dim),
        reward=_network(_Body(hidden, bins, zero=True), size.latent + act_dim),
        policy=Network(policy.init, moments),
        critic=_ensemble(
            _network(_Body(hidden, bins, dropout=config.dropout, zero=True), size.latent + act_dim), size.members
        ),
        adam=optax.scale_by_adam(),
        policy_adam=optax.scale_by_adam(eps=1e-5),
    )


def _network(body: _Body, inputs: int) -> Network:
    def init(key: Key) -> PyTree:
        return body.init(key, jnp.zeros(inputs), train=False)["params"]

    def apply(params: PyTree, *parts: Array, key: Key | None = None) -> Array:
        rngs = None if key is None else {"dropout": key}
        return cast(Array, body.apply({"params": params}, jnp.concatenate(parts), train=key is not None, rngs=rngs))

    return Network(init, apply)


def _ensemble(member: Network, members: int) -> Network:
    def init(key: Key) -> PyTree:
        return jax.vmap(member.init)(jax.random.split(key, members))

    def apply(params: PyTree, *parts: Array, key: Key | None = None) -> Array:
        keys = None if key is None else jax.random.split(key, members)
        return jax.vmap(lambda p, k: member.apply(p, *parts, key=k))(params, keys)

    return Network(init, apply)


# --- values ---------------------------------------------------------------------------------------------------------


def _q(config: TDMPC2Config, parts: _Parts, params: PyTree, z: Array, action: Array, key: Key | None = None) -> Array:
    """Q [members] of every head, decoded."""
    return jax.vmap(lambda logits: twohot.decode(logits, config.bins))(parts.critic.apply(params, z, action, key=key))


def _two_heads(config: TDMPC2Config, key: Key) -> Array:
    """Two different heads of the critic at random: their indices [2]."""
    return jax.lax.top_k(jax.random.uniform(key, (config.size.members,)), 2)[1]


def _reward(config: TDMPC2Config, parts: _Parts, state: TDMPC2State, z: Array, action: Array) -> Array:
    return twohot.decode(parts.reward.apply(state.reward.params, z, action), config.bins)


def _v_sim(config: TDMPC2Config, parts: _Parts, state: TDMPC2State, z: Array) -> Array:
    """Mean over all heads at the policy's mean action (O-16): no draw, so that shaped rewards telescope."""
    policy = state.policy.params if state.anchor is None else state.anchor
    action = jnp.tanh(parts.policy.apply(policy, z)[0])
    return jnp.mean(_q(config, parts, state.critic.params, z, action))


def _encode(parts: _Parts, state: TDMPC2State, obs: Array) -> Array:
    """Latent [latent] of raw obs [obs_dim]."""
    return parts.encoder.apply(state.encoder.params, normalizer.normalize(state.normalizer, obs))


def value_of(config: TDMPC2Config, state: TDMPC2State, obs: Array) -> Array:
    """V_sim(obs) [], deterministic (O-16). obs: [obs_dim] raw.

    Full float32 on every device, as in `value.predict`: who shapes rewards takes small differences of it.
    """
    parts = _parts(config)
    with jax.default_matmul_precision("highest"):
        return _v_sim(config, parts, state, _encode(parts, state, obs))


def value_sample(config: TDMPC2Config, state: TDMPC2State, obs: Array, key: Key) -> Array:
    """V_sim(obs) [] as SGFT's released code has it: the lower of 2 random heads at an action drawn from the policy.

    Differs from call to call, so the potentials of consecutive shaped rewards do not cancel.
    """
    parts = _parts(config)
    key_heads, key_action = jax.random.split(key)
    policy = state.policy.params if state.anchor is None else state.anchor
    with jax.default_matmul_precision("highest"):
        z = _encode(parts, state, obs)
        action = tanh_gaussian_action(parts.policy.apply(policy, z), key_action, explore=True)
        return jnp.min(_q(config, parts, state.critic.params, z, action)[_two_heads(config, key_heads)])


# --- acting ---------------------------------------------------------------------------------------------------------


def policy_action(config: TDMPC2Config, state: TDMPC2State, obs: Array, key: Key, *, explore: bool) -> Array:
    """Action [act_dim] of the policy alone, some thousand times cheaper than a plan. obs: [obs_dim] raw."""
    parts = _parts(config)
    moments = parts.policy.apply(state.policy.params, _encode(parts, state, obs))
    return tanh_gaussian_action(moments, key, explore=explore)


def _plan(
    config: TDMPC2Config,
    parts: _Parts,
    state: TDMPC2State,
    previous: Array,
    obs: Array,
    key: Key,
    *,
    explore: bool | Array,
) -> tuple[Array, Array]:
    key_policy, key_score, key_search = jax.random.split(key, 3)
    z = _encode(parts, state, obs)
    keys = jax.random.split(key_policy, (config.horizon, config.policy_samples))
    proposals = jax.vmap(lambda keys: _proposal(parts, state, z, keys), in_axes=1)(keys)
    score = _score(config, parts, state, z, key_score)
    return mppi.plan(config.planner, state.hyper.planner, score, proposals, previous, key_search, explore=explore)


def _proposal(parts: _Parts, state: TDMPC2State, z: Array, keys: Key) -> Array:
    """Actions [H, act_dim] of the policy as the model sees the future; one of the keys [H] a step."""

    def step(z: Array, key: Key) -> tuple[Array, Array]:
        action = tanh_gaussian_action(parts.policy.apply(state.policy.params, z), key, explore=True)
        return parts.dynamics.apply(state.dynamics.params, z, action), action

    return jax.lax.scan(step, z, keys)[1]


def _score(config: TDMPC2Config, parts: _Parts, state: TDMPC2State, z: Array, key: Key) -> Callable[[Array], Array]:
    """What a plan [H, act_dim] from z promises: sum of gamma^t R, then gamma^H times a value.

    The value is V_sim with sgft (O-14), else the mean of 2 random heads at a drawn action. One draw for all candidates
    of a plan, where the original draws for each: they then compare by their actions, not by their luck.
    """
    key_heads, key_action = jax.random.split(key)
    heads, gamma = _two_heads(config, key_heads), state.hyper.gamma
    noise = jax.random.normal(key_action, (config.act_dim,))

    def final(z: Array) -> Array:
        if config.sgft:
            return _v_sim(config, parts, state, z)
        mean, log_std = parts.policy.apply(state.policy.params, z)
        return jnp.mean(_q(config, parts, state.critic.params, z, jnp.tanh(mean + jnp.exp(log_std) * noise))[heads])

    def step(carry: tuple[Array, Array], action: Array) -> tuple[tuple[Array, Array], Array]:
        z, weight = carry
        reward = weight * _reward(config, parts, state, z, action)
        return (parts.dynamics.apply(state.dynamics.params, z, action), weight * gamma), reward

    def score(actions: Array) -> Array:
        (last, weight), rewards = jax.lax.scan(step, (z, jnp.float32(1)), actions)
        return jnp.sum(rewards) + weight * final(last)

    return score


# --- one update -----------------------------------------------------------------------------------------------------


def _update(
    config: TDMPC2Config, parts: _Parts, state: TDMPC2State, batch: Sequences, key: Key
) -> tuple[TDMPC2State, Metrics]:
    """World model with critic, then the policy on the latents rolled out, then the target critic."""
    key_model, key_policy = jax.random.split(key)
    normal = jax.vmap(jax.vmap(normalizer.normalize, (None, 0)), (None, 0))
    obs, next_obs = (normal(state.normalizer, x) for x in (batch.rows.obs, batch.rows.next_obs))
    batch = batch._replace(rows=batch.rows._replace(obs=obs, next_obs=next_obs))

    state, zs, metrics = _update_model(config, parts, state, batch, key_model)
    state, more = _update_policy(config, parts, state, zs, batch.valid, key_policy)
    if not config.sgft:
        average = optax.incremental_update(state.critic.params, state.target_critic, state.hyper.tau)
        state = state.replace(target_critic=average)
    return state.replace(step=state.step + 1), metrics | more


def _update_model(
    config: TDMPC2Config, parts: _Parts, state: TDMPC2State, batch: Sequences, key: Key
) -> tuple[TDMPC2State, Array, Metrics]:
    """Also returns the latents [B, H + 1, latent] rolled out by the model as it was."""
    key_heads, key_action, key_dropout = jax.random.split(key, 3)
    heads, hyper = _two_heads(config, key_heads), state.hyper

    def target(row: Transition, key: Key) -> tuple[Array, Array]:
        # The successor's latent is encoded, while losses are taken at rolled-out ones.
        ahead = parts.encoder.apply(state.encoder.params, row.next_obs)
        action = tanh_gaussian_action(parts.policy.apply(state.policy.params, ahead), key, explore=True)
        return ahead, row.reward + row.discount * jnp.min(_q(config, parts, state.target_critic, ahead, action)[heads])

    keys = jax.random.split(key_action, batch.valid.shape)
    ahead, q_target = jax.vmap(jax.vmap(target))(batch.rows, keys)
    dropout = jax.random.split(key_dropout, batch.valid.shape)
    frozen = {name: getattr(state, name).params for name in _NETWORKS}

    def loss(learned: dict[str, PyTree]) -> tuple[Array, tuple[dict[str, Array], Array]]:
        one = lambda *window: _window_losses(config, parts, frozen | learned, *window)  # noqa: E731
        each, zs = jax.vmap(one)(batch.rows, ahead, q_target, dropout)
        mean = {name: discounted_mean(x, batch.valid, hyper.rho) for name, x in each.items()}
        return sum((getattr(hyper, name) * x for name, x in mean.items()), jnp.float32(0)), (mean, zs)

    fits = {name: getattr(state, name) for name in config.learned}
    grads, (mean, zs) = jax.grad(loss, has_aux=True)({name: fit.params for name, fit in fits.items()})
    grads, norm = clip_by_norm(grads, hyper.max_grad_norm)
    rates = {name: hyper.lr * (hyper.encoder_lr_scale if name == "encoder" else 1.0) for name in fits}
    fits = {name: optim.step(parts.adam, fit, grads[name], rates[name]) for name, fit in fits.items()}
    metrics = {f"model/{name}_loss": x for name, x in mean.items()} | {"model/grad_norm": norm}
    if not config.sgft:
        metrics["critic/target_mean"] = jnp.mean(q_target, where=batch.valid)
    return state.replace(**fits), zs, metrics


def _window_losses(
    config: TDMPC2Config,
    parts: _Parts,
    params: dict[str, PyTree],
    rows: Transition,
    ahead: Array,
    q_target: Array,
    dropout: Key,
) -> tuple[dict[str, Array], Array]:
    """Losses [H] of one window, by the name of their weight, and its rolled-out latents [H + 1, latent].

    rows: [H, ...]; ahead: [H, latent] encoded successors; q_target: [H]; dropout: [H] keys.
    """

    def advance(z: Array, action: Array) -> tuple[Array, Array]:
        z = parts.dynamics.apply(params["dynamics"], z, action)
        return z, z

    def classify(logits: Array, x: Array) -> Array:
        return twohot.cross_entropy(logits, x, config.bins)

    def value(z: Array, action: Array, target: Array, key: Key) -> Array:
        logits = parts.critic.apply(params["critic"], z, action, key=key)
        return jnp.mean(jax.vmap(classify, (0, None))(logits, target))

    first = parts.encoder.apply(params["encoder"], rows.obs[0])
    rolled = jax.lax.scan(advance, first, rows.action)[1]
    zs = jnp.concatenate([first[None], rolled])
    logits = jax.vmap(parts.reward.apply, (None, 0, 0))(params["reward"], zs[:-1], rows.action)
    losses = {"consistency": jnp.mean((rolled - ahead) ** 2, axis=1), "reward": jax.vmap(classify)(logits, rows.reward)}
    if not config.sgft:
        losses["value"] = jax.vmap(value)(zs[:-1], rows.action, q_target, dropout)
    return losses, zs


def discounted_mean(values: Array, valid: Array, rho: Array | float) -> Array:
    """Mean [] over the valid of values [B, T], step t weighing rho^t; with all valid, 1/T sum_t rho^t mean_B."""
    decay = rho ** jnp.arange(values.shape[1])
    weights = valid * decay[None]
    return jnp.mean(decay) * jnp.sum(jnp.where(valid, values, 0.0) * weights) / jnp.maximum(jnp.sum(weights), 1e-6)


def clip_by_norm(grads: PyTree, limit: Array | float) -> tuple[PyTree, Array]:
    """The gradients, scaled down to a global norm of at most `limit` [], and the norm [] they had."""
    norm = optax.tree.norm(grads)
    factor = jnp.minimum(1.0, limit / (norm + 1e-6))
    return jax.tree.map(lambda g: g * factor, grads), norm


def _update_policy(
    config: TDMPC2Config, parts: _Parts, state: TDMPC2State, zs: Array, valid: Array, key: Key
) -> tuple[TDMPC2State, Metrics]:
    """zs: [B, H + 1, latent]; valid: [B, H] of the steps between them."""
    key_heads, key_action, key_dropout = jax.random.split(key, 3)
    heads, hyper = _two_heads(config, key_heads), state.hyper
    reached = jnp.concatenate([valid[:, :1], valid], axis=1)
    keys = jax.random.split(key_action, reached.shape), jax.random.split(key_dropout, reached.shape)

    def one(params: PyTree, z: Array, key: Key, dropout: Key) -> tuple[Array, Array]:
        action, entropy = scaled_entropy_sample(parts.policy.apply(params, z), key)
        return _promise(config, parts, state, z, action, heads, dropout), entropy

    def loss(params: PyTree) -> tuple[Array, tuple[Array, Array, Array]]:
        each = jax.vmap(jax.vmap(one, (None, 0, 0, 0)), (None, 0, 0, 0))
        value, entropy = each(params, zs, *keys)
        low, high = jnp.quantile(jax.lax.stop_gradient(value[:, 0]), jnp.array([0.05, 0.95]))
        scale = state.scale + hyper.tau * (jnp.maximum(high - low, 1.0) - state.scale)
        losses = -value / scale - hyper.entropy * entropy
        return discounted_mean(losses, reached, hyper.rho), (value, entropy, scale)

    (total, (value, entropy, scale)), grads = jax.value_and_grad(loss, has_aux=True)(state.policy.params)
    grads, norm = clip_by_norm(grads, hyper.max_grad_norm)
    fit = optim.step(parts.policy_adam, state.policy, grads, hyper.lr)
    metrics = {
        "actor/loss": total,
        "actor/value_mean": jnp.mean(value, where=reached),
        "actor/entropy": jnp.mean(entropy, where=reached) / config.act_dim,
        "actor/scale": scale,
        "actor/grad_norm": norm,
    }
    return state.replace(policy=fit, scale=scale), metrics


def _promise(
    config: TDMPC2Config, parts: _Parts, state: TDMPC2State, z: Array, action: Array, heads: Array, dropout: Key
) -> Array:
    """What the policy maximises []: Q by two random heads, or one step of the model to V_sim."""
    if not config.sgft:
        return jnp.mean(_q(config, parts, state.critic.params, z, action, dropout)[heads])
    ahead = parts.dynamics.apply(state.dynamics.params, z, action)
    return _reward(config, parts, state, z, action) + state.hyper.gamma * _v_sim(config, parts, state, ahead)


def scaled_entropy_sample(moments: Array, key: Key) -> tuple[Array, Array]:
    """An action [act_dim] of the policy, with gradients, and its scaled entropy [].

    moments: [2, act_dim] pre-tanh mean and log-std. The scaled entropy is -act_dim times the Gaussian log-density
    before the tanh: what the quotient of log-densities in the original comes to.
    """
    mean, log_std = moments
    noise = jax.random.normal(key, mean.shape)
    log_prob = jnp.sum(-0.5 * noise**2 - log_std - 0.5 * jnp.log(2 * jnp.pi))
    return jnp.tanh(mean + jnp.exp(log_std) * noise), -mean.shape[0] * log_prob


# --- the learner ----------------------------------------------------------------------------------------------------


def make_tdmpc2(config: TDMPC2Config, hyper: TDMPC2Hyper | None = None) -> Learner:
    """The learner of a configuration: `update` takes `Sequences` [B, horizon], the carry is the last plan's mean.

    Start every episode with `init_carry()`. Set the observation statistics with `state.replace(normalizer=...)`.
    """
    parts = _parts(config)
    hyper = hyper or TDMPC2Hyper()

    def init(key: Key) -> TDMPC2State:
        keys = dict(zip(_NETWORKS, jax.random.split(key, len(_NETWORKS)), strict=True))
        params = {name: getattr(parts, name).init(keys[name]) for name in _NETWORKS}
        statistics = normalizer.identity(config.obs_dim)
        return _assemble(config, parts, hyper, TDMPC2Prior(**params, normalizer=statistics, scale=jnp.float32(1)))

    def act(state: TDMPC2State, carry: Array, obs: Array, key: Key, *, explore: bool | Array) -> tuple[Array, Array]:
        return _plan(config, parts, state, carry, obs, key, explore=explore)

    def update(state: TDMPC2State, batch: Any, key: Key) -> tuple[TDMPC2State, Metrics]:
        if batch.valid.shape[1] != config.horizon:
            raise UserError(f"TD-MPC2 windows have {batch.valid.shape[1]} steps: must be the horizon, {config.horizon}")
        return _update(config, parts, state, batch, key)

    return Learner(init, lambda: jnp.zeros((config.horizon, config.act_dim)), act, update)


def _assemble(config: TDMPC2Config, parts: _Parts, hyper: TDMPC2Hyper, prior: TDMPC2Prior) -> TDMPC2State:
    """Fresh moments around given parameters (O-9)."""
    start = lambda name: optim.start(  # noqa: E731
        parts.policy_adam if name == "policy" else parts.adam, getattr(prior, name)
    )
    return TDMPC2State(
        **{name: start(name) for name in _NETWORKS},
        target_critic=jax.tree.map(jnp.copy, prior.critic),  # own buffers: a donated state must not hold one twice
        anchor=jax.tree.map(jnp.copy, prior.policy) if config.sgft else None,
        scale=prior.scale,
        normalizer=prior.normalizer,
        hyper=jax.tree.map(lambda x: jnp.asarray(x, jnp.float32), hyper),
        step=jnp.int32(0),
    )


# --- between simulation and reality ---------------------------------------------------------------------------------


def extract_prior(state: TDMPC2State) -> TDMPC2Prior:
    """What a pretrained agent hands over."""
    params = {name: getattr(state, name).params for name in _NETWORKS}
    return TDMPC2Prior(**params, normalizer=state.normalizer, scale=state.scale)


def fine_tune_state(config: TDMPC2Config, hyper: TDMPC2Hyper, prior_params: TDMPC2Prior, key: Key) -> TDMPC2State:
    """An agent that starts from a prior: all its networks, its normaliser (frozen), fresh Adam moments (O-9).

    With `config.sgft` its policy becomes the anchor of V_sim. The horizon may differ from the prior's. `key` is there
    as in other learners; nothing is drawn.
    """
    del key
    check_prior(config, prior_params)
    return _assemble(config, _parts(config), hyper, jax.tree.map(jnp.copy, prior_params))  # the prior must survive it


def check_prior(config: TDMPC2Config, prior: TDMPC2Prior) -> None:
    """Raise UserError where a network of the prior is not the one that `config` describes."""
    parts = _parts(config)
    owner = f"obs_dim {config.obs_dim}, act_dim {config.act_dim}, {config.size}"
    for name in _NETWORKS:
        check_params(name, getattr(parts, name), getattr(prior, name), f"{owner}: use the prior's own task and size")
