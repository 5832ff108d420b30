"""Tasks: pure functions of an explicit world. `make(name)` builds one."""

import difflib
import importlib

from envs.base import Env
from sgft_jax.types import UserError

TASKS = {"push": "envs.franka.push", "hammer": "envs.franka.hammer", "insert": "envs.franka.insert"}


def make(name: str) -> Env:
    """The task of that name, compiled; raises UserError with the closest match for an unknown one."""
    if name not in TASKS:
        close = difflib.get_close_matches(name, TASKS, n=1)
        hint = f"; did you mean '{close[0]}'?" if close else ""
        raise UserError(f"there is no task '{name}'{hint} Tasks: {', '.join(TASKS)}")
    return importlib.import_module(TASKS[name]).make()
