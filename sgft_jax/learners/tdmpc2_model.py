"""What TD-MPC2 is made of: configuration, state, the networks of its world model, and the values they promise.

Structure (shapes, what learns) is static in `TDMPC2Config`; every number is a leaf of the state in `TDMPC2Hyper`, so
that they vmap like seeds do. Source: Hansen et al. 2024; SGFT section 8.4.
"""

import itertools
from dataclasses import dataclass, field
from typing import Any, NamedTuple, cast

import jax
import jax.numpy as jnp
import optax
from flax import linen as nn
from flax import struct

from envs.types import Array, Key, PyTree, UserError, unknown
from sgft_jax import checks, planning
from sgft_jax.math import optim
from sgft_jax.models import normalizer, twohot
from sgft_jax.models.config import SIZES, Size
from sgft_jax.models.networks import Network, ensemble, precision, tanh_gaussian_action
from sgft_jax.types import Normalizer

LOG_STD_MIN, LOG_STD_MAX = -10.0, 2.0
NETWORKS = ("encoder", "dynamics", "reward", "policy", "critic")


@dataclass(frozen=True)
class TDMPC2Config(checks.Checked):
    """The structure of an agent.

    obs_dim, act_dim: sizes of what the environment gives and takes. horizon: steps of plans and of training windows.
    size: one of `SIZES`, or another. simnorm_group: latent entries per group of SimNorm. bins: of reward and critic.
    dropout: rate after the critic's first layer, in training only.
    samples, elites, policy_samples, iterations: of the planner; policy_samples are sequences proposed by the policy;
        iterations None = 6, and 8 from 20 action entries on.
    sgft: encoder, critic and a copy of the first policy never change. They make V_sim, the frozen value that ends plans
        and teaches the policy; dynamics, reward head and policy learn. False: everything learns, as published.
    """

    obs_dim: checks.Count
    act_dim: checks.Count
    horizon: checks.Count = 3
    size: Size = SIZES["5M"]
    simnorm_group: checks.Count = 8
    bins: twohot.Bins = field(default_factory=twohot.Bins)
    dropout: checks.BelowOne = 0.01
    samples: int = 512
    elites: int = 64
    policy_samples: int = 24
    iterations: int | None = None
    sgft: bool = False

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.size.latent % self.simnorm_group:
            raise UserError(f"TD-MPC2 latent size {self.size.latent}: not a multiple of {self.simnorm_group=}")
        if self.size.members < 2:
            raise UserError(f"TD-MPC2 size members is {self.size.members}: targets take the lower of 2")
        if not 0 <= self.policy_samples < self.samples:
            raise checks.refusal("policy_samples", self.policy_samples, f"from 0 to less than samples, {self.samples}")
        _ = self.planner  # complains about the rest

    @property
    def planner(self) -> planning.MPPIConfig:
        """The planner's part."""
        iterations = (8 if self.act_dim >= 20 else 6) if self.iterations is None else self.iterations
        return planning.MPPIConfig(self.samples, self.elites, iterations)

    @property
    def learned(self) -> tuple[str, ...]:
        """The networks of the world model that learn; one limit on their gradients' common norm."""
        return ("dynamics", "reward") if self.sgft else ("encoder", "dynamics", "reward", "critic")


