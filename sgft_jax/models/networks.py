"""Network bodies as pure `init` / `apply` pairs for one example, and the tanh-Gaussian policy distribution."""

import contextlib
from collections.abc import Callable
from typing import NamedTuple, cast

import jax
import jax.numpy as jnp
from flax import linen as nn

from envs.types import Array, Key, PyTree, UserError
from sgft_jax.models.config import NetworkConfig, Precision

LOG_STD_MIN, LOG_STD_MAX = -5.0, 2.0

_ACTIVATIONS: dict[str, Callable[[Array], Array]] = {"relu": nn.relu, "tanh": nn.tanh, "silu": nn.silu, "elu": nn.elu}

_MATMUL: dict[Precision, str] = {"default": "default", "float32": "highest", "bfloat16": "BF16_BF16_F32"}


def precision(name: Precision) -> contextlib.AbstractContextManager:
    """How exactly the matrix products that are traced in a `with` block read their inputs; sums always are float32.

    default: what JAX does, TF32 with 10 bits of mantissa on GPUs that have it. float32: all 23 bits. bfloat16: 7 bits.
    CPUs compute in float32 whatever is asked for.
    """
    return jax.default_matmul_precision(_MATMUL[name])


class Network(NamedTuple):
    """init(key) -> params; apply(params, *inputs) -> outputs for one example."""

    init: Callable[[Key], PyTree]
    apply: Callable[..., Array]


class MLP(nn.Module):
    """Linear layers with optional LayerNorm before each activation, and a linear output layer.

    output_gain: of Xavier's uniform initialisation of the output layer, None = Flax's default.
    """

    hidden: tuple[int, ...]
    outputs: int
    layer_norm: bool
    activation: str
    output_gain: float | None = None

    @nn.compact
    def __call__(self, x: Array) -> Array:
        """x: [inputs] -> [outputs]."""
        for width in self.hidden:
            x = nn.Dense(width)(x)
            if self.layer_norm:
                x = nn.LayerNorm()(x)
            x = _ACTIVATIONS[self.activation](x)
        if self.output_gain is None:
            return nn.Dense(self.outputs)(x)
        small = nn.initializers.variance_scaling(self.output_gain**2, "fan_avg", "uniform")
        return nn.Dense(self.outputs, kernel_init=small)(x)


def make_mlp(
    inputs: int, outputs: int, config: NetworkConfig, *, layer_norm: bool, output_gain: float | None = None
) -> Network:
    """apply(params, *parts) -> [outputs]; the parts, joined, are [inputs]. layer_norm, output_gain: of `MLP`."""
    body = MLP(config.hidden, outputs, layer_norm, config.activation, output_gain)

    def init(key: Key) -> PyTree:
        return body.init(key, jnp.zeros(inputs))["params"]

    def apply(params: PyTree, *parts: Array) -> Array:
        return cast(Array, body.apply({"params": params}, jnp.concatenate(parts)))

    return Network(init, apply)


def ensemble(member: Network, members: int) -> Network:
    """Stack `members` parameter sets on a leading axis; apply sends one input through all of them.

    keys: one for each member of a network that draws, else None.
    """

    def init(key: Key) -> PyTree:
        return jax.vmap(member.init)(jax.random.split(key, members))

    def apply(params: PyTree, *parts: Array, keys: Key | None = None) -> Array:
        if keys is None:
            return jax.vmap(lambda p: member.apply(p, *parts))(params)
        return jax.vmap(lambda p, key: member.apply(p, *parts, key=key))(params, keys)

    return Network(init, apply)


def make_actor(obs_dim: int, act_dim: int, config: NetworkConfig) -> Network:
    """apply(params, obs [obs_dim]) -> [2, act_dim]: pre-tanh mean and clipped log standard deviation."""
    seen = obs_dim - config.blind
    body = make_mlp(seen, 2 * act_dim, config, layer_norm=config.actor_layer_norm)

    def apply(params: PyTree, obs: Array) -> Array:
        mean, log_std = jnp.split(body.apply(params, obs[:seen]), 2)
        return jnp.stack([mean, jnp.clip(log_std, LOG_STD_MIN, LOG_STD_MAX)])

    return Network(body.init, apply)


