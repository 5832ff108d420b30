"""Impure: a policy as something to take away, in a folder: the contract, the policy, and the file that plays it.

The policy is one step, as a graph of simple operators or as a JAX function: from what was measured and the state to the
action and the next state. All else is inside: observation statistics, what was identified of the system.

ONNX is written operator by operator. jax2onnx, which would read the JAX function, does not run with JAX 0.12 (version
0.13.0 asks for names that JAX has removed); a policy has a dozen kinds of operators.
"""

import importlib.util
import io
import json
import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.base import Env
from envs.types import Array, PyTree, UserError
from sgft_jax.algorithms import algorithm_of, make_policy
from sgft_jax.export import player
from sgft_jax.files.disk import write_json
from sgft_jax.io import checkpoint
from sgft_jax.io.priors import digest
from sgft_jax.models.config import NetworkConfig, network_of
from sgft_jax.models.distortion import Distortion
from sgft_jax.types import Prior

__all__ = ["save_exported"]

Format = Literal["onnx", "jax", "numpy"]
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
MEASURED, ACTION, NEXT = "measured", "action", "next_"
_PREVIOUS, _STEP = "previous_actions", "step"
_SEED = 0  # of the random numbers of plans
_MODE = "the mean action, without exploration: the same action for the same episode"
_PLAN = "a plan at every step, without exploration; its random numbers are the same in every episode"


class Slot(NamedTuple):
    """A part of the state, which is zero at the start of an episode."""

    name: str
    shape: tuple[int, ...]
    dtype: str


class Node(NamedTuple):
    """One ONNX operator: what it is called, what it reads (inputs, constants or earlier outputs), what it writes.

    `Concat` and `Gather` work along axis 0, `LayerNormalization` along the last one with epsilon 1e-6.
    """

    operator: str
    inputs: tuple[str, ...]
    output: str


class Graph(NamedTuple):
    """One step. inputs: `measured` and the state. constants: by name. outputs: `action`, and `next_` for each slot."""

    inputs: tuple[Slot, ...]
    constants: dict[str, np.ndarray]
    nodes: tuple[Node, ...]
    outputs: tuple[Slot, ...]


# --- what is left over from step to step ------------------------------------------------------------------------------


def slots_of(prior: Prior, env: Env) -> tuple[Slot, ...]:
    """The state of a policy: previous actions, newest first; its memory; which step it is, if it plans."""
    slots = [Slot(_PREVIOUS, (env.previous_actions * env.act_dim,), "float32")] if env.previous_actions else []
    carry = jax.tree.leaves(make_policy(prior.card, env).init_carry())
    slots += [Slot(_memory(i), leaf.shape, str(leaf.dtype)) for i, leaf in enumerate(carry)]
    return (*slots, Slot(_STEP, (), "int32")) if plans(prior.card) else tuple(slots)


def plans(card: Mapping[str, Any]) -> bool:
    """Whether a policy searches for a plan at every step."""
    return algorithm_of(card).plans(card)


def _memory(i: int) -> str:
    return f"memory_{i}"


def stepping(prior: Prior, env: Env) -> Callable[[dict[str, Array]], dict[str, Array]]:
    """One step of any policy, from its inputs by name to its outputs by name."""
    policy = make_policy(prior.card, env)
    structure = jax.tree.structure(policy.init_carry())

    def step(inputs: dict[str, Array]) -> dict[str, Array]:
        key, outputs = jax.random.key(_SEED), {}
        if _STEP in inputs:
            key = jax.random.fold_in(key, inputs[_STEP])
            outputs[NEXT + _STEP] = inputs[_STEP] + 1
        carry = jax.tree.unflatten(structure, [inputs[_memory(i)] for i in range(structure.num_leaves)])
        previous = inputs.get(_PREVIOUS, jnp.zeros(0))
        obs = jnp.concatenate([inputs[MEASURED], previous, jnp.zeros(len(env.system))])  # its own estimate counts
        with jax.default_matmul_precision("highest"):
            action, carry = policy.act(prior.params, carry, obs, key, explore=False)
        if _PREVIOUS in inputs:
            outputs[NEXT + _PREVIOUS] = jnp.concatenate([action, previous])[: previous.size]
        memory = {NEXT + _memory(i): leaf for i, leaf in enumerate(jax.tree.leaves(carry))}
        return {ACTION: action, **outputs, **memory}

    return step


# --- as a graph -------------------------------------------------------------------------------------------------------


class _Writer:
    """Collects constants and nodes. Called with an operator and its inputs, it returns the name of the output."""

    def __init__(self) -> None:
        self.constants: dict[str, np.ndarray] = {}
        self.nodes: list[Node] = []

    def __call__(self, operator: str, *inputs: Any, to: str | None = None) -> str:
        names = tuple(x if isinstance(x, str) else self._constant(x) for x in inputs)
        self.nodes.append(Node(operator, names, to or f"x{len(self.nodes)}"))
        return self.nodes[-1].output

    def _constant(self, value: Any) -> str:
        array, name = np.asarray(value), f"c{len(self.constants)}"
        self.constants[name] = array.astype(np.int64 if array.dtype.kind in "iu" else np.float32)
        return name


