"""Impure: exported policies on disk: the contract, the policy, and the file that plays it.

ONNX is written operator by operator. jax2onnx, which would read the JAX function, does not run with JAX 0.12 (version
0.13.0 asks for names that JAX has removed); a policy has a dozen kinds of operators.
"""

import importlib.util
import io
import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Env
from envs.types import UserError
from sgft_jax.export import graph, player
from sgft_jax.export.graph import Format, Graph
from sgft_jax.files.disk import write_json
from sgft_jax.io import checkpoint
from sgft_jax.types import Prior

__all__ = ["save_exported"]

CONTRACT, PLAYER = "contract.json", "policy.py"
LIMIT = 1e-5  # how far an exported action may be from the trained policy's
_CHECKED, _PLANNED = 1000, 50  # random observations that an export is played on; a plan takes longer than an action
_EPISODE = 25  # of them, then it is reset
_OPSET, _IR = 17, 8  # the first with LayerNormalization, and what runtimes of that time read
_ATTRIBUTES: dict[str, dict[str, Any]] = {
    "Concat": {"axis": 0},
    "Gather": {"axis": 0},
    "LayerNormalization": {"axis": -1, "epsilon": 1e-6},
}
_NEEDS: dict[Format, tuple[str, ...]] = {"onnx": ("onnx", "onnxruntime"), "jax": ("flatbuffers",), "numpy": ()}
_PLATFORMS = ("cpu", "cuda")


def check_installed(to: Format) -> None:
    """Raises UserError where a library is missing that this format needs."""
    if missing := [name for name in _NEEDS[to] if importlib.util.find_spec(name) is None]:
        raise UserError(f"--to {to} needs {' and '.join(missing)}: make setup EXTRAS=dev,export")


def save_exported(folder: Path, prior: Prior, env: Env, to: Format) -> float:
    """Writes a policy to a new folder, plays it from there, and returns by how much its actions differ from the
    trained policy's at most.

    Raises UserError if the folder exists, if the format cannot hold the policy, if a library is missing, or if actions
    differ by more than `LIMIT`; then there is no folder.
    """
    if folder.exists():
        raise UserError(f"{folder}: exists already; choose another --out, or remove it")
    check_installed(to)
    content = _WRITERS[to](prior, env)
    with checkpoint.replaced(folder) as temporary:
        for name, data in content.items():
            (temporary / name).write_bytes(data)
        shutil.copyfile(player.__file__, temporary / PLAYER)
        contract = graph.contract(prior, env, to)
        write_json(temporary / CONTRACT, contract)
        n = _PLANNED if graph.plans(prior.card) else _CHECKED
        worst = _difference(player.Policy(temporary), prior, env, n)
        checked = {"observations": n, "largest_difference": worst, "limit": LIMIT}
        write_json(temporary / CONTRACT, {**contract, "checked": checked})
        if not worst <= LIMIT:
            raise UserError(f"{folder}: exported actions differ by {worst:.1e} from the policy's, {LIMIT:.0e} may be")
    return worst


def _difference(exported: player.Policy, prior: Prior, env: Env, n: int) -> float:
    """The largest difference between actions [] on n random observations, drawn as the policy's statistics say."""
    mean, std = (np.asarray(x)[: env.measured_dim] for x in prior.params.normalizer)
    normal = np.random.default_rng(0).normal(size=(n // _EPISODE, _EPISODE, env.measured_dim))
    episodes = (mean + std * normal).astype(np.float32)
    worst = 0.0
    for episode, wanted in zip(episodes, _actions(prior, env, episodes), strict=True):
        exported.reset()
        actions = np.stack([exported.act(measured) for measured in episode])
        worst = max(worst, float(np.abs(actions - wanted).max()))
    return worst


def _actions(prior: Prior, env: Env, episodes: np.ndarray) -> np.ndarray:
    """The policy's own actions [n, T, act_dim] for what is measured in episodes [n, T, measured_dim].

    Step by step, as a robot asks: in a larger program sums round differently, which may tip the choice of a plan.
    """
    step, slots = jax.jit(graph.stepping(prior, env)), graph.slots_of(prior, env)

    def play(episode: np.ndarray) -> Iterator[np.ndarray]:
        state = {slot.name: jnp.zeros(slot.shape, slot.dtype) for slot in slots}
        for measured in episode:
            values = step({graph.MEASURED: measured, **state})
            state = {name: values[graph.NEXT + name] for name in state}
            yield np.asarray(values[graph.ACTION])

    return np.array([list(play(episode)) for episode in episodes])


# --- the formats ------------------------------------------------------------------------------------------------------


def _as_numpy(prior: Prior, env: Env) -> dict[str, bytes]:
    whole, file = graph.graph_of(prior, env), io.BytesIO()
    np.savez(file, allow_pickle=False, nodes=np.array(json.dumps(whole.nodes)), **whole.constants)
    return {"policy.npz": file.getvalue()}


def _as_onnx(prior: Prior, env: Env) -> dict[str, bytes]:
    return {"policy.onnx": onnx_model(graph.graph_of(prior, env))}


def onnx_model(policy: Graph) -> bytes:
    """A graph as an ONNX model."""
    from onnx import TensorProto, checker, helper, numpy_helper  # pyright: ignore[reportMissingImports] - an extra

    nodes = [
        helper.make_node(node.operator, node.inputs, [node.output], **_ATTRIBUTES.get(node.operator, {}))
        for node in policy.nodes
    ]
    constants = [numpy_helper.from_array(value, name) for name, value in policy.constants.items()]
    inputs, outputs = (
        [helper.make_tensor_value_info(slot.name, TensorProto.FLOAT, slot.shape) for slot in slots]
        for slots in (policy.inputs, policy.outputs)
    )
    whole = helper.make_graph(nodes, "policy", inputs, outputs, constants)
    model = helper.make_model(whole, opset_imports=[helper.make_opsetid("", _OPSET)], ir_version=_IR)
    checker.check_model(model, full_check=True)
    return model.SerializeToString()


def _as_jax(prior: Prior, env: Env) -> dict[str, bytes]:
    inputs = {slot.name: jax.ShapeDtypeStruct(slot.shape, slot.dtype) for slot in graph.slots_of(prior, env)}
    inputs[graph.MEASURED] = jax.ShapeDtypeStruct((env.measured_dim,), "float32")
    step = jax.jit(graph.stepping(prior, env))
    return {"policy.jax": bytes(jax.export.export(step, platforms=_PLATFORMS)(inputs).serialize())}


_WRITERS = {"numpy": _as_numpy, "onnx": _as_onnx, "jax": _as_jax}
