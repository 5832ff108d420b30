"""Tasks: pure functions of an explicit world. `make(name)` builds one."""

import importlib
from types import ModuleType
from typing import Any

from envs.base import Env
from sgft_jax.types import UserError, unknown

TASKS = {"push": "envs.franka.push", "hammer": "envs.franka.hammer", "insert": "envs.franka.insert"}


def make(name: str, impl: str = "auto") -> Env:
    """The task of that name, compiled; impl: who steps its physics, see `physics.choose_impl`.

    Raises UserError with the closest match for an unknown task.
    """
    return _module(name).make(impl)


def scene(name: str) -> Any:
    """The parts that the task of that name is made of; None for a task that is not simulated by MuJoCo."""
    return getattr(_module(name), "SCENE", None)


def _module(name: str) -> ModuleType:
    if name not in TASKS:
        raise UserError(unknown("task", name, TASKS))
    return importlib.import_module(TASKS[name])
