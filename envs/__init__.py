"""Tasks, worlds and episodes as pure functions of an explicit world. `make(name)` builds a task.

What is named here is imported at its first use: listing tasks and gaps needs neither JAX nor MuJoCo.
"""

from __future__ import annotations

import importlib
from types import ModuleType
from typing import TYPE_CHECKING, Any

from envs import extend, gaps
from envs.base import Domain, EffectRange, Effects, Entry, Env, EnvState, Parameter, Theta, World, packed, unpack
from envs.gaps import Gap
from envs.types import UserError, unknown

if TYPE_CHECKING:
    from envs import effects, rollout
    from envs.base import Varying
    from envs.domains import sample_worlds, uniform
    from envs.rollout import Episode, Fleet, launch, play_episode, step_fleet

TASKS = {
    "push": "envs.franka.push",
    "push-towel": "envs.franka.towel",
    "push-ball": "envs.franka.ball",
    "hammer": "envs.franka.hammer",
    "insert": "envs.franka.insert",
    "panda-push": "envs.franka.panda_push",
    "metaworld-hammer": "envs.franka.metaworld_hammer",
    "halfcheetah": "envs.locomotion.halfcheetah",
    "walker2d": "envs.locomotion.walker2d",
    "walker-walk": "envs.locomotion.walker_walk",
    "walker-walk-du": "envs.locomotion.walker_walk_du",
    "cheetah-run": "envs.locomotion.cheetah_run",
    "cheetah-run-du": "envs.locomotion.cheetah_run_du",
    "wheel-legged": "envs.locomotion.wheel_legged",
    "wheel-legged-forward": "envs.locomotion.wheel_forward",
}
# Return at 0 and at 100 on the scale of D4RL, where 0 is a random policy and 100 an expert, by task.
D4RL = {"halfcheetah": (-280.178953, 12135.0), "walker2d": (1.629008, 4592.3)}
_OURS = frozenset(TASKS.values())
_LAZY = {
    **dict.fromkeys(("Episode", "Fleet", "launch", "play_episode", "step_fleet"), "envs.rollout"),
    **dict.fromkeys(("sample_worlds", "uniform"), "envs.domains"),
}

__all__ = ["TASKS", "Domain", "Entry", "Env", "EnvState", "Parameter", "make", "name_of", "packed", "scene", "unpack"]
__all__ += ["EffectRange", "Effects", "Gap", "Theta", "World", "effects", "gaps", "sample_worlds", "uniform"]
__all__ += ["Episode", "Fleet", "launch", "play_episode", "rollout", "step_fleet"]


def __getattr__(name: str) -> Any:
    if name in ("effects", "rollout"):
        return importlib.import_module(f"envs.{name}")
    if name in _LAZY:
        return getattr(importlib.import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'envs' has no attribute {name!r}")


def make(
    task: str,
    impl: str = "auto",
    scene: str = "",
    previous_actions: int = 0,
    system: tuple[Varying, ...] = (),
    sparse: bool = False,
) -> Env:
    """The task of that name, file or module, compiled; impl: its physics engine, see `worlds.choose_impl`.

    A file or module of your own must define `make(impl) -> Env`, with the file's name as the Env's name
    (docs/extending.md); what it says and returns is checked, see `envs.checks`. scene: that of a real system which is
    more than the simulated one with other numbers; "" for the latter. What is observed, commanded and rewarded, and the
    parameters, are the same in all scenes of a task.
    previous_actions: how many of the last actions the observation ends with. system: what it tells of the system after
    that; see `envs.observations` of both. sparse: whether success alone is paid, see `envs.rewards`.
    Raises UserError with the closest match for an unknown task or scene, and naming file and line for one that fails.
    """
    from envs import rewards
    from envs.mesh import check_jax
    from envs.observations import with_previous_actions, with_system

    check_jax()
    env = _make(task, impl, scene)
    env = rewards.sparse(env) if sparse else env
    return with_system(with_previous_actions(env, previous_actions), system)


def _make(task: str, impl: str, scene: str) -> Env:
    module = _module(task)
    if module.__name__ in _OURS:
        from envs.mujoco.scene import make_env

        return packed(make_env(_real(task, scene) if scene else module.SCENE, impl))
    from envs import checks

    arguments = (impl, _real(task, scene)) if scene else (impl,)
    source = task if extend.is_source(task) else module.__name__
    env = extend.guard("task", source, module.make)(*arguments)
    if not isinstance(env, Env):
        raise UserError(f"task {task}: make(impl) returns a {type(env).__name__}, not an envs.Env")
    if env.name != name_of(task):
        raise UserError(f"task {task}: its Env is called {env.name!r}; call it {name_of(task)!r}, like the file")
    checks.check_description(env)
    checks.check_effects(env)
    called = {name: getattr(env, name) for name in ("make_worlds", "reset", "step")}
    env = packed(env._replace(**{name: extend.guard("task", source, f) for name, f in called.items()}))
    checks.check_functions(env, source)
    return checks.with_finite_steps(env)


def scene(task: str, real: str = "") -> Any:
    """The `envs.mujoco.scene.Scene` of a task or of its real system, see `make`; None for a task without MuJoCo."""
    return _real(task, real) if real else getattr(_module(task), "SCENE", None)


def name_of(task: str) -> str:
    """What a task given by name, file or module is called; its run folders too.

    Also registers the task: from then on its name alone finds it in this process. Raises UserError if there is none.
    """
    if task in TASKS:
        return task
    _module(task)
    return extend.name_of(task)


def _module(task: str) -> ModuleType:
    if task in TASKS or task in _OURS:
        return importlib.import_module(TASKS.get(task, task))
    if not extend.is_source(task):
        raise UserError(f"{unknown('task', task, TASKS)}; or name a file, e.g. my_{task}.py")
    module, name = extend.load("task", task, "make"), extend.name_of(task)
    if TASKS.setdefault(name, module.__name__) != module.__name__:
        raise UserError(f"task {task}: the name {name!r} is taken by {TASKS[name]}; rename the file")
    return module


def _real(task: str, scene: str) -> Any:
    scenes = getattr(_module(task), "REAL", {})
    if scene not in scenes:
        raise UserError(f"{task}: {unknown('scene', scene, scenes)}" if scenes else f"{task} has no scene '{scene}'")
    return scenes[scene]


def normalised(task: str, total: float) -> float | None:
    """An undiscounted return [] on the scale of D4RL; None for a task that has none. Source: D4RL (Fu et al. 2020)."""
    if task not in D4RL:
        return None
    low, high = D4RL[task]
    return 100 * (total - low) / (high - low)
