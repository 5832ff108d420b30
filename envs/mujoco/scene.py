"""What tasks in MuJoCo share: effects on commands and sensors, the Env made from parts; Franka's are the defaults."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from envs.base import Effects, Entry, Env, EnvState, Parameter, World
from envs.franka import arm
from envs.mujoco import worlds as physics
from envs.mujoco.engines.mjx import Advance
from envs.mujoco.worlds import PhysicsState
from sgft_jax.types import Array, Key, UserError

CONTROL_DT = 0.2  # s, 5 Hz as in the paper
RAMP = 0.1  # s: the servo's target moves linearly to its new value, then rests, so the arm has settled at the next step
# The simulator's own effects: exact commands, occasional sensor noise in raw units (paper, Appendix C).
TRAINING = {"obs_noise": 0.004, "obs_noise_prob": 0.3}
MAX_SPEED = 50.0  # m/s or rad/s: ten times what any joint or object reaches, so beyond it the physics has exploded


class Scene(NamedTuple):
    """The parts in which tasks differ. Vectors are for one world; `params` is World.params.

    build(params by name) -> MjSpec: the whole scene for one theta.
    initial(params, key) -> PhysicsState: a fresh random start.
    target(qpos, action) -> [nu] controls, for Franka joint targets in rad, for an action in [-1, 1] (effects already
        applied).
    observe(params, state) -> [obs_dim] without measurement error.
    substeps: physics steps per control period. cartesian: the first two action entries are x and y of the base frame.
    event(params, state) -> state: what happens between control steps (a fallen object stays down); default nothing.
    control_dt, ramp: s, the control period, and how long a new control takes to replace the old one.
    training: the simulator's own effects.
    advance: an engine of its own in place of MJX's JAX code, for scenes whose motion someone wrote down.
    variant: for a real system that is not the simulated scene with other numbers, the name of its scene.
    dress(spec): adds what only a viewer sees, in place.
    """

    name: str
    observation: tuple[Entry, ...]
    action: tuple[Entry, ...]
    parameters: tuple[Parameter, ...]
    episode_length: int
    substeps: int
    success_anytime: bool
    cartesian: bool
    build: Callable[[dict[str, float]], mujoco.MjSpec]
    initial: Callable[[Array, Key], PhysicsState]
    target: Callable[[Array, Array], Array]
    observe: Callable[[Array, PhysicsState], Array]
    reward: Callable[[Array, Array, Array], Array]
    success: Callable[[Array], Array]
    event: Callable[[Array, PhysicsState], PhysicsState] = lambda params, state: state
    control_dt: float = CONTROL_DT
    ramp: float = RAMP
    training: Mapping[str, float] = MappingProxyType(TRAINING)
    advance: Advance | None = None
    variant: str = ""
    dress: Callable[[mujoco.MjSpec], None] = lambda spec: None


def new_spec(*, substeps: int, iterations: int, ls_iterations: int) -> mujoco.MjSpec:
    """An empty scene with the solver settings all tasks share; contacts only where a task declares a pair."""
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep = CONTROL_DT / substeps
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.iterations, option.ls_iterations = iterations, ls_iterations
    # The robot compensates its own weight, which is the same as none, and MuJoCo's per-body compensation costs a
    # quarter of the simulation speed. A task gives weight to the objects that need it, see `push`.
    option.gravity = np.zeros(3)
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP
    spec.worldbody.add_light(pos=[0.6, -0.6, 2.0], dir=[-0.1, 0.3, -1.0], castshadow=True)
    return spec


def make_env(scene: Scene, impl: str = "auto") -> Env:
    """Assembles the Env of a scene: worlds, resets, steps. impl: who steps the physics, see `physics.choose_impl`."""
    nominal = {p.name: p.nominal for p in scene.parameters}
    host = scene.build(nominal).compile()
    fields = physics.varying_fields(host, _perturbed(scene, nominal))
    impl = physics.choose_impl(impl)
    engine = scene.advance if impl == "jax" and scene.advance else physics.make_engine(host, fields, impl)
    obs_dim, act_dim = sum(e.size for e in scene.observation), sum(e.size for e in scene.action)

    def stack_worlds(params: np.ndarray, effects: Effects) -> World:
        specs = (scene.build(dict(zip(nominal, map(float, row), strict=True))) for row in params)
        stacked = physics.compile_worlds(host, specs, fields)
        repeat = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(params), *x.shape)), effects)
        return World(jnp.asarray(params, jnp.float32), {k: jnp.asarray(v) for k, v in stacked.items()}, repeat)

    def sample_worlds(
        key: Key, n: int, *, params: Mapping[str, float | Sequence[float]] | None = None, effects: Mapping | None = None
    ) -> World:
        ranges = _ranges(scene, params or {})
        if effects and effects.get("action_rotation") and not scene.cartesian:
            raise UserError(f"effect 'action_rotation' needs Cartesian actions; {scene.name} commands joints")
        low, high = ranges.T
        uniform = np.asarray(jax.random.uniform(key, (n, len(low))), np.float64)
        own = make_effects({**scene.training, **(effects or {})}, obs_dim, act_dim)
        return stack_worlds(low + (high - low) * uniform, own)

    def reset(world: World, key: Key) -> EnvState:
        key_start, key_noise = jax.random.split(key)
        state = scene.initial(world.params, key_start)
        true_obs = scene.observe(world.params, state)
        no = jnp.zeros((), bool)
        zero = jnp.zeros((), jnp.float32)
        obs = measure(world.effects, true_obs, key_noise)
        return EnvState(state, obs, true_obs, zero, no, no, no, no, jnp.zeros((), jnp.int32))

    def step(world: World, state: EnvState, action: Array, key: Key) -> EnvState:
        key_latency, key_noise = jax.random.split(key)
        target = scene.target(state.physics.qpos, distort(world.effects, action))
        previous, dt = state.physics.ctrl, scene.control_dt / scene.substeps
        control = _ramp(world.effects, previous, target, dt, key_latency, ramp=scene.ramp)
        controls = jax.vmap(control)(jnp.arange(scene.substeps))
        after = scene.event(world.params, engine(world.model, state.physics, controls))
        true_obs = scene.observe(world.params, after)
        time = state.time + 1
        return EnvState(
            physics=after,
            obs=measure(world.effects, true_obs, key_noise),
            true_obs=true_obs,
            reward=scene.reward(state.true_obs, action, true_obs),
            terminated=jnp.zeros((), bool),
            truncated=time >= scene.episode_length,
            success=_succeeded(scene, state.success, true_obs),
            invalid=physics.exploded(after, max_speed=MAX_SPEED),
            time=time,
        )

    return Env(
        name=scene.name,
        observation=scene.observation,
        action=scene.action,
        parameters=scene.parameters,
        episode_length=scene.episode_length,
        control_dt=scene.control_dt,
        success_anytime=scene.success_anytime,
        sample_worlds=sample_worlds,
        reset=reset,
        step=step,
        reward=scene.reward,
        terminated=lambda obs, action, next_obs: jnp.zeros((), bool),
        success=scene.success,
        impl=impl,
        scene=scene.variant,
    )


def _perturbed(scene: Scene, nominal: dict[str, float]) -> Iterator[mujoco.MjSpec]:
    """Scenes with one domain parameter off its nominal value each, by little enough to stay buildable."""
    for name, value in nominal.items():
        yield scene.build({**nominal, name: value * 1.01 if value else 0.01})


def _ranges(scene: Scene, chosen: Mapping[str, float | Sequence[float]]) -> np.ndarray:
    """[n_params, 2] low and high of every parameter: the training range unless `chosen` says a value or a range."""
    ranges = {p.name: (p.low, p.high) for p in scene.parameters}
    for name, value in chosen.items():
        if name not in ranges:
            raise UserError(f"{scene.name} has no domain parameter '{name}'; it has: {', '.join(ranges)}")
        pair = np.broadcast_to(np.asarray(value, np.float64), (2,)) if np.size(value) in (1, 2) else None
        if pair is None or pair[0] > pair[1] or not np.isfinite(pair).all():
            raise UserError(f"parameter '{name}' needs a value or a range [low, high], got {value}")
        ranges[name] = (float(pair[0]), float(pair[1]))
    return np.array(list(ranges.values()))


def make_effects(values: Mapping[str, float | Sequence[float]], obs_dim: int, act_dim: int) -> Effects:
    """Effects from named values; what is not named has no effect. Scalars fill vectors.

    Raises UserError for unknown names, wrong lengths and negative latencies or noise.
    """
    shapes: dict[str, tuple[int, ...]] = dict.fromkeys(Effects._fields, ())
    shapes |= {"action_scale": (act_dim,), "action_bias": (act_dim,), "obs_bias": (obs_dim,)}
    unknown = sorted(set(values) - set(shapes))
    if unknown:
        raise UserError(f"no effect is called '{unknown[0]}'; there are: {', '.join(shapes)}")
    defaults = {"action_scale": 1.0, "obs_noise_prob": 1.0}
    arrays = {}
    for name, shape in shapes.items():
        value = np.asarray(values.get(name, defaults.get(name, 0.0)), np.float32)
        if value.shape not in ((), shape):
            raise UserError(f"effect '{name}' needs {shape[0] if shape else 'one'} value(s), got {value.size}")
        if name in ("latency", "latency_jitter", "obs_noise", "obs_noise_prob") and value < 0:
            raise UserError(f"effect '{name}' must not be negative, got {value}")
        arrays[name] = jnp.asarray(np.broadcast_to(value, shape))
    return Effects(**arrays)


def distort(effects: Effects, action: Array) -> Array:
    """The action [act_dim] as the robot understands it: rotated in the xy plane if Cartesian, scaled, offset."""
    if len(action) > 1:
        c, s = jnp.cos(effects.action_rotation), jnp.sin(effects.action_rotation)
        action = action.at[:2].set(jnp.stack([c * action[0] - s * action[1], s * action[0] + c * action[1]]))
    return effects.action_scale * action + effects.action_bias


def measure(effects: Effects, true_obs: Array, key: Key) -> Array:
    """The observation as the sensors report it: biased, and sometimes noisy as a whole vector (O-6)."""
    key_gate, key_noise = jax.random.split(key)
    noisy = jax.random.bernoulli(key_gate, effects.obs_noise_prob)
    noise = effects.obs_noise * jax.random.normal(key_noise, true_obs.shape)
    return true_obs + effects.obs_bias + jnp.where(noisy, noise, 0.0)


def at_rest(joints: Array, others: Array, nv: int) -> PhysicsState:
    """A motionless state: arm at `joints` [7], the other coordinates at `others`, servo target where the arm is."""
    return PhysicsState(jnp.concatenate([joints, others]), jnp.zeros(nv), jnp.zeros(nv), joints)


def _ramp(
    effects: Effects, previous: Array, target: Array, dt: float, key: Key, *, ramp: float = RAMP
) -> Callable[[Array], Array]:
    jitter = jax.random.uniform(key, minval=-1.0, maxval=1.0) * effects.latency_jitter
    start = jnp.maximum(effects.latency + jitter, 0.0)

    def control(i: Array) -> Array:
        progress = jnp.clip(((i + 1) * dt - start) / ramp, 0.0, 1.0)
        return previous + progress * (target - previous)

    return control


def _succeeded(scene: Scene, before: Array, obs: Array) -> Array:
    now = scene.success(obs)
    return before | now if scene.success_anytime else now


def clip_joints(q: Array) -> Array:
    """Joint targets inside the position limits."""
    return jnp.clip(q, jnp.asarray(arm.Q_MIN, jnp.float32), jnp.asarray(arm.Q_MAX, jnp.float32))
