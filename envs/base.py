"""What an environment is: pure functions of an explicit world, and the words a task uses to describe itself."""

from collections.abc import Callable
from typing import NamedTuple

from sgft_jax.types import Array, Key, PyTree


class Entry(NamedTuple):
    """One named group of numbers in an observation or action vector, e.g. ("ee_xyz", "m", 3)."""

    name: str
    unit: str
    size: int


class Parameter(NamedTuple):
    """One domain parameter: its value in the nominal model and the uniform range pretraining draws it from."""

    name: str
    unit: str
    nominal: float
    low: float
    high: float


class Effects(NamedTuple):
    """What no simulator parameter can express: how commands reach the robot and how its state is measured.

    action_scale: [act_dim] multiplies the commanded action.
    action_rotation: [] rad, rotates the xy part of Cartesian commands (a miscalibrated base frame). Tasks that command
        joints refuse it.
    action_bias: [act_dim] added to the command in units of its range, a drift: weight or encoders badly compensated.
    latency: [] s, how long the previous command stays in force at the start of each control period.
    latency_jitter: [] s, half-width of the uniform spread of the latency, redrawn at every step.
    obs_noise: [] raw units, std of Gaussian sensor noise.
    obs_noise_prob: [] probability that an observation vector is noisy.
    obs_bias: [obs_dim] raw units, constant calibration error of the sensors.
    """

    action_scale: Array
    action_rotation: Array
    action_bias: Array
    latency: Array
    latency_jitter: Array
    obs_noise: Array
    obs_noise_prob: Array
    obs_bias: Array


class World(NamedTuple):
    """One system to interact with; stack worlds along a leading axis and vmap.

    params: [n_params] the domain parameters theta, raw units, in the order of `Env.parameters`.
    model: the fields of the MuJoCo model that differ between worlds, exactly as MuJoCo's compiler left them.
    effects: see `Effects`.
    """

    params: Array
    model: dict[str, Array]
    effects: Effects


class EnvState(NamedTuple):
    """The state of one episode after a step.

    physics: the simulator's own state.
    obs: [obs_dim] as measured (noise and bias included). true_obs: the same without measurement error.
    reward: [] task reward computed from `true_obs`.
    terminated, truncated, success, invalid: [] bool; `invalid` = physics exploded, the step must not be learned from.
    time: [] int32 control steps since reset.
    """

    physics: PyTree
    obs: Array
    true_obs: Array
    reward: Array
    terminated: Array
    truncated: Array
    success: Array
    invalid: Array
    time: Array


class Env(NamedTuple):
    """A task. All functions are for one world and one example; nothing is batched inside.

    sample_worlds(key, n, params=..., effects=...) -> World stacked [n], compiled on the host (not jittable). Domain
        parameters are drawn from their training ranges unless `params` names a value or a range [low, high]; `effects`
        names what else differs from the simulator. Raises UserError for unknown names.
    reset(world, key) -> EnvState; step(world, state, action, key) -> EnvState.
    reward, terminated: functions of (obs, action, next_obs), true for imagined transitions too.
    success: function of one observation; `success_anytime` tells whether it counts at any step or only at the last.
    impl: who steps the physics. scene: the name of a real system's own scene, "" for the one to pretrain in.
    """

    name: str
    observation: tuple[Entry, ...]
    action: tuple[Entry, ...]
    parameters: tuple[Parameter, ...]
    episode_length: int
    control_dt: float
    success_anytime: bool
    sample_worlds: Callable[..., World]
    reset: Callable[[World, Key], EnvState]
    step: Callable[[World, EnvState, Array, Key], EnvState]
    reward: Callable[[Array, Array, Array], Array]
    terminated: Callable[[Array, Array, Array], Array]
    success: Callable[[Array], Array]
    impl: str = "jax"
    scene: str = ""

    @property
    def obs_dim(self) -> int:
        """Length of the observation vector."""
        return sum(e.size for e in self.observation)

    @property
    def act_dim(self) -> int:
        """Length of the action vector."""
        return sum(e.size for e in self.action)
