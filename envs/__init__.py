"""Tasks: pure functions of an explicit world. `make(name)` builds one."""

import importlib

from envs.base import Env
from sgft_jax.types import UserError, unknown

TASKS = {"push": "envs.franka.push", "hammer": "envs.franka.hammer", "insert": "envs.franka.insert"}


def make(name: str) -> Env:
    """The task of that name, compiled; raises UserError with the closest match for an unknown one."""
    if name not in TASKS:
        raise UserError(unknown("task", name, TASKS))
    return importlib.import_module(TASKS[name]).make()
