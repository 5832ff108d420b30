"""Regression as classification: a number becomes weights on two neighbouring bins of a logarithmic scale.

One network output then fits rewards of 0.01 and returns of 1,000 with gradients of the same size.
Source: Dreamer v3 (Hafner et al. 2023); TD-MPC2 (Hansen et al. 2024).
"""

from dataclasses import dataclass

import chex
import jax
import jax.numpy as jnp
import numpy as np

from envs.types import Array, UserError


@dataclass(frozen=True)
class Bins:
    """`count` bins, equally spaced over symlog values from `low` to `high`.

    The defaults cover |x| < 22,025, finely near 0 alone: one bin is 22 % of a large value.
    """

    count: int = 101
    low: float = -10.0
    high: float = 10.0

    def __post_init__(self) -> None:
        if self.count < 2 or self.low >= self.high:
            raise UserError(f"{self.count} bins on [{self.low}, {self.high}]: need 2 or more and low below high")

    @property
    def centres(self) -> Array:
        """[count] symlog values."""
        return jnp.asarray(np.linspace(self.low, self.high, self.count), jnp.float32)  # double: the middle is 0


def symlog(x: Array) -> Array:
    """sign(x) log(1 + |x|), any shape."""
    return jnp.log1p(jnp.maximum(x, 0.0)) - jnp.log1p(jnp.maximum(-x, 0.0))


def symexp(x: Array) -> Array:
    """The inverse of `symlog`, any shape. Without sign and |x|, whose derivatives at 0 would make this one 0, not 1."""
    return jnp.expm1(jnp.maximum(x, 0.0)) - jnp.expm1(jnp.maximum(-x, 0.0))


def encode(x: Array, bins: Bins) -> Array:
    """Weights [count] on the two bins around symlog(x) [], whose mean it is; beyond the range all on the last one."""
    chex.assert_rank(x, 0)
    position = (jnp.clip(symlog(x), bins.low, bins.high) - bins.low) * (bins.count - 1) / (bins.high - bins.low)
    return jnp.maximum(1.0 - jnp.abs(position - jnp.arange(bins.count)), 0.0)


def decode(logits: Array, bins: Bins) -> Array:
    """The number [] that logits [count] stand for: symexp of the expected bin."""
    chex.assert_shape(logits, (bins.count,))
    return symexp(jnp.sum(jax.nn.softmax(logits) * bins.centres))


def cross_entropy(logits: Array, x: Array, bins: Bins) -> Array:
    """Cross-entropy [] of the distribution with logits [count] against the two bins of x [], nats."""
    chex.assert_shape(logits, (bins.count,))
    return -jnp.sum(encode(x, bins) * jax.nn.log_softmax(logits))