def graph_of(prior: Prior, env: Env) -> Graph:
    """One step of a policy that acts by networks alone; raises UserError for one that plans."""
    if plans(prior.card):
        advice = "for numpy and onnx take a policy of a method that does not plan, such as guarded"
        raise UserError(f"this policy plans at every step, which only --to jax can export; {advice}")
    params, write, slots = prior.params, _Writer(), slots_of(prior, env)
    network, previous = network_of(prior.card), _PREVIOUS if env.previous_actions else None
    obs = _observed(write, params, env, previous)
    if algorithm_of(prior.card).remembers:
        hidden, features = _remembered(write, params.actor["memory"], obs)
        action = _action(write, params.actor["head"], features, network, env.act_dim)
        write("Identity", hidden, to=NEXT + _memory(0))
        write("Identity", action, to=NEXT + _memory(1))
    else:
        actor = params.actor["body"] if prior.card.get("head") == "affine" else params.actor
        action = _action(write, actor, obs, network, env.act_dim)
    if (distortion := getattr(params, "distortion", None)) is not None:
        action = _command(write, distortion, action)
    write("Identity", action, to=ACTION)
    if previous:
        both = write("Concat", action, previous)
        write("Gather", both, np.arange(env.previous_actions * env.act_dim), to=NEXT + previous)
    measured = Slot(MEASURED, (env.measured_dim,), "float32")
    outputs = (Slot(ACTION, (env.act_dim,), "float32"), *(slot._replace(name=NEXT + slot.name) for slot in slots))
    return Graph((measured, *slots), write.constants, tuple(write.nodes), outputs)


def _observed(write: _Writer, params: Any, env: Env, previous: str | None) -> str:
    """What networks read: measurements, previous actions as they were meant, the system; normalised."""
    parts: list[Any] = [MEASURED] + ([previous] if previous else [])
    if (distortion := getattr(params, "distortion", None)) is not None:
        parts[0] = write("Sub", MEASURED, distortion.offset)
        if previous:
            matrix, n = np.asarray(distortion.matrix), env.previous_actions
            meant = write("MatMul", previous, np.kron(np.eye(n), matrix.T))
            parts[1] = write("Add", meant, np.tile(np.asarray(distortion.bias), n))
    if env.system:
        parts.append(_system(params, env))
    obs = write("Concat", *parts)
    return write("Div", write("Sub", obs, params.normalizer.mean), params.normalizer.std)


def _system(params: Any, env: Env) -> np.ndarray:
    """What the policy reads of the system, [k]: what was identified, or the middle of every range."""
    identified = getattr(params, "system", None)
    return np.zeros(len(env.system)) if identified is None else np.asarray(identified)


def _action(write: _Writer, params: PyTree, x: str, network: NetworkConfig, act_dim: int) -> str:
    """The mode of a tanh-Gaussian, or what a deterministic actor does."""
    activation = network.activation.capitalize()  # the operator's name
    if network.blind:
        x = write("Gather", x, np.arange(params["Dense_0"]["kernel"].shape[0]))
    for i in range(len(network.hidden)):
        x = _dense(write, params[f"Dense_{i}"], x)
        if network.actor_layer_norm:
            x = write("LayerNormalization", x, *(params[f"LayerNorm_{i}"][name] for name in ("scale", "bias")))
        x = write("Mul", x, write("Sigmoid", x)) if network.activation == "silu" else write(activation, x)
    outputs = _dense(write, params[f"Dense_{len(network.hidden)}"], x)
    return write("Tanh", write("Gather", outputs, np.arange(act_dim)))


def _dense(write: _Writer, params: PyTree, x: str) -> str:
    return write("Add", write("MatMul", x, params["kernel"]), params["bias"])


def _remembered(write: _Writer, params: PyTree, obs: str) -> tuple[str, str]:
    """The next state of the GRU, and what it hands on; see `sgft_jax.models.gru`."""
    units = params["recurrent"]["kernel"].shape[0]

    def third(x: str, i: int) -> str:
        return write("Gather", x, np.arange(i * units, (i + 1) * units))

    seen = [write("Relu", _dense(write, params[name], x)) for name, x in (("action", _memory(1)), ("obs", obs))]
    read = _dense(write, params["inputs"], write("Concat", *seen))
    before = _dense(write, params["recurrent"], _memory(0))
    reset, keep = (write("Sigmoid", write("Add", third(read, i), third(before, i))) for i in (0, 1))
    new = write("Tanh", write("Add", third(read, 2), write("Mul", reset, third(before, 2))))
    hidden = write("Add", new, write("Mul", keep, write("Sub", _memory(0), new)))
    return hidden, write("Concat", hidden, write("Relu", _dense(write, params["shortcut"], obs)))


