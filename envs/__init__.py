"""Tasks: pure functions of an explicit world. `make(name)` builds one."""

import importlib
from types import ModuleType
from typing import Any

from envs.base import Env
from sgft_jax.types import UserError, unknown

TASKS = {
    "push": "envs.franka.push",
    "push-towel": "envs.franka.towel",
    "push-ball": "envs.franka.ball",
    "hammer": "envs.franka.hammer",
    "insert": "envs.franka.insert",
}


def make(name: str, impl: str = "auto", scene: str = "") -> Env:
    """The task of that name, compiled; impl: who steps its physics, see `physics.choose_impl`.

    scene: that of a real system which is more than the simulated one with other numbers; "" for the latter. What is
    observed, commanded and rewarded, and the parameters, are the same in all scenes of a task. Raises UserError with
    the closest match for an unknown task or scene.
    """
    module = _module(name)
    return module.make(impl, _real(name, scene)) if scene else module.make(impl)


def scene(name: str, real: str = "") -> Any:
    """The parts of a scene of that task, see `make`; None for a task that is not simulated by MuJoCo."""
    return _real(name, real) if real else getattr(_module(name), "SCENE", None)


def _module(name: str) -> ModuleType:
    if name not in TASKS:
        raise UserError(unknown("task", name, TASKS))
    return importlib.import_module(TASKS[name])


def _real(name: str, scene: str) -> Any:
    scenes = getattr(_module(name), "REAL", {})
    if scene not in scenes:
        raise UserError(f"{name}: {unknown('scene', scene, scenes)}" if scenes else f"{name} has no scene '{scene}'")
    return scenes[scene]