def make_affine_actor(obs_dim: int, act_dim: int, config: NetworkConfig, *, output_gain: float) -> Network:
    """As `make_actor`, with log std = scale * output + offset, clipped to [-20, 2].

    scale and offset are learnt numbers that begin at 1 and -1: a std of about 0.37. output_gain: of `MLP`.
    Source: the released code of H2O+ (Niu et al. 2023).
    """
    body = make_mlp(obs_dim, 2 * act_dim, config, layer_norm=config.actor_layer_norm, output_gain=output_gain)

    def init(key: Key) -> PyTree:
        return {"body": body.init(key), "scale": jnp.float32(1.0), "offset": jnp.float32(-1.0)}

    def apply(params: PyTree, obs: Array) -> Array:
        mean, output = jnp.split(body.apply(params["body"], obs), 2)
        return jnp.stack([mean, jnp.clip(params["scale"] * output + params["offset"], -20.0, LOG_STD_MAX)])

    return Network(init, apply)


def make_deterministic_actor(obs_dim: int, act_dim: int, config: NetworkConfig) -> Network:
    """apply(params, obs [obs_dim]) -> [act_dim] in (-1, 1)."""
    body = make_mlp(obs_dim, act_dim, config, layer_norm=config.actor_layer_norm)
    return Network(body.init, lambda params, obs: jnp.tanh(body.apply(params, obs)))


def make_critic(
    obs_dim: int, act_dim: int, config: NetworkConfig, *, members: int = 2, output_gain: float | None = None
) -> Network:
    """apply(params, obs [obs_dim], action [act_dim]) -> [members] values. output_gain: of `MLP`."""
    member = make_mlp(obs_dim + act_dim, 1, config, layer_norm=config.layer_norm, output_gain=output_gain)
    body = ensemble(member, members)
    return Network(body.init, lambda params, obs, action: body.apply(params, obs, action)[:, 0])


def make_value(obs_dim: int, config: NetworkConfig, *, output_gain: float | None = None) -> Network:
    """apply(params, obs [obs_dim]) -> []. output_gain: of `MLP`."""
    body = make_mlp(obs_dim, 1, config, layer_norm=config.layer_norm, output_gain=output_gain)
    return Network(body.init, lambda params, obs: body.apply(params, obs)[0])


def make_dynamics(obs_dim: int, act_dim: int, config: NetworkConfig, *, members: int = 5) -> Network:
    """apply(params, obs [obs_dim], action [act_dim]) -> [members, obs_dim] change of the normalised observation.

    The number of members applied is the leading axis of `params`, so any slice of the ensemble is one too.
    """
    return ensemble(make_mlp(obs_dim + act_dim, obs_dim, config, layer_norm=False), members)


def tanh_gaussian_sample(moments: Array, key: Key) -> tuple[Array, Array]:
    """Draw a = tanh(u), u ~ N(mean, std), with gradients through the draw.

    moments: [2, act_dim] mean and log-std. Returns action [act_dim] in [-1, 1] and log pi(a) [].
    """
    mean, log_std = moments
    u = mean + jnp.exp(log_std) * jax.random.normal(key, mean.shape)
    return jnp.tanh(u), tanh_gaussian_log_prob(moments, u)


def tanh_gaussian_log_prob(moments: Array, u: Array) -> Array:
    """Log density of a = tanh(u), given u [act_dim] because atanh(a) has lost its digits near the bounds.

    log(1 - tanh(u)^2) is computed as 2 (log 2 - u - softplus(-2u)), which does not round to log(0).
    """
    mean, log_std = moments
    normal = -0.5 * ((u - mean) * jnp.exp(-log_std)) ** 2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    squash = 2 * (jnp.log(2.0) - u - jax.nn.softplus(-2 * u))
    return jnp.sum(normal - squash)