def _command(write: _Writer, distortion: Distortion, action: str) -> str:
    """As `Distortion.command`, with the inverse taken here."""
    inverse = np.linalg.inv(np.asarray(distortion.matrix, np.float64))
    exact = write("MatMul", write("Sub", action, distortion.bias), inverse.T)
    return write("Clip", exact, -1.0, 1.0)


# --- the contract -----------------------------------------------------------------------------------------------------


def contract(prior: Prior, env: Env, to: Format) -> dict[str, Any]:
    """What the caller and the policy promise each other, as JSON data; docs/export.md explains the keys."""
    card, params = prior.card, prior.params
    origin = {name: card[name] for name in ("preset", "finetuned", "hybrid") if name in card}
    distortion = getattr(params, "distortion", None)
    identified = None if distortion is None else {k: np.asarray(x) for k, x in distortion._asdict().items()}
    system = [{**v._asdict(), "value": x} for v, x in zip(env.system, _system(params, env), strict=True)]
    policy = {"algorithm": algorithm_of(card).name, "digest": digest(prior), **origin}
    times = {"control_period_s": env.control_dt, "episode_steps": env.episode_length}
    actions = [{**entry, "low": -1.0, "high": 1.0} for entry in _entries(env.action)]
    spaces = {"observation": _entries(env.measured), "action": actions}
    normalisation = {name: np.asarray(x) for name, x in params.normalizer._asdict().items()}
    inside = {"previous_actions": env.previous_actions, "system": system}
    inside |= {"normalisation": normalisation, "identified": identified}
    kind = {"format": 1, "to": to, "task": env.name, "policy": policy, **times, **spaces}
    kind |= {"action_is": _PLAN if plans(card) else _MODE, "inside": inside}
    # The parts of the state whose first numbers are the last action.
    last = {_PREVIOUS: env.previous_actions, _memory(1): algorithm_of(card).remembers}
    return {**kind, "state": slots_of(prior, env), "last_action": [name for name, held in last.items() if held]}


def _entries(entries: tuple[Any, ...]) -> list[dict[str, Any]]:
    """Names, units and places of the numbers of a vector."""
    first = np.cumsum([0, *(e.size for e in entries)])
    return [
        {"name": e.name, "unit": e.unit, "first": int(i), "size": e.size} for e, i in zip(entries, first, strict=False)
    ]


# --- the folder -------------------------------------------------------------------------------------------------------


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
    name, content = _file_of(prior, env, to)
    with checkpoint.replaced(folder) as temporary:
        (temporary / name).write_bytes(content)
        shutil.copyfile(player.__file__, temporary / PLAYER)
        promises = contract(prior, env, to)
        write_json(temporary / CONTRACT, promises)
        n = _PLANNED if plans(prior.card) else _CHECKED
        worst = _difference(player.Policy(temporary), prior, env, n)
        checked = {"observations": n, "largest_difference": worst, "limit": LIMIT}
        write_json(temporary / CONTRACT, {**promises, "checked": checked})
        if not worst <= LIMIT:
            raise UserError(f"{folder}: exported actions differ by {worst:.1e} from the policy's, {LIMIT:.0e} may be")
    return worst


def _difference(exported: player.Policy, prior: Prior, env: Env, n: int) -> float:
    """The largest difference between actions on n random observations, drawn as the policy's statistics say.

    Step by step, as a robot asks: in a larger program sums round differently, which may tip the choice of a plan.
    """
    mean, std = (np.asarray(x)[: env.measured_dim] for x in prior.params.normalizer)
    normal = np.random.default_rng(0).normal(size=(n // _EPISODE, _EPISODE, env.measured_dim))
    step, slots, worst = jax.jit(stepping(prior, env)), slots_of(prior, env), 0.0
    for episode in (mean + std * normal).astype(np.float32):
        exported.reset()
        state = {slot.name: jnp.zeros(slot.shape, slot.dtype) for slot in slots}
        for measured in episode:
            values = step({MEASURED: measured, **state})
            state = {name: values[NEXT + name] for name in state}
            worst = max(worst, float(np.abs(exported.act(measured) - np.asarray(values[ACTION])).max()))
    return worst


def _file_of(prior: Prior, env: Env, to: Format) -> tuple[str, bytes]:
    """The file with the policy: its name and its content."""
    if to == "jax":
        inputs = {slot.name: jax.ShapeDtypeStruct(slot.shape, slot.dtype) for slot in slots_of(prior, env)}
        inputs[MEASURED] = jax.ShapeDtypeStruct((env.measured_dim,), "float32")
        step = jax.jit(stepping(prior, env))
        return "policy.jax", bytes(jax.export.export(step, platforms=_PLATFORMS)(inputs).serialize())
    graph, file = graph_of(prior, env), io.BytesIO()
    if to == "onnx":
        return "policy.onnx", onnx_model(graph)
    np.savez(file, allow_pickle=False, nodes=np.array(json.dumps(graph.nodes)), **graph.constants)
    return "policy.npz", file.getvalue()


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
