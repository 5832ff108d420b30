"""What a task pays, where that is not its own reward. Pure."""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp

from envs.base import Env, EnvState
from envs.types import Array, UserError


def sparse(env: Env) -> Env:
    """The same task, which pays 1 for every step that ends in success and 0 for others. Raises UserError for a task
    without success.
    """
    if env.score != "success":
        raise UserError(f"{env.name} is judged by its return: there is no success that a sparse reward could pay for")
    success = env.success

    def paid(function: Callable[..., EnvState]) -> Callable[..., EnvState]:
        def of_success(*inputs: Any) -> EnvState:
            state = function(*inputs)
            return state._replace(reward=state.success.astype(jnp.float32))

        return of_success

    def reward(obs: Array, action: Array, next_obs: Array) -> Array:
        assert success is not None  # it is asked for where it is told
        return success(next_obs).astype(jnp.float32)

    return env._replace(
        reset=paid(env.reset),
        step=paid(env.step),
        restore=env.restore and paid(env.restore),
        reward=success and reward,
        sparse=True,
    )
