"""The wheel-legged robot rolls forward at 0.2 m/s and does not see where it is: the other robot task of H2O+.

The robot is that of `envs.locomotion.wheel_legged`.
"""

import jax.numpy as jnp
import numpy as np

from envs.locomotion import wheel_legged
from envs.locomotion.wheel_legged import FALLEN, fallen, seconds_until, state_of, torque
from envs.mujoco.worlds import PhysicsState
from envs.types import Array

SPEED = 0.2  # m/s
ALIVE = 15.0


def observe(params: Array, state: PhysicsState) -> Array:
    """[3]: v of the axle, pitch and its speed."""
    return wheel_legged.observe(params, state)[1:]


def settled(params: Array, obs: Array) -> PhysicsState:
    """The state that is seen, at x = 0, as if the motors had rested."""
    return state_of(jnp.stack([jnp.zeros(()), obs[1]]), jnp.stack([obs[0], obs[2]]))


def reward(obs: Array, action: Array, next_obs: Array) -> Array:
    """[]: 15 less the squares of the error of v and of the commanded torque, in SI units. Source: H2O+."""
    return ALIVE - (next_obs[0] - SPEED) ** 2 - jnp.sum(torque(action) ** 2)


def terminated(obs: Array, action: Array, next_obs: Array) -> Array:
    """[] bool: fallen, pitched by more than 30 degrees."""
    return fallen(next_obs[1])


def measures(next_obs: np.ndarray, valid: np.ndarray) -> dict[str, np.ndarray]:
    """Of episodes, next_obs [..., T, 3] and valid [..., T].

    upright_s: as of the standing robot. speed_error: [...] m/s, root mean square of v - 0.2 m/s while it is upright;
    that of the first step for a robot that is never upright.
    """
    upright = np.cumprod(valid & (np.abs(next_obs[..., 1]) <= FALLEN), axis=-1).astype(bool)
    counted = upright.copy()
    counted[..., 0] = True
    squares = np.where(counted, (next_obs[..., 0] - SPEED) ** 2, 0.0).sum(-1) / counted.sum(-1)
    return {"upright_s": seconds_until(upright), "speed_error": np.sqrt(squares)}


SCENE = wheel_legged.SCENE._replace(
    name="wheel-legged-forward",
    observation=wheel_legged.SCENE.observation[1:],
    observe=observe,
    settled=settled,
    reward=reward,
    terminated=terminated,
    measures=measures,
)
