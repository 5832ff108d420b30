"""Tasks, worlds and episodes as pure functions of an explicit world. `make(name)` builds a task."""

import importlib
from types import ModuleType
from typing import Any

from envs import gaps, rollout
from envs.base import Effects, Entry, Env, EnvState, Parameter, World
from envs.gaps import Gap
from envs.rollout import Episode, Fleet, launch, play_episode, step_fleet
from sgft_jax import extend
from sgft_jax.types import UserError, unknown

TASKS = {
    "push": "envs.franka.push",
    "push-towel": "envs.franka.towel",
    "push-ball": "envs.franka.ball",
    "hammer": "envs.franka.hammer",
    "insert": "envs.franka.insert",
}

__all__ = [
    "TASKS",
    "Effects",
    "Entry",
    "Env",
    "EnvState",
    "Episode",
    "Fleet",
    "Gap",
    "Parameter",
    "World",
    "gaps",
    "launch",
    "make",
    "name_of",
    "play_episode",
    "rollout",
    "scene",
    "step_fleet",
]


def make(task: str, impl: str = "auto", scene: str = "") -> Env:
    """The task of that name, file or module, compiled; impl: who steps its physics, see `physics.choose_impl`.

    A file or module of your own must define `make(impl) -> Env`, with the file's name as the Env's name
    (docs/extending.md). scene: that of a real system which is more than the simulated one with other numbers; "" for
    the latter. What is observed, commanded and rewarded, and the parameters, are the same in all scenes of a task.
    Raises UserError with the closest match for an unknown task or scene.
    """
    module = _module(task)
    env = module.make(impl, _real(task, scene)) if scene else module.make(impl)
    if env.name != name_of(task):
        raise UserError(f"task {task}: its Env is called {env.name!r}; call it {name_of(task)!r}, like the file")
    return env


def scene(task: str, real: str = "") -> Any:
    """The parts of a scene of that task (`franka.task.Scene`), see `make`; None for one not simulated by MuJoCo."""
    return _real(task, real) if real else getattr(_module(task), "SCENE", None)


def name_of(task: str) -> str:
    """What a task given by name, file or module is called; its run folders too.

    Also admits the task: from then on the name alone finds it in this process. Raises UserError if there is none.
    """
    _module(task)
    return extend.name_of(task)


def _module(task: str) -> ModuleType:
    if task in TASKS:
        return importlib.import_module(TASKS[task])
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
