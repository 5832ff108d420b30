"""From the parts in which tasks in MuJoCo differ, a `Scene`, to an Env."""

import functools
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs import effects
from envs.base import NOTHING, Effects, Entry, Env, EnvState, Parameter, Theta, Value, World, never, pack
from envs.checks import check_array, check_description, check_effects, check_outcomes, is_count, is_number
from envs.mujoco import worlds as physics
from envs.mujoco.engines import Engine, with_shortcuts
from envs.mujoco.worlds import PhysicsState
from envs.types import Array, Key, UserError

_TOLERANCE = 1e-6  # of a control period: what sums of rounded time steps may miss it by


class View(NamedTuple):
    """Where a viewer stands: MuJoCo's free camera looks at `target` [3] m from `distance` m away; angles in degrees.

    floor: m, the height of a tiled floor; None draws none. follow: a body that the camera keeps beside: `target` is
        seen from there, and the floor has no end; "" for a camera that stays.
    """

    target: tuple[float, float, float]
    distance: float
    azimuth: float = 140.0
    elevation: float = -25.0
    floor: float | None = None
    follow: str = ""


class Measured(NamedTuple):
    """What the simulator knows of a step and observations do not show; a field that is None follows from observations.

    reward: [] float. terminated, success: [] bool.
    """

    reward: Array | None = None
    terminated: Array | None = None
    success: Array | None = None


class Scene(NamedTuple):
    """The parts in which tasks differ. Functions are for one world and one example; `params` is `Theta.params`.

    control_dt: s, the control period. substeps: physics steps in it. ramp: s, how long a new control takes to replace
        the old one.
    build(params by name) -> MjSpec: the whole scene for one theta.
    initial(params, key) -> PhysicsState: a fresh random start.
    settled(params, obs) -> PhysicsState: what is observed as `obs`, a vector without measurement error, at rest but for
        what it says; None where observations do not tell. See `Env.restore`.
    target(qpos, action) -> [nu] controls for an action in [-1, 1] (effects already applied).
    motors(params, previous, target) -> [nu] the control that follows the last one, `previous` [nu], where motors are
        slower than a control period; default `target` at once.
    observe(params, state) -> [obs_dim] without measurement error, or a dict of vectors by entry name.
    reward, terminated, success, success_anytime, score, training, actuators, cartesian, workspace, check, measures,
        table: see `Env`.
    measured(params, before, action, after) -> Measured: where reward, end or success are no functions of observations.
        `reward` may then approximate it; what is measured is what counts.
    adjust(params, state, fields) -> the fields of the model, by name, in force during the next step; default `fields`,
        those of the world.
    event(params, state) -> state: what happens between control steps (a fallen object stays down); default nothing.
    max_speed: m/s or rad/s, ten times what any joint or object reaches: beyond it the physics has exploded.
    engine: one of its own in place of MJX's JAX code, for scenes whose motion someone wrote down.
    variant: for a real system that is not the simulated scene with other numbers, the name of its scene.
    dress(spec): adds what only a viewer sees, in place. view: where the camera stands; None: where MuJoCo puts it.
    """

    name: str
    observation: tuple[Entry, ...]
    action: tuple[Entry, ...]
    parameters: tuple[Parameter, ...]
    episode_length: int
    control_dt: float
    substeps: int
    build: Callable[[dict[str, float]], mujoco.MjSpec]
    initial: Callable[[Array, Key], PhysicsState]
    target: Callable[[Array, Array], Array]
    observe: Callable[[Array, PhysicsState], Any]
    settled: Callable[[Array, Array], PhysicsState] | None = None
    reward: Callable[[Array, Array, Array], Array] | None = None
    success: Callable[[Array], Array] | None = None
    terminated: Callable[[Array, Array, Array], Array] | None = never
    measured: Callable[[Array, PhysicsState, Array, PhysicsState], Measured] = lambda *step: Measured()
    motors: Callable[[Array, Array, Array], Array] = lambda params, previous, target: target
    event: Callable[[Array, PhysicsState], PhysicsState] = lambda params, state: state
    adjust: Callable[[Array, PhysicsState, dict[str, Array]], dict[str, Array]] = lambda params, state, fields: fields
    ramp: float = 0.0
    success_anytime: bool = False
    score: str = "success"
    cartesian: bool = False
    training: Mapping[str, Value] = NOTHING
    actuators: Mapping[str, Value] = NOTHING
    workspace: tuple[tuple[float, float], ...] = ()
    check: Callable[[dict[str, float]], str | None] = lambda theta: None
    measures: Callable[[np.ndarray, np.ndarray], dict[str, np.ndarray]] = lambda next_obs, valid: {}
    table: bool = False
    max_speed: float = 50.0
    engine: Engine | None = None
    variant: str = ""
    dress: Callable[[mujoco.MjSpec], None] = lambda spec: None
    view: View | None = None


