# MuJoCo's names come from compiled modules that ship no stubs: to the type checker they are all Any.
from typing import Any

def __getattr__(name: str) -> Any: ...
