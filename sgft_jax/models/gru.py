"""A GRU that reads an episode step by step: the memory of a policy or of a critic.

At each step it reads the previous action and the observation. What it hands on is its state beside the observation of
now, embedded a second time, so that this need not pass through the state. Source: Ni et al. 2022, pomdp-baselines;
without the reward, which a robot does not have.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from flax import linen as nn

from envs.types import Array, Key, PyTree

_ACTION, _OBS = 16, 32  # units of the embeddings


class GRU(NamedTuple):
    """The memory as pure functions, for one episode.

    init(key) -> params. features: length of what it hands on.
    step(params, hidden [units], previous [act_dim], obs [obs_dim]) -> (hidden, handed on [features]).
    along(params, previous [T, act_dim], obs [T, obs_dim]) -> handed on [T, features], from a state of zeros.
    """

    init: Callable[[Key], PyTree]
    features: int
    step: Callable[[PyTree, Array, Array, Array], tuple[Array, Array]]
    along: Callable[[PyTree, Array, Array], Array]


class _Layers(nn.Module):
    """The layers, for one step. Those that read inputs alone are separate, so that they can take all steps at once."""

    units: int

    def setup(self) -> None:
        orthogonal = nn.initializers.orthogonal()
        self.action, self.obs, self.shortcut = nn.Dense(_ACTION), nn.Dense(_OBS), nn.Dense(_OBS)
        self.inputs = nn.Dense(3 * self.units, kernel_init=orthogonal)
        self.recurrent = nn.Dense(3 * self.units, kernel_init=orthogonal)

    def read(self, previous: Array, obs: Array) -> Array:
        """[3 * units] what reset gate, update gate and candidate get from the inputs."""
        return self.inputs(jnp.concatenate([nn.relu(self.action(previous)), nn.relu(self.obs(obs))]))

    def advance(self, hidden: Array, read: Array) -> Array:
        """The next state [units]."""
        reset, keep, new = jnp.split(read, 3)
        h_reset, h_keep, h_new = jnp.split(self.recurrent(hidden), 3)
        keep = nn.sigmoid(keep + h_keep)
        return (1.0 - keep) * jnp.tanh(new + nn.sigmoid(reset + h_reset) * h_new) + keep * hidden

    def hand_on(self, hidden: Array, obs: Array) -> Array:
        """[units + 32]."""
        return jnp.concatenate([hidden, nn.relu(self.shortcut(obs))])

    def __call__(self, hidden: Array, previous: Array, obs: Array) -> tuple[Array, Array]:
        hidden = self.advance(hidden, self.read(previous, obs))
        return hidden, self.hand_on(hidden, obs)


def make_gru(obs_dim: int, act_dim: int, units: int) -> GRU:
    """A memory of so many units."""
    layers = _Layers(units)

    def init(key: Key) -> PyTree:
        return layers.init(key, jnp.zeros(units), jnp.zeros(act_dim), jnp.zeros(obs_dim))["params"]

    def apply(params: PyTree, *inputs: Array, method: Callable | None = None) -> PyTree:
        return layers.apply({"params": params}, *inputs, method=method)

    def along(params: PyTree, previous: Array, obs: Array) -> Array:
        def advance(hidden: Array, read: Array) -> tuple[Array, Array]:
            hidden = apply(params, hidden, read, method=_Layers.advance)
            return hidden, hidden

        reads = jax.vmap(lambda *now: apply(params, *now, method=_Layers.read))(previous, obs)
        states = jax.lax.scan(advance, jnp.zeros(units), reads)[1]
        return jax.vmap(lambda *now: apply(params, *now, method=_Layers.hand_on))(states, obs)

    return GRU(init, units + _OBS, apply, along)
