"""Random keys that notice when they are used twice, whatever the program does with them."""

import collections
from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax.extend import random

_USED: collections.Counter[bytes] = collections.Counter()
_PLAIN = random.threefry_prng_impl


def _note(keys: Any) -> None:
    _USED.update(one.tobytes() for one in np.asarray(keys).reshape(-1, *_PLAIN.key_shape))


def _noticed(draw: Callable[..., jax.Array]) -> Callable[..., jax.Array]:
    """`draw`, which uses up its key."""

    def run(key: jax.Array, *options: Any) -> jax.Array:
        jax.debug.callback(_note, key)
        return draw(key, *options)

    return run


_NOTICING = random.define_prng_impl(
    key_shape=_PLAIN.key_shape,
    seed=_PLAIN.seed,
    split=_noticed(_PLAIN.split),
    random_bits=_noticed(_PLAIN.random_bits),
    fold_in=_PLAIN.fold_in,  # a family of keys comes from one
    name="noticing",
    tag="noticing",
)


def used_twice(function: Callable[..., Any], *args: Any) -> int:
    """How many keys `function(key, *args)` uses more than once, in its compiled form; draws and splits use a key up.

    Keys are told apart by their bits. JAX's own check (`jax.debug_key_reuse`) reads programs instead and takes keys
    that were split outside of a vmapped loop for the same one.
    """
    _USED.clear()
    jax.block_until_ready(jax.jit(function)(jax.random.key(3, impl=_NOTICING), *args))
    jax.effects_barrier()
    assert _USED, "no key was used at all"
    return sum(n > 1 for n in _USED.values())