def make_env(scene: Scene, impl: str = "auto") -> Env:
    """Assembles the Env of a scene. impl: the physics engine, see `worlds.choose_impl`.

    Raises UserError for a scene that is none (see `envs.checks`), or that this engine cannot step.
    """
    check_description(scene)
    nominal = {p.name: p.nominal for p in scene.parameters}
    host = scene.build(nominal).compile()
    physics.check_supported(scene.name, host)
    check_scene(scene, host)
    impl = physics.choose_impl(impl)
    try:
        fields = _varying(scene, host, nominal)
        engine = scene.engine if impl == "jax" and scene.engine else physics.make_engine(host, fields, impl)
    except UserError as error:
        raise UserError(f"scene {scene.name}: {error}") from None
    if not host.nsensordata:
        engine = engine._replace(sense=lambda fields, state: state)

    def make_worlds(theta: Theta) -> World:
        rows = np.asarray(theta.params, np.float64)
        thetas = [dict(zip(nominal, map(float, row), strict=True)) for row in rows]
        stacked = jax.tree.map(jnp.asarray, physics.compile_worlds(host, scene.build, nominal, thetas, fields))
        return World(theta._replace(params=jnp.asarray(rows, jnp.float32)), stacked)

    def reset(world: World, key: Key) -> EnvState:
        key_start, key_noise, key_effects = jax.random.split(key, 3)
        drawn = effects.draw(world.theta.effects, key_effects)
        return _begin(scene, engine, world, scene.initial(world.theta.params, key_start), drawn, key_noise)

    def restore(settled: Callable[[Array, Array], PhysicsState], world: World, obs: Array, key: Key) -> EnvState:
        key_noise, key_effects = jax.random.split(key)
        drawn = effects.draw(world.theta.effects, key_effects)
        state = settled(world.theta.params, obs - drawn.obs_bias)
        return _begin(scene, engine, world, state, drawn, key_noise)._replace(obs=obs)

    env = Env(
        **{name: getattr(scene, name) for name in Env._fields if name in Scene._fields},
        make_worlds=make_worlds,
        reset=reset,
        step=functools.partial(_step, scene, engine),
        restore=scene.settled and functools.partial(restore, scene.settled),
        prepare=engine.prepare,
        trace=lambda state: state.qpos,
        impl=impl,
        scene=scene.variant,
    )
    check_effects(env)
    return env


def _begin(
    scene: Scene, engine: Engine, world: World, state: PhysicsState, episode: Effects, key_noise: Key
) -> EnvState:
    """The first state of an episode."""
    state = engine.sense(world.model, state)
    true_obs = pack(scene.observation, scene.observe(world.theta.params, state))
    no = jnp.zeros((), bool)
    return EnvState(
        physics=state,
        obs=effects.measure(episode, true_obs, key_noise),
        true_obs=true_obs,
        reward=jnp.zeros((), jnp.float32),
        terminated=no,
        truncated=no,
        success=no,
        invalid=no,
        time=jnp.zeros((), jnp.int32),
        effects=episode,
    )


def _step(scene: Scene, engine: Engine, world: World, state: EnvState, action: Array, key: Key) -> EnvState:
    """One control step."""
    key_latency, key_noise, key_action = jax.random.split(key, 3)
    params, episode, before = world.theta.params, state.effects, state.physics
    command = effects.shake(episode, effects.distort(episode, action), key_action)
    target = scene.motors(params, before.ctrl, scene.target(before.qpos, command))
    dt = scene.control_dt / scene.substeps
    control = effects.ramp(episode, before.ctrl, target, key_latency, dt=dt, duration=scene.ramp)
    controls = jax.vmap(control)(jnp.arange(scene.substeps))
    model = scene.adjust(params, before, world.model)
    after = scene.event(params, engine.advance(model, before, controls))
    true_obs = pack(scene.observation, scene.observe(params, after))
    reward, terminated, now = _outcome(scene, params, state, action, after, true_obs)
    time = state.time + 1
    return EnvState(
        physics=after,
        obs=effects.measure(episode, true_obs, key_noise),
        true_obs=true_obs,
        reward=reward,
        terminated=terminated,
        truncated=time >= scene.episode_length,
        success=state.success | now if scene.success_anytime else now,
        invalid=physics.exploded(after, max_speed=scene.max_speed),
        time=time,
        effects=episode,
    )


def _outcome(
    scene: Scene, params: Array, before: EnvState, action: Array, after: PhysicsState, true_obs: Array
) -> tuple[Array, Array, Array]:
    """Reward, end and success of a step, each as observations tell it or as the simulator measures it."""
    measured = scene.measured(params, before.physics, action, after)
    step = before.true_obs, action, true_obs

    def outcome(name: str, args: tuple[Array, ...], default: Any) -> Array:
        function, value = getattr(scene, name), getattr(measured, name)
        if value is not None:  # the function of a reward is an approximation, for transitions that nobody measures
            return jnp.asarray(value)
        return jnp.asarray(default) if function is None else function(*args)

    return outcome("reward", step, 0.0), outcome("terminated", step, False), outcome("success", (true_obs,), False)


