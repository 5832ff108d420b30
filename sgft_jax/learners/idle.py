"""A learner that learns nothing: for methods whose models alone adapt."""

from typing import Any

from envs.types import Array, Key, PyTree, UserError
from sgft_jax.types import Batch, Learner, Metrics


def _act(state: PyTree, carry: PyTree, obs: Array, key: Key, **options: Any) -> tuple[Array, PyTree]:
    raise UserError("this learner has no policy: the method that uses it brings its own")


def _update(state: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
    return state, {}


IDLE = Learner(lambda key: (), lambda: (), _act, _update)
