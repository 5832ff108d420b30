"""Impure: plays an exported policy. Stands alone: every export has a copy of this file, and a robot needs no other.

    policy = Policy()              # what lies beside this file
    policy.reset()                 # at the start of every episode
    action = policy.act(measured)  # once in every control period

contract.json says what `measured` and `action` hold, in which order and unit. Python 3.9 or newer and NumPy;
onnxruntime for policy.onnx; JAX for policy.jax.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

Step = Callable[[dict], dict]
LARGEST = 1e12  # no unit measures more, and its square, divided by the smallest std, is far from float32's largest
_BEYOND = 1e-3  # how far rounding may lead an action out of [-1, 1]


class Policy:
    """The policy in a folder: that of this file, or another one. It remembers the episode between two steps.

    contract: the content of contract.json.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        home = Path(__file__).parent if folder is None else Path(folder)
        try:
            self.contract = json.loads((home / "contract.json").read_text(encoding="utf-8"))
            self._names, self._commands = (_names(self.contract[kind]) for kind in ("observation", "action"))
            self._corrected, opener = list(self.contract["last_action"]), _OPENERS[self.contract["to"]]
            self.reset()
        except (KeyError, TypeError, ValueError, RecursionError) as error:
            raise ValueError(f"{home / 'contract.json'}: is no contract of an exported policy ({error!r})") from None
        self._step = opener(home)

    def reset(self) -> None:
        """Forgets the episode; call it at the start of the next one."""
        self._state = {e["name"]: np.zeros(e["shape"], e["dtype"]) for e in self.contract["state"]}

    def act(self, measured: Any, sent: Any = None) -> np.ndarray:
        """The action [act_dim] in [-1, 1] for what was measured, in the order and the units of the contract.

        sent: [act_dim] in [-1, 1], what the robot was really told last time, where something has changed the action,
        such as a limit of force or workspace. Default: the action as it was. At the first step there was none.
        Raises ValueError for another number of entries, and for one that is no number, not finite or too large; nothing
        is remembered then.
        """
        measured = numbers(measured, self._names, "the policy reads {} measured numbers")
        state = self._state
        if sent is not None:
            sent = numbers(sent, self._commands, "an action has {} numbers", largest=1 + _BEYOND)
            state = {**state, **{name: np.concatenate([sent, state[name][len(sent) :]]) for name in self._corrected}}
        values = self._step({"measured": measured, **state})
        action, state = np.asarray(values["action"]), {name: values["next_" + name] for name in self._state}
        check_answer(action, *state.values())
        self._state = state
        return action


def _names(entries: list) -> list[str]:
    """The name of every number."""
    return [f"{e['name']}[{i}]" for e in entries for i in range(e["size"])]


def numbers(values: Any, names: list[str], wanted: str, *, largest: float = LARGEST) -> np.ndarray:
    """As an array float32; ValueError where their number is not what is `wanted`, or one is no number or too large."""
    try:
        array = np.asarray(values)
    except ValueError:  # rows of different lengths
        array = np.asarray(None)
    if array.shape != (len(names),):
        raise ValueError(f"{wanted.format(len(names))}, got shape {array.shape}")
    if array.dtype.kind not in "biuf":
        raise ValueError(f"{wanted.format(len(names))}, got {array.dtype.name}")
    for name, value in zip(names, array):
        if not np.isfinite(value):
            raise ValueError(f"{name} is not a finite number")
        if abs(value) > largest:
            raise ValueError(f"{name} is {value:g}: too large, at most {largest:g}")
    return array.astype(np.float32)


def check_answer(*parts: Any) -> None:
    """ValueError where an action, or what is to be remembered, is not finite."""
    if not all(np.isfinite(np.asarray(part)).all() for part in parts):
        raise ValueError("the policy has no finite answer to these measurements")


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
    return lambda inputs: dict(zip(outputs, session.run(outputs, inputs)))


def _open_jax(home: Path) -> Step:
    import jax
    from jax import export

    return jax.jit(export.deserialize(bytearray((home / "policy.jax").read_bytes())).call)


_OPENERS = {"numpy": _open_numpy, "onnx": _open_onnx, "jax": _open_jax}