def _varying(scene: Scene, host: mujoco.MjModel, nominal: dict[str, float]) -> tuple[str, ...]:
    """Fields in which scenes differ with one domain parameter off its nominal value each, by little enough to stay
    buildable. A parameter that then changes nothing is asked at the ends of its range, too.
    """
    varying: dict[str, None] = {}
    for p in scene.parameters:
        value = p.nominal * 1.01 if p.nominal else 0.01
        near = value if p.minimum <= value <= p.maximum else 2 * p.nominal - value
        for values in ([near], [x for x in (p.low, p.high) if x != p.nominal]):
            fields = physics.varying_fields(host, (scene.build({**nominal, p.name: x}) for x in values))
            varying |= dict.fromkeys(fields)
            if fields:
                break
    return with_shortcuts(host, tuple(varying))


def check_scene(scene: Scene, host: mujoco.MjModel) -> None:
    """Raises UserError, which names scene and field, for parts that no step can be made of. host: compiled."""
    _check_times(scene, host)
    sizes = {"qpos": host.nq, "qvel": host.nv, "warmstart": host.nv, "ctrl": host.nu}
    full = PhysicsState(**{name: _float(n) for name, n in sizes.items()}, sensordata=_float(host.nsensordata))
    params = _float(len(scene.parameters))
    action, obs = (_float(sum(entry.size for entry in entries)) for entries in (scene.action, scene.observation))
    key = jax.eval_shape(lambda: jax.random.key(0))

    def check_state(field: str, state: Any) -> None:
        if not isinstance(state, PhysicsState):
            raise UserError(f"task {scene.name}: '{field}' must return a PhysicsState, got {type(state).__name__}")
        for name, size in sizes.items():
            check_array(scene, f"{field}: {name}", getattr(state, name), (size,))

    check_state("initial", jax.eval_shape(scene.initial, params, key))
    target = jax.eval_shape(scene.target, full.qpos, action)
    check_array(scene, "target", target, (host.nu,))
    check_array(scene, "motors", jax.eval_shape(scene.motors, params, full.ctrl, target), (host.nu,))
    check_state("event", jax.eval_shape(scene.event, params, full))
    try:
        observed = jax.eval_shape(lambda *args: pack(scene.observation, scene.observe(*args)), params, full)
    except UserError as error:
        raise UserError(f"task {scene.name}: 'observe': {error}") from None
    check_array(scene, "observe", observed, obs.shape)
    if scene.settled is not None:
        check_state("settled", jax.eval_shape(scene.settled, params, obs))
    _check_outcomes(scene, params, full, action, obs)


def _check_times(scene: Scene, host: mujoco.MjModel) -> None:
    for field, possible, need in (
        ("substeps", is_count(scene.substeps), "a whole number of at least 1"),
        ("ramp", is_number(scene.ramp) and scene.ramp >= 0, "a number of seconds, not negative"),
        ("max_speed", is_number(scene.max_speed) and scene.max_speed > 0, "a number above 0"),
    ):
        if not possible:
            raise UserError(f"task {scene.name}: '{field}' must be {need}, got {getattr(scene, field)}")
    steps = scene.substeps * host.opt.timestep
    if abs(steps - scene.control_dt) > _TOLERANCE * scene.control_dt:
        raise UserError(
            f"task {scene.name}: 'control_dt' is {scene.control_dt:g} s, but {scene.substeps} substeps of MuJoCo's "
            f"timestep take {steps:g} s"
        )


def _check_outcomes(scene: Scene, params: Any, state: PhysicsState, action: Any, obs: Any) -> None:
    """Reward, end and success: functions of observations, or measured."""
    functions = {name: getattr(scene, name) for name in ("reward", "terminated", "success")}
    check_outcomes(scene, functions, obs, action)
    measured = jax.eval_shape(scene.measured, params, state, action, state)
    for name, value in measured._asdict().items():
        if value is not None:
            check_array(scene, f"measured: {name}", value, (), "float32" if name == "reward" else "bool")
        if value is not None and name != "reward" and functions[name] is not None:
            raise UserError(f"task {scene.name} measures '{name}': then its function of observations must be None")
    name = {"success": "success", "return": "reward"}[scene.score]
    if functions[name] is None and getattr(measured, name) is None:
        raise UserError(f"task {scene.name}: 'score' is {scene.score!r}, but nothing tells its {name}")


def _float(size: int) -> Any:
    """Stands for a vector of float32."""
    return jax.ShapeDtypeStruct((size,), jnp.float32)
