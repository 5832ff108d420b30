"""What a task says of itself must be possible: checked where it is made, so nothing wrong is compiled or learned."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import jax
import jax.numpy as jnp
import numpy as np

from envs import extend
from envs.base import Effects, Entry, Env, EnvState, Parameter, Theta, World
from envs.effects import make_range
from envs.types import UserError

if TYPE_CHECKING:
    from envs.mujoco.scene import Scene

SCORES = ("success", "return")
_FLOAT32_MAX = 3.4e38


def check_description(task: Env | Scene) -> None:
    """Raises UserError, which names task and field, for a description of a task that describes none."""
    wrong = _refusal(task)
    if not isinstance(task.name, str) or not task.name:
        raise wrong("name", "must be a name", task.name)
    for field in ("observation", "action"):
        _check_entries(wrong, field, getattr(task, field))
    _check_parameters(wrong, task.parameters)
    for field, possible, need in (
        ("episode_length", is_count, "a whole number of at least 1"),
        ("control_dt", lambda x: is_number(x) and x > 0, "a number of seconds above 0"),
        ("score", lambda x: x in SCORES, f"one of {', '.join(SCORES)}"),
        *((name, lambda x: isinstance(x, bool), "True or False") for name in ("success_anytime", "cartesian", "table")),
    ):
        if not possible(getattr(task, field)):
            raise wrong(field, f"must be {need}", getattr(task, field))
    if task.cartesian and sum(entry.size for entry in task.action) < 2:
        raise wrong("cartesian", "needs an action that begins with x and y", task.action)


def check_effects(env: Env) -> None:
    """Raises UserError, which names task and field, for effects that the simulator of a task cannot have."""
    for field in ("training", "actuators"):
        try:
            make_range(env, getattr(env, field))
        except UserError as error:
            raise UserError(f"task {env.name}: '{field}': {error}") from None


def check_functions(env: Env, source: str) -> None:
    """Raises UserError where a function of somebody's task returns what no episode can go on with, and in its nominal
    world not finite. source: file or module of the task, for messages about what it raises itself.
    """
    wrong, key = _refusal(env), jax.random.key(0)
    ends = jax.tree.map(lambda x: x[None], make_range(env, env.training))
    worlds = env.make_worlds(Theta(jnp.array([[p.nominal for p in env.parameters]], jnp.float32), ends))
    if not isinstance(worlds, World):
        raise wrong("make_worlds", "must return a World", type(worlds).__name__)
    world = jax.tree.map(lambda x: x[0], worlds)
    obs, action = (jax.ShapeDtypeStruct((n,), jnp.float32) for n in (env.obs_dim, env.act_dim))
    start = jax.eval_shape(env.reset, world, key)
    _check_state("reset", start, env)
    if type(start.physics).__module__ != "envs.mujoco.worlds":  # a scene's step was checked in parts, as is quicker
        after = jax.eval_shape(env.step, world, start, action, key)
        _check_state("step", after, env)
        if odd := _difference(after, start):
            raise wrong("step", "must return a state like that of 'reset'", odd)
    guarded = {name: getattr(env, name) for name in ("reward", "terminated", "success", "restore")}
    guarded = {name: extend.guard("task", source, f) for name, f in guarded.items() if f is not None}
    check_outcomes(env, guarded, obs, action)
    if "restore" in guarded:
        _check_state("restore", jax.eval_shape(guarded["restore"], world, obs, key), env)
    seen = np.asarray(jax.jit(lambda *start: env.reset(*start).true_obs)(world, key))
    if not np.isfinite(seen).all():
        raise wrong("reset", "must observe finite numbers", np.array2string(seen, threshold=8))


def with_finite_steps(env: Env) -> Env:
    """The task of somebody whose steps are invalid, too, where what they observe or reward is not finite.

    The state of MuJoCo, by which ours judge, does not tell that.
    """

    def step(*args: Any) -> EnvState:
        state = env.step(*args)
        finite = jnp.isfinite(state.true_obs).all() & jnp.isfinite(state.reward)
        return state._replace(invalid=state.invalid | ~finite)

    return env._replace(step=step)


def check_outcomes(task: Any, functions: dict[str, Callable], obs: Any, action: Any) -> None:
    """Raises UserError where reward, end or success as functions of observations are no number and no truth."""
    for name, arguments in (("reward", (obs, action, obs)), ("terminated", (obs, action, obs)), ("success", (obs,))):
        if (function := functions.get(name)) is not None:
            dtype = "float32" if name == "reward" else "bool"
            check_array(task, name, jax.eval_shape(function, *arguments), (), dtype)


def check_array(task: Any, field: str, value: Any, shape: tuple[int, ...], dtype: str = "float32") -> None:
    """Raises UserError, which names task and field, unless a value (or what stands for it) has that shape and type."""
    kind = f"{value.dtype}{list(value.shape)}" if hasattr(value, "dtype") else type(value).__name__
    if kind != f"{dtype}{list(shape)}":
        raise _refusal(task)(field, f"must be a {dtype} of shape {list(shape)}", kind)


def is_number(value: Any) -> bool:
    """Whether it is a finite number also as a float32."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < _FLOAT32_MAX


