"""Impure: plays an exported policy. Stands alone: every export has a copy of this file, and a robot needs no other.

    policy = Policy()              # what lies beside this file
    policy.reset()                 # at the start of every episode
    action = policy.act(measured)  # once in every control period

contract.json says what `measured` and `action` hold, in which order and unit. Python 3.9 or newer and NumPy;
onnxruntime for policy.onnx; JAX for policy.jax.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Callable  # noqa: UP035 - as Python 3.9 spells it

import numpy as np

Step = Callable[[dict], dict]


class Policy:
    """The policy in a folder: that of this file, or another one. It remembers the episode between two steps.

    contract: the content of contract.json.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        home = Path(__file__).parent if folder is None else Path(folder)
        self.contract = json.loads((home / "contract.json").read_text())
        self._names, self._commands = (_each(self.contract[kind]) for kind in ("observation", "action"))
        self._step = _OPENERS[self.contract["to"]](home)
        self.reset()

    def reset(self) -> None:
        """Forgets the episode; call it at the start of the next one."""
        self._state = {e["name"]: np.zeros(e["shape"], e["dtype"]) for e in self.contract["state"]}

    def act(self, measured: Any, sent: Any = None) -> np.ndarray:
        """The action [act_dim] in [-1, 1] for what was measured, in the order and the units of the contract.

        sent: [act_dim] in [-1, 1], what the robot was really told last time, where something has changed the action,
        such as a limit of force or workspace. Default: the action as it was. At the first step there was none.
        Raises ValueError for another number of entries, and for one that is not finite; nothing is remembered then.
        """
        measured = _numbers(measured, self._names, "the policy reads {} measured numbers")
        state = self._state
        if sent is not None:
            sent = _numbers(sent, self._commands, "an action has {} numbers")
            corrected = self.contract["last_action"]
            state = {**state, **{name: np.concatenate([sent, state[name][len(sent) :]]) for name in corrected}}
        found = self._step({"measured": measured, **state})
        self._state = {name: found["next_" + name] for name in self._state}
        return np.asarray(found["action"])


def _each(entries: list) -> list[str]:
    """The name of every number."""
    return [f"{e['name']}[{i}]" for e in entries for i in range(e["size"])]


def _numbers(given: Any, names: list[str], wanted: str) -> np.ndarray:
    """As an array; ValueError where their number is not what is `wanted`, or one is not finite."""
    numbers = np.asarray(given, np.float32)
    if numbers.shape != (len(names),):
        raise ValueError(f"{wanted.format(len(names))}, got shape {numbers.shape}")
    if odd := [name for name, ok in zip(names, np.isfinite(numbers)) if not ok]:  # noqa: B905 - new in 3.10
        raise ValueError(f"{odd[0]} is not a finite number")
    return numbers


def _layer_norm(x: np.ndarray, scale: np.ndarray, bias: np.ndarray) -> np.ndarray:
    off = x - x.mean()
    return off / np.sqrt((off * off).mean() + np.float32(1e-6)) * scale + bias


# What nodes of policy.npz do; each has the name of the ONNX operator that does the same.
_OPERATORS = {
    "Add": np.add,
    "Sub": np.subtract,
    "Mul": np.multiply,
    "Div": np.divide,
    "MatMul": np.matmul,
    "Tanh": np.tanh,
    "Sigmoid": lambda x: np.float32(0.5) * (np.tanh(np.float32(0.5) * x) + np.float32(1.0)),
    "Relu": lambda x: np.maximum(x, np.float32(0.0)),
    "Elu": lambda x: np.where(x > 0, x, np.expm1(np.minimum(x, np.float32(0.0)))),
    "LayerNormalization": _layer_norm,
    "Clip": np.clip,
    "Concat": lambda *x: np.concatenate(x),
    "Gather": np.take,
    "Identity": lambda x: x,
}


def _open_numpy(home: Path) -> Step:
    with np.load(home / "policy.npz") as file:
        arrays = {name: file[name] for name in file.files}
    nodes = json.loads(str(arrays.pop("nodes")))

    def step(inputs: dict) -> dict:
        values = {**arrays, **inputs}
        for operator, names, output in nodes:
            values[output] = _OPERATORS[operator](*[values[name] for name in names])
        return values

    return step


def _open_onnx(home: Path) -> Step:
    import onnxruntime  # pyright: ignore[reportMissingImports] - an extra

    session = onnxruntime.InferenceSession(str(home / "policy.onnx"), providers=["CPUExecutionProvider"])
    outputs = [output.name for output in session.get_outputs()]
    return lambda inputs: dict(zip(outputs, session.run(outputs, inputs)))  # noqa: B905 - new in 3.10


def _open_jax(home: Path) -> Step:
    import jax
    from jax import export

    return jax.jit(export.deserialize(bytearray((home / "policy.jax").read_bytes())).call)


_OPENERS = {"numpy": _open_numpy, "onnx": _open_onnx, "jax": _open_jax}