def untanh(action: Array) -> Array:
    """[act_dim] u with tanh(u) = action; what has rounded to a bound becomes the last float inside it, 8.7 or -8.7.

    In float32 it is right to 0.001 where |u| < 5.
    """
    last = 1.0 - 2.0**-24
    return jnp.arctanh(jnp.clip(action, -last, last))


def tanh_gaussian_divergence(moments: Array, others: Array) -> Array:
    """KL(moments || others) [], nats: of the Gaussians, which tanh leaves as it is.

    moments, others: [2, act_dim] mean and log-std.
    """
    mean, log_std = moments
    other_mean, other_log_std = others
    scaled = jnp.exp(2 * (log_std - other_log_std)) + ((mean - other_mean) * jnp.exp(-other_log_std)) ** 2
    return jnp.sum(other_log_std - log_std + 0.5 * (scaled - 1.0))


def add_noise(action: Array, std: Array | float, key: Key) -> Array:
    """An action [act_dim] in [-1, 1] with Gaussian noise, cut off at the bounds. std: [] or [act_dim]."""
    return jnp.clip(action + std * jax.random.normal(key, action.shape), -1.0, 1.0)


def tanh_gaussian_action(moments: Array, key: Key, *, explore: bool | Array) -> Array:
    """[act_dim]: a draw to explore, else tanh(mean). `explore` may be traced."""
    return jnp.where(explore, tanh_gaussian_sample(moments, key)[0], jnp.tanh(moments[0]))


def pad_first_layer(params: PyTree, obs_dim: int, extra: int) -> PyTree:
    """Let a network read `extra` more observation entries after the first `obs_dim` without changing its output.

    The new rows of the first kernel are zero, so whatever the new entries hold, the function stays the same at first
    and the rows still receive gradients. Works for stacked parameters (kernel [..., inputs, width]).
    """
    kernel = params["Dense_0"]["kernel"]
    rows = jnp.zeros((*kernel.shape[:-2], extra, kernel.shape[-1]), kernel.dtype)
    padded = jnp.concatenate([kernel[..., :obs_dim, :], rows, kernel[..., obs_dim:, :]], axis=-2)
    return {**params, "Dense_0": {**params["Dense_0"], "kernel": padded}}


def fix_first_layer(params: PyTree, obs_dim: int, extra: Array) -> PyTree:
    """The inverse of `pad_first_layer`: a network that reads `obs_dim` entries, the ones after them fixed to `extra`.

    extra: [entries]. What these contribute goes into the first bias. Works for stacked parameters, too.
    """
    layer = params["Dense_0"]
    kept, fixed, rest = jnp.split(layer["kernel"], [obs_dim, obs_dim + len(extra)], axis=-2)
    bias = layer["bias"] + jnp.einsum("i,...ij->...j", extra, fixed)
    return {**params, "Dense_0": {"kernel": jnp.concatenate([kept, rest], axis=-2), "bias": bias}}


def check_params(name: str, network: Network, params: PyTree, owner: str) -> None:
    """Raise UserError where the parameters of a prior are not those of `network`; owner: whose they ought to be."""
    expected = jax.eval_shape(network.init, jax.random.key(0))
    wanted, got = _shapes(expected), _shapes(params)
    if wanted != got:
        where = next(k for k in sorted(wanted | got) if wanted.get(k) != got.get(k))
        raise UserError(f"prior {name}{where} has shape {got.get(where)}, expected {wanted.get(where)} for {owner}")


def _shapes(params: PyTree) -> dict[str, tuple[int, ...]]:
    return {jax.tree_util.keystr(path): leaf.shape for path, leaf in jax.tree_util.tree_leaves_with_path(params)}