def is_count(value: Any) -> bool:
    """Whether it is a whole number of at least 1."""
    return isinstance(value, int) and not isinstance(value, bool) and 1 <= value < 2**31


def _refusal(task: Any) -> Callable[[str, str, Any], UserError]:
    return lambda field, need, value: UserError(f"task {task.name}: '{field}' {need}, got {value!s:.120}")


def _check_entries(wrong: Callable[..., UserError], field: str, entries: Sequence[Entry]) -> None:
    if not isinstance(entries, tuple) or not entries or not all(isinstance(entry, Entry) for entry in entries):
        raise wrong(field, "must be a tuple of entries, at least one", entries)
    _check_names(wrong, field, [entry.name for entry in entries])
    for entry in entries:
        if not is_count(entry.size):
            raise wrong(field, f"has '{entry.name}', whose size must be a whole number of at least 1", entry.size)
        if not is_number(entry.error) or entry.error < 0:
            raise wrong(field, f"has '{entry.name}', whose error must be a number, not negative", entry.error)


def _check_parameters(wrong: Callable[..., UserError], parameters: Sequence[Parameter]) -> None:
    if not isinstance(parameters, tuple) or not all(isinstance(p, Parameter) for p in parameters):
        raise wrong("parameters", "must be a tuple of parameters", parameters)
    _check_names(wrong, "parameters", [p.name for p in parameters])
    for p in parameters:
        if p.name in Effects._fields:
            raise wrong("parameters", "must not be called like effects", p.name)
        if not all(map(is_number, (p.nominal, p.low, p.high))):
            raise wrong("parameters", f"has '{p.name}', whose nominal value and range must be finite", tuple(p[2:5]))
        if not p.minimum <= p.low <= p.nominal <= p.high <= p.maximum:
            order = "minimum <= low <= nominal <= high <= maximum"
            raise wrong("parameters", f"has '{p.name}', which needs {order}", p)


def _check_names(wrong: Callable[..., UserError], field: str, names: Sequence[str]) -> None:
    for name in names:
        if not isinstance(name, str) or not name or names.count(name) > 1:
            raise wrong(field, "must have names that differ", name)


def _check_state(field: str, state: EnvState, env: Env) -> None:
    vector, number, truth = ("float32", (env.obs_dim,)), ("float32", ()), ("bool", ())
    kinds = {"obs": vector, "true_obs": vector, "reward": number, "time": ("int32", ())}
    kinds |= dict.fromkeys(("terminated", "truncated", "success", "invalid"), truth)
    for name, (dtype, shape) in kinds.items():
        check_array(env, f"{field}: {name}", getattr(state, name), shape, dtype)


def _difference(after: Any, before: Any) -> str | None:
    """Where two pytrees differ in structure, shape or type; None where they do not."""
    if jax.tree.structure(after) != jax.tree.structure(before):
        return f"{jax.tree.structure(after)}"
    pairs = zip(jax.tree.leaves_with_path(after), jax.tree.leaves(before), strict=True)
    for (path, x), y in pairs:
        if (x.dtype, x.shape) != (y.dtype, y.shape):
            return f"{jax.tree_util.keystr(path)}: {x.dtype}{list(x.shape)}"
    return None