def named_config(obs_dim: int, act_dim: int, *, size: str, plan_samples: int, **structure: Any) -> TDMPC2Config:
    """A configuration by the name of its size. plan_samples: of them an eighth are elites, 24 in 512 the policy's."""
    if size not in SIZES:
        raise UserError(unknown("size of TD-MPC2", size, SIZES))
    planner = {"samples": plan_samples, "elites": max(plan_samples // 8, 1), "policy_samples": plan_samples * 24 // 512}
    return TDMPC2Config(obs_dim, act_dim, size=SIZES[size], **planner, **structure)


class TDMPC2Hyper(NamedTuple):
    """The numbers of an agent, each [] (but for `planner`, which holds its own).

    lr: Adam learning rate, times encoder_lr_scale for the encoder. lr_warmup: updates over which it rises linearly
        from 0. tau: averaging rate of target critic and scale.
    gamma: discount factor per step in plans; rows carry their own. rho: weight of a step relative to the one before.
    consistency, reward, value: weights of the losses. entropy: weight of the policy's scaled entropy.
    max_grad_norm: of the world model with the critic, and of the policy.
    """

    lr: float | Array = 3e-4
    lr_warmup: float | Array = 0.0
    encoder_lr_scale: float | Array = 0.3
    tau: float | Array = 0.01
    gamma: float | Array = 0.99
    rho: float | Array = 0.5
    consistency: float | Array = 20.0
    reward: float | Array = 0.1
    value: float | Array = 0.1
    entropy: float | Array = 1e-4
    max_grad_norm: float | Array = 20.0
    planner: planning.MPPIHyper = planning.MPPIHyper()


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


class TDMPC2Params(NamedTuple):
    """What pretraining hands to fine-tuning: parameters, observation statistics, and the scale [] of values.

    anchor: the policy of V_sim where that is another one than `policy`: what `sgft` leaves.
    """

    encoder: PyTree
    dynamics: PyTree
    reward: PyTree
    policy: PyTree
    critic: PyTree
    normalizer: Normalizer
    scale: Array
    anchor: PyTree = None


# --- networks -------------------------------------------------------------------------------------------------------


def simnorm(x: Array, group: int) -> Array:
    """Softmax within each group of `group` consecutive entries of x [latent]: latents are bounded and sparse."""
    return jax.nn.softmax(x.reshape(-1, group)).reshape(-1)


def mish(x: Array) -> Array:
    """Activation x tanh(softplus(x)) with one exponential: tanh(log(1 + e)) = w / (w + 2) for w = e (e + 2)."""
    e = jnp.exp(jnp.minimum(x, 20.0))  # from there on the factor is 1, and the exponential may overflow
    w = e * (e + 2)
    return x * (w / (w + 2))


class _Dense(nn.Module):
    """A linear layer of several vectors, as of one that holds them all.

    Each has its own product: rows that share a vector then share its product, and widths such as 512 + 2 would keep
    GPUs from their fast matrix products.
    """

    width: int
    weights: nn.initializers.Initializer

    @nn.compact
    def __call__(self, *parts: Array) -> Array:
        """parts: [inputs] each -> [width]."""
        sizes = [len(part) for part in parts]
        kernel = self.param("kernel", self.weights, (sum(sizes), self.width))
        bias = self.param("bias", nn.initializers.zeros, (self.width,))
        rows = jnp.split(kernel, list(itertools.accumulate(sizes[:-1])))
        return sum((part @ weights for part, weights in zip(parts, rows, strict=True)), bias)


class _Body(nn.Module):
    """Linear, dropout (first layer), LayerNorm, Mish; at the end linear alone, or linear, LayerNorm, SimNorm."""

    hidden: tuple[int, ...]
    outputs: int
    simnorm_group: int | None = None
    dropout: float = 0.0
    zero: bool = False

    @nn.compact
    def __call__(self, *parts: Array, train: bool) -> Array:
        """parts: [inputs] each -> [outputs]."""
        # Published as a truncated normal whose bounds, +-2, are 100 standard deviations away.
        weights = nn.initializers.normal(0.02)
        for layer, width in enumerate(self.hidden):
            x = _Dense(width, weights, name=f"Dense_{layer}")(*parts)
            if layer == 0:
                x = nn.Dropout(self.dropout, deterministic=not train)(x)
            parts = (mish(nn.LayerNorm(epsilon=1e-5)(x)),)
        # Zeros that XLA cannot know to be zeros: in a program that makes constant ones and uses them (init and update
        # in one jit), jaxlib 0.12.0 for CPUs reads memory that nobody wrote, and losses are NaN at times.
        last = nn.initializers.normal(0.0) if self.zero else weights
        x = _Dense(self.outputs, last, name=f"Dense_{len(self.hidden)}")(*parts)
        if self.simnorm_group is None:
            return x
        return simnorm(nn.LayerNorm(epsilon=1e-5)(x), self.simnorm_group)


class Networks(NamedTuple):
    """A configuration with the networks, each for one example, and the optimisers that it describes.

    encoder(obs) -> z [latent]; dynamics(z, action) -> z; reward(z, action) -> [bins] logits;
    policy(z) -> [2, act_dim] pre-tanh mean and log-std; critic(z, action, keys=None) -> [members, bins] logits, with
    dropout where there are keys, one for each member. Any slice of the critic's parameters is one, too.
    """

    config: TDMPC2Config
    encoder: Network
    dynamics: Network
    reward: Network
    policy: Network
    critic: Network
    adam: optax.GradientTransformation
    policy_adam: optax.GradientTransformation


def make_networks(config: TDMPC2Config) -> Networks:
    """The networks and optimisers of a configuration."""
    size, act_dim, group, bins = config.size, config.act_dim, config.simnorm_group, config.bins.count
    hidden = (size.mlp, size.mlp)
    policy = _network(_Body(hidden, 2 * act_dim), size.latent)
    head = _Body(hidden, bins, dropout=config.dropout, zero=True)  # of the critic

    def moments(params: PyTree, z: Array) -> Array:
        mean, x = jnp.split(policy.apply(params, z), 2)
        return jnp.stack([mean, LOG_STD_MIN + 0.5 * (LOG_STD_MAX - LOG_STD_MIN) * (jnp.tanh(x) + 1)])

    return Networks(
        config=config,
        encoder=_network(_Body((size.encoder,) * max(size.encoder_layers - 1, 1), size.latent, group), config.obs_dim),
        dynamics=_network(_Body(hidden, size.latent, group), size.latent + act_dim),
        reward=_network(_Body(hidden, bins, zero=True), size.latent + act_dim),
        policy=Network(policy.init, moments),
        critic=ensemble(_network(head, size.latent + act_dim), size.members),
        adam=optax.scale_by_adam(),
        policy_adam=optax.scale_by_adam(eps=1e-5),
    )


def _network(body: _Body, inputs: int) -> Network:
    def init(key: Key) -> PyTree:
        return body.init(key, jnp.zeros(inputs), train=False)["params"]

    def apply(params: PyTree, *parts: Array, key: Key | None = None) -> Array:
        rngs = None if key is None else {"dropout": key}
        return cast(Array, body.apply({"params": params}, *parts, train=key is not None, rngs=rngs))

    return Network(init, apply)


# --- values ---------------------------------------------------------------------------------------------------------


def q_values(nets: Networks, params: PyTree, z: Array, action: Array, keys: Key | None = None) -> Array:
    """Q [heads] of every head that `params` hold, decoded; keys: [heads] of their dropout."""
    return jax.vmap(lambda logits: twohot.decode(logits, nets.config.bins))(
        nets.critic.apply(params, z, action, keys=keys)
    )


def two_heads(config: TDMPC2Config, key: Key) -> Array:
    """Two different heads of the critic at random: their indices [2]."""
    return jax.lax.top_k(jax.random.uniform(key, (config.size.members,)), 2)[1]


def heads_of(params: PyTree, heads: Array) -> PyTree:
    """The parameters of some heads [n] of a critic: the others then cost nothing."""
    return jax.tree.map(lambda x: x[heads], params)


def reward_of(nets: Networks, state: TDMPC2State, z: Array, action: Array) -> Array:
    """Reward [] of an action in latent z, decoded."""
    return twohot.decode(nets.reward.apply(state.reward.params, z, action), nets.config.bins)


def v_sim(nets: Networks, state: TDMPC2State, z: Array) -> Array:
    """Mean over all heads at the policy's mean action: no draw, so that shaped rewards telescope."""
    policy = state.policy.params if state.anchor is None else state.anchor
    action = jnp.tanh(nets.policy.apply(policy, z)[0])
    return jnp.mean(q_values(nets, state.critic.params, z, action))


def encode(nets: Networks, state: TDMPC2State, obs: Array) -> Array:
    """Latent [latent] of raw obs [obs_dim]."""
    return nets.encoder.apply(state.encoder.params, normalizer.normalize(state.normalizer, obs))


def value_of(config: TDMPC2Config, state: TDMPC2State, obs: Array) -> Array:
    """V_sim(obs) [], deterministic. obs: [obs_dim] raw.

    Full float32 on every device, as in `value.predict`: who shapes rewards takes small differences of it.
    """
    nets = make_networks(config)
    with precision("float32"):
        return v_sim(nets, state, encode(nets, state, obs))


def value_sample(config: TDMPC2Config, state: TDMPC2State, obs: Array, key: Key) -> Array:
    """V_sim(obs) [] as SGFT's released code has it: the lower of 2 random heads at an action drawn from the policy.

    Differs from call to call, so the potentials of consecutive shaped rewards do not cancel. All heads are evaluated:
    it is one value for each draw, and copying the parameters of two heads would take longer.
    """
    nets = make_networks(config)
    key_heads, key_action = jax.random.split(key)
    policy = state.policy.params if state.anchor is None else state.anchor
    with precision("float32"):
        z = encode(nets, state, obs)
        action = tanh_gaussian_action(nets.policy.apply(policy, z), key_action, explore=True)
        return jnp.min(q_values(nets, state.critic.params, z, action)[two_heads(config, key_heads)])
