"""A learner that learns nothing: for methods whose models alone adapt."""

from sgft_jax.types import Batch, Key, Learner, Metrics, PyTree, UserError


def _act(state: PyTree, carry: PyTree, obs: object, key: Key, **options: object) -> tuple[object, PyTree]:
    raise UserError("this learner has no policy: the method that uses it brings its own")


def _update(state: PyTree, batch: Batch, key: Key) -> tuple[PyTree, Metrics]:
    return state, {}


IDLE = Learner(lambda key: (), lambda: (), _act, _update)
