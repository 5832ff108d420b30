"""What an environment is: pure functions of an explicit world, and the words a task uses to describe itself.

Imports no JAX: commands that only list tasks read this module too.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Mapping
from math import inf
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

from envs.types import UserError

if TYPE_CHECKING:
    from envs.types import Array, Key, PyTree

Numbers = float | list[float] | list[list[float]]
Value = Numbers | Mapping[str, Numbers]  # the latter by entry name, see `effects.make_range`
NOTHING: Mapping[str, Value] = MappingProxyType({})
_FARTHEST = 1000.0
# How commands of a real system may err beside its effects, see `envs.commands`: by name the greatest value, the least
# is 0. In units of the command's range [-1, 1]:
#   warp: largest length of an error vector that depends smoothly on where the hand is; warp_seed draws which.
#   dead_band: the size up to which a command does nothing, on each axis; of larger ones the excess passes.
#   backlash: the play of each axis: after a reversal the first commands move nothing, until they add up to it.
# Others: late: control periods until a command is in force, zero before the first. lost: probability that a command is
# lost: the one before it is repeated.
COMMANDS: Mapping[str, float] = MappingProxyType(
    {"warp": 4.0, "warp_seed": 2.0**32 - 1, "dead_band": 1.0, "backlash": 10.0, "late": 3.0, "lost": 1.0}
)
WHOLE = frozenset({"warp_seed", "late"})  # of them, the whole numbers


class Entry(NamedTuple):
    """One named group of numbers in an observation or action vector, e.g. ("ee_xyz", "m", 3).

    error: of a measurement, the std of the constant error that a real system's sensor may have, in its unit: that of a
        camera's calibration, for example. 0 for what is measured well. `identify` looks for errors of up to twice that.
    """

    name: str
    unit: str
    size: int
    error: float = 0.0

    @property
    def labels(self) -> list[str]:
        """What its numbers are called."""
        return [f"{self.name}[{i}]" for i in range(self.size)] if self.size > 1 else [self.name]


class Parameter(NamedTuple):
    """One domain parameter: its nominal value and the uniform range [low, high] that pretraining draws it from.

    minimum, maximum: physical bounds of any value that a user may name (a mass is positive); see `bounds`.
    real: range in which `sgft_jax.posterior` looks for a real system's value; None = half to twice training's.
    place: whether every episode draws another value, which sensors show, such as where a hole is.
    """

    name: str
    unit: str
    nominal: float
    low: float
    high: float
    minimum: float = -inf
    maximum: float = inf
    real: tuple[float, float] | None = None
    place: bool = False

    @property
    def bounds(self) -> tuple[float, float]:
        """Least and greatest value that a user may name. Where none is declared, 1,000 times what is known of it.

        That is grams for kilograms: beyond it no system of the task is meant, and the physics would end as infinities.
        """
        known = (self.nominal, self.low, self.high, *(self.real or ()))
        most = _FARTHEST * (max(map(abs, known)) or 1.0)
        return (self.minimum if self.minimum > -inf else -most), (self.maximum if self.maximum < inf else most)


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
    obs_bias: [measured_dim] raw units, constant calibration error of the sensors.
    action_noise: [act_dim] std of Gaussian noise that the robot adds to the command at every step, in units of its
        range; where it is not 0, the noisy command is clipped to [-1, 1].
    """

    action_scale: Array
    action_rotation: Array
    action_bias: Array
    latency: Array
    latency_jitter: Array
    obs_noise: Array
    obs_noise_prob: Array
    obs_bias: Array
    action_noise: Array


class EffectRange(NamedTuple):
    """Each episode draws its effects uniformly from here; where low equals high, they have exactly this value."""

    low: Effects
    high: Effects


class Theta(NamedTuple):
    """What distinguishes one system from others of its task.

    params: [n_params] domain parameters, raw units, in the order of `Env.parameters`. effects: see `EffectRange`.
    """

    params: Array
    effects: EffectRange


class Varying(NamedTuple):
    """A number that differs between systems of a domain, uniform in [low, high], raw units.

    name: of a domain parameter or an effect. index: its place in an effect that is a vector, else 0.
    """

    name: str
    index: int
    low: float
    high: float


class World(NamedTuple):
    """One system to interact with; stack worlds along a leading axis and vmap.

    model: the fields of the simulator's model that differ between worlds, as its compiler left them, by name.
    commands: how commands err, `envs.commands.Commands`; () where nobody asks.
    """

    theta: Theta
    model: dict[str, Array]
    commands: PyTree = ()


