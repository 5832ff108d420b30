"""What random keys are for: numbers that are folded into a seed's key. Pure.

Draws of one purpose depend on the seed and the number alone, so a number never changes. Kinds of runs count for
themselves: pretraining and fine-tuning use the same small numbers.
"""

from collections.abc import Sequence
from enum import IntEnum

import jax
import jax.numpy as jnp

from envs.types import Array, Key


class Pretraining(IntEnum):
    """Purposes in pretraining."""

    WORLDS = 0
    RANDOM = 1
    START = 2
    REPORT = 3
    VALUE = 4
    DOMAIN = 5


class Finetuning(IntEnum):
    """Purposes in fine-tuning."""

    INIT = 0
    COLLECT = 1
    LEARN = 2
    EVALUATE = 3
    OFFLINE = 4


class FromLog(IntEnum):
    """Purposes in learning from a fixed set of data or a simulator, and in recording such a set."""

    TRAINING = 11
    EVALUATION = 12
    COLLECTION = 21
    LEVEL = 22
    RECORDING = 23


def seed_keys(seeds: Sequence[int] | Array, purpose: int) -> Key:
    """Keys [M] that depend on nothing but the seed and a number that stands for the purpose."""
    return jax.vmap(lambda seed: jax.random.fold_in(jax.random.key(seed), purpose))(jnp.asarray(seeds, jnp.uint32))