class EnvState(NamedTuple):
    """The state of one episode after a step.

    physics: the simulator's own state.
    obs: [obs_dim] as measured (noise and bias included). true_obs: the same without measurement error.
    reward: [] task reward of the step, computed from `true_obs` where it is a function of observations.
    terminated: [] bool, the task ended the episode. truncated: [] bool, its time is up.
    success: [] bool. invalid: [] bool, physics exploded, the step must not be learned from.
    time: [] int32 control steps since reset.
    effects: those of this episode.
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
    effects: Effects


class Domain(NamedTuple):
    """A distribution over systems, which may adapt while a policy trains in them. Plain Python on the host.

    init() -> state.
    sample(state, key, n) -> Theta [n].
    log_prob(state, theta) -> [] log density of one theta.
    update(state, theta [n], returns [n]) -> state, after the policy earned these returns there.
    """

    init: Callable[[], PyTree]
    sample: Callable[[PyTree, Key, int], Theta]
    log_prob: Callable[[PyTree, Theta], Array]
    update: Callable[[PyTree, Theta, Array], PyTree]


def never(obs: Array, action: Array, next_obs: Array) -> Any:
    """[] False: what `terminated` is for a task whose episodes end by time alone."""
    import jax.numpy as jnp

    return jnp.zeros((), bool)


def no_trace(physics: PyTree) -> Any:
    """[0]: what `trace` is for a task that nobody can draw."""
    import jax.numpy as jnp

    return jnp.zeros(0)


class Env(NamedTuple):
    """A task. All functions are for one world and one example; nothing is batched inside.

    make_worlds(theta [n]) -> World stacked [n], compiled on the host (not jittable). Sampling is a `Domain`'s business.
    reset(world, key) -> EnvState, with effects drawn for this episode.
    step(world, state, action, key) -> EnvState.
    restore(world, obs, key) -> EnvState: a state in which that world's sensors read `obs` [obs_dim] without noise, with
        effects drawn as by `reset`, at rest where observations do not say how fast things move. None where nobody wrote
        it: then the simulator cannot be asked about recorded steps.
    reward, terminated: functions of (obs, action, next_obs), so true of imagined transitions too; success: function of
        one observation. None where observations do not tell: then only `EnvState` knows. A `reward` may approximate
        what `EnvState` measures; the task's page says how well.
    success_anytime: whether success counts at any step or only at the last.
    score: what a run is judged by, "success" or "return".
    sparse: whether success alone is paid, see `envs.rewards`.
    training: the simulator's own effects, by name: values or ranges, as in a gap.
    actuators: effects of a simulator whose actuators differ too, see `envs.domains`; those not named have
        the ranges given there.
    cartesian: the first two action entries are x and y of one frame.
    workspace: (lowest, highest) of the first numbers of the observation, where hands move, raw units; numbers that do
        not vary may be among them. () where nobody declares it: then no gap can warp commands.
    commands: whether worlds say how commands err, see `envs.commands`.
    check(theta by name) -> what is impossible about it in one sentence, or None: relations between parameters.
    trace(physics) -> [k] what a renderer needs of a state; [0] where nothing can be drawn. Commands that record put
        another function in its place, which may return a pytree.
    previous_actions: how many of the last actions the observation ends with, see `envs.observations`.
    system: what the observation then tells of the system that the episode takes place in, see `envs.observations`.
    simulator() -> (obs, action) -> [measured_dim] what a step changes in the system that `obs` tells. None where it
        tells none or the task has no `restore`.
    measures(next_obs [..., T, measured_dim], valid [..., T]) -> {name: [...]}: what else whole episodes are judged by,
        in numpy. The steps that are not valid come last.
    table: whether six-column text files, the logs of a wheel-legged robot (docs/hybrid.md), are records of it.
    prepare(): compiles what the physics engine compiles itself, see `envs.mujoco.engines.Engine`.
    impl: the physics engine. scene: the name of a real system's own scene, "" for the one to pretrain in.
    """

    name: str
    observation: tuple[Entry, ...]
    action: tuple[Entry, ...]
    parameters: tuple[Parameter, ...]
    episode_length: int
    control_dt: float
    make_worlds: Callable[[Theta], World]
    reset: Callable[[World, Key], EnvState]
    step: Callable[[World, EnvState, Array, Key], EnvState]
    restore: Callable[[World, Array, Key], EnvState] | None = None
    reward: Callable[[Array, Array, Array], Array] | None = None
    terminated: Callable[[Array, Array, Array], Array] | None = never
    success: Callable[[Array], Array] | None = None
    success_anytime: bool = False
    score: str = "success"
    sparse: bool = False
    training: Mapping[str, Value] = NOTHING
    actuators: Mapping[str, Value] = NOTHING
    cartesian: bool = False
    workspace: tuple[tuple[float, float], ...] = ()
    commands: bool = False
    check: Callable[[dict[str, float]], str | None] = lambda theta: None
    trace: Callable[[PyTree], PyTree] = no_trace
    previous_actions: int = 0
    system: tuple[Varying, ...] = ()
    simulator: Callable[[], Callable[[Array, Array], Array]] | None = None
    measures: Callable[[Any, Any], dict[str, Any]] = lambda next_obs, valid: {}
    table: bool = False
    prepare: Callable[[], None] = lambda: None
    impl: str = "jax"
    scene: str = ""

    @property
    def obs_dim(self) -> int:
        """Length of the observation vector."""
        return sum(e.size for e in self.observation)

    @property
    def measured(self) -> tuple[Entry, ...]:
        """The entries of the observation that sensors report: all but the previous actions and the system."""
        return self.observation[: len(self.observation) - bool(self.previous_actions) - bool(self.system)]

    @property
    def measured_dim(self) -> int:
        """How many numbers sensors report."""
        return sum(e.size for e in self.measured)

    @property
    def sensor_errors(self) -> tuple[float, ...]:
        """[measured_dim] of every measured number, the `error` of its entry."""
        return tuple(e.error for e in self.measured for _ in range(e.size))

    @property
    def act_dim(self) -> int:
        """Length of the action vector."""
        return sum(e.size for e in self.action)


def entries_of(env: Env, effect: str) -> tuple[Entry, ...]:
    """What an effect is a vector over; () for one that is a number, and for what is no effect."""
    of_actions = dict.fromkeys(("action_scale", "action_bias", "action_noise"), env.action)
    return {**of_actions, "obs_bias": env.measured}.get(effect, ())


def misnamed(env: Env, name: str) -> UserError:
    """What to tell someone who named a domain parameter or an effect that the task does not have there."""
    if name in COMMANDS:
        return UserError(f"'{name}' belongs in the 'commands' of a gap: it is no parameter and no effect of {env.name}")
    lists = {"parameter": [p.name for p in env.parameters], "effect": list(Effects._fields)}
    for kind, names in lists.items():
        if name in names:
            what, other = ("an effect", "parameters") if kind == "effect" else ("a parameter", "effects")
            return UserError(f"'{name}' is {what} of {env.name}, not one of its {other}")
    close = difflib.get_close_matches(name, [*lists["parameter"], *lists["effect"]], n=1)
    guess = f"; did you mean '{close[0]}'?" if close else "."
    listed = " ".join(f"{kind.capitalize()}s: {', '.join(names) or 'none'}." for kind, names in lists.items())
    return UserError(f"'{name}' is neither a parameter nor an effect of {env.name}{guess} {listed}")


def pack(entries: tuple[Entry, ...], parts: Any) -> Any:
    """[dim] one vector from a dict of vectors by entry name; what is an array already stays as it is.

    Raises UserError if the dict does not hold exactly these entries in their sizes.
    """
    if not isinstance(parts, Mapping):
        return parts
    import jax.numpy as jnp

    if odd := set(parts) ^ {e.name for e in entries}:
        raise UserError(f"observation: {sorted(odd)[0]!r} is not both declared and returned")
    vectors = [jnp.asarray(parts[e.name], jnp.float32).reshape(-1) for e in entries]
    for entry, vector in zip(entries, vectors, strict=True):
        if vector.size != entry.size:
            raise UserError(f"observation: {entry.name!r} has {vector.size} numbers, {entry.size} are declared")
    return jnp.concatenate(vectors)


def unpack(entries: tuple[Entry, ...], vector: Array) -> dict[str, Array]:
    """The parts of a vector [dim] by entry name."""
    parts, start = {}, 0
    for entry in entries:
        parts[entry.name] = vector[start : start + entry.size]
        start += entry.size
    return parts


def packed(env: Env) -> Env:
    """The same task with observations as one vector [obs_dim], where `reset` and `step` may return dicts by entry name.

    `step` gets states with packed observations; `reward`, `terminated` and `success` see packed ones too. Raises
    UserError for what is no state.
    """

    def flat(state: EnvState) -> EnvState:
        if not isinstance(state, EnvState):
            raise UserError(f"task {env.name}: 'reset' and 'step' must return an EnvState, got {type(state).__name__}")
        return state._replace(obs=pack(env.observation, state.obs), true_obs=pack(env.observation, state.true_obs))

    restore = env.restore
    return changed(env, flat)._replace(restore=restore and (lambda *args: flat(restore(*args))))


def changed(env: Env, change: Callable[[EnvState], EnvState]) -> Env:
    """The same task, but for a change of the states that `reset` and `step` lead to."""
    return env._replace(reset=lambda *args: change(env.reset(*args)), step=lambda *args: change(env.step(*args)))
