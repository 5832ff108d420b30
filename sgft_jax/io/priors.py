"""Impure: priors on disk, what pretraining hands to fine-tuning: a checkpoint of parameters and a readable card."""

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from envs import mesh
from envs.base import Varying
from envs.types import PyTree, UserError
from sgft_jax.algorithms import algorithm_of
from sgft_jax.files.arrays import check_claim
from sgft_jax.files.disk import differences, present, write_json
from sgft_jax.io import checkpoint
from sgft_jax.io.cards import CARD, read_card, resolve_shipped
from sgft_jax.models.distortion import Distortion
from sgft_jax.models.networks import Network, check_params
from sgft_jax.posterior.estimator import Estimator, Statistics, without_estimator
from sgft_jax.types import Normalizer, Prior

__all__ = ["load_prior", "save_prior"]

_ESTIMATOR = "float16"  # what its numbers are on disk


def save_prior(folder: str | Path, prior: Prior) -> Path:
    """Write a prior to `folder`, replacing the one that may be there, and return the folder.

    The card must have `task`, `obs_dim` and `act_dim`, which are checked on loading, `gamma` (the discount), and
    `algorithm` unless that is SAC. Parameters must be NamedTuples and dicts of arrays: such a prior can be read without
    the code that describes its networks. An estimator is written in half precision. Raises ValueError or TypeError
    otherwise, and UserError where `folder` holds something else.
    """
    if missing := {"task", "obs_dim", "act_dim", "gamma"} - set(prior.card):
        raise ValueError(f"the prior's card lacks {sorted(missing)}")
    tree, folder = _plain(prior.params), Path(folder)
    if "estimator" in tree:
        tree["estimator"] = jax.tree.map(lambda x: np.asarray(x, _ESTIMATOR), tree["estimator"])
    if folder.is_dir() and any(folder.iterdir()) and not (folder / CARD).exists():
        raise UserError(f"{folder}: holds something else than a prior; choose another folder")
    with checkpoint.replaced(folder) as temporary:
        if checkpoint.first_host():
            write_json(temporary / CARD, prior.card)
        checkpoint.write_tree(temporary, tree, {})
    mesh.meet()
    return folder


def load_prior(
    folder: str | Path, *, task: str | None = None, obs_dim: int | None = None, act_dim: int | None = None
) -> Prior:
    """Read a prior from its folder, from the run folder that holds one as `prior/`, or by name: `shipped:push/seed-0`.

    Its parameters are those of its algorithm, with None where there are none. Raises UserError if the prior is missing,
    torn, or of another task, other sizes than asked for, or another version, or if its numbers are not those of the
    networks that its card describes.
    """
    folder = _home(folder)
    manifest, card = checkpoint.read_manifest(folder), read_card(folder)
    asked = {"task": task, "obs_dim": obs_dim, "act_dim": act_dim}
    checkpoint.check_facts(folder, card, {name: value for name, value in asked.items() if value is not None})
    leaves = checkpoint.leaves_of(manifest)
    paths, shapes = [leaf.path for leaf in leaves], [jax.ShapeDtypeStruct(leaf.shape, leaf.dtype) for leaf in leaves]
    try:  # before memory is taken for what a file claims
        params = _params(card, paths, shapes)
        _check_parameters(card, params, algorithm_of(card).networks(card, params))
    except UserError as error:
        raise UserError(f"{folder}: {error}") from None
    check_claim(
        folder, 4 * sum(math.prod(leaf.shape) for leaf in leaves), sum(n for n, _ in manifest["files"].values())
    )
    checkpoint.check_files(folder, manifest)
    arrays = checkpoint.read_leaves(folder, manifest)
    if odd := [path for path, x in zip(paths, arrays, strict=True) if not np.isfinite(x).all()]:
        raise UserError(f"{folder}: {odd[0]} holds numbers that are not finite; take another prior, or pretrain again")
    return Prior(_params(card, paths, [jnp.asarray(x, jnp.float32) for x in arrays]), card)


def _params(card: Mapping[str, Any], paths: Sequence[str], leaves: Sequence[Any]) -> Any:
    """The parameters that hold arrays, or shapes, with these paths."""
    container, tree = algorithm_of(card).params(), _nest(paths, leaves)
    if odd := sorted(set(tree) - set(container._fields)):
        raise UserError(f"holds {', '.join(odd)}, which this version does not know; pretrain again")
    for name, kind in (("normalizer", Normalizer), ("distortion", Distortion), ("estimator", Estimator)):
        if (part := tree.get(name)) is not None:
            tree[name] = _made(kind, part, name)
    if (estimator := tree.get("estimator")) is not None:
        statistics = _made(Statistics, estimator.statistics, "estimator's statistics")
        tree["estimator"] = estimator._replace(statistics=statistics)
    return container(**{name: tree.get(name) for name in container._fields})


def _made(kind: Any, part: Any, name: str) -> Any:
    """The NamedTuple that a dict describes."""
    if not isinstance(part, dict) or set(part) != set(kind._fields):
        raise UserError(f"its {name} is not of {', '.join(kind._fields)}; pretrain again")
    return kind(**part)


def _check_parameters(card: Mapping[str, Any], params: Any, described: Iterable[tuple[str, Network, PyTree]]) -> None:
    """Raises UserError where parameters, or their shapes, are not of the sizes and networks that a card describes.

    Parts that a prior does not have are None; all have statistics and what acts. described: (name, network, what the
    prior has for it) of the networks by its card, see `Algorithm.networks`.
    """
    obs_dim, act_dim, entries = card["obs_dim"], card["act_dim"], len(card.get("system", []))
    sizes = {
        "normalizer": ((obs_dim,), (obs_dim,)),
        "distortion": ((act_dim, act_dim), (act_dim,), (_offsets(params, obs_dim, act_dim),)),
        "system": (entries,),
        "scale": (),
    }
    if params.normalizer is None:
        raise UserError("not a prior: it has no observation statistics")
    if (shape := getattr(params.normalizer.mean, "shape", ())) != (obs_dim,):
        raise UserError(f"its card says obs_dim={obs_dim}, the statistics have {' x '.join(map(str, shape))}")
    for name, wanted in sizes.items():
        part = getattr(params, name, None)
        if part is not None and (shapes := jax.tree.map(lambda x: x.shape, part)) != wanted:
            raise UserError(f"{name} has the shapes {shapes}, by its card {wanted}; take another prior")
    for name, network, part in described:
        check_params(name, network, part, "its card; take another prior")
    for path, x in jax.tree_util.tree_leaves_with_path(params):
        stored = _ESTIMATOR if path[0].name == "estimator" else "float32"
        if x.dtype != stored:
            raise UserError(f"{jax.tree_util.keystr(path)} is not {stored}; take another prior")


def _offsets(params: Any, obs_dim: int, act_dim: int) -> int:
    """How many measurements a prior corrects, if whole actions then follow them in an observation; else none fit."""
    count = sum(math.prod(x.shape) for x in jax.tree.leaves(getattr(getattr(params, "distortion", None), "offset", ())))
    return count if count <= obs_dim and (obs_dim - count) % act_dim == 0 else -1


def variant(card: Mapping[str, Any]) -> dict[str, Any]:
    """Of its task what a prior knows, as arguments of `envs.make`: what it reads beside measurements, and rewards."""
    system = tuple(Varying(**entry) for entry in card.get("system", []))
    return {
        "previous_actions": card.get("previous_actions", 0),
        "system": system,
        "sparse": card.get("sparse", False),
    }


def variant_of(folders: Sequence[Path]) -> dict[str, Any]:
    """The same for priors in folders that are used together; nothing where there is no prior."""
    home = _home(folders[0]) if folders else None
    return variant(read_card(home) if home is not None and (home / CARD).exists() else {})


def load_priors(folders: Sequence[Path], env: Any, *, estimators: bool = False) -> list[Prior]:
    """Priors that are used together; raises UserError where they differ in more than their numbers.

    env: what has the `name`, `obs_dim` and `act_dim` that they must have. estimators: whether those that have one keep
    it, which few need.
    """
    priors = [load_prior(folder, task=env.name, obs_dim=env.obs_dim, act_dim=env.act_dim) for folder in folders]
    for folder, prior in zip(folders, priors, strict=True):
        if odd := differences(_structure(priors[0].card), _structure(prior.card)):
            names = sorted({name.partition(".")[0] for name, *_ in odd})
            raise UserError(f"{folder}: differs from {folders[0]} in {', '.join(names)}; choose one with --prior")
    return priors if estimators else [Prior(without_estimator(prior.params), prior.card) for prior in priors]


def _home(folder: str | Path) -> Path:
    """The folder itself, or the prior inside a run folder. Raises UserError for a folder of several, and for none."""
    home, inside = present(resolve_shipped(folder)), present(resolve_shipped(folder) / "prior")
    for place in (home, inside):
        if (place / CARD).exists():
            return place
        if cards := sorted(set(place.glob(f"*/{CARD}")) - {inside / CARD}):
            one = cards[0].parent.relative_to(home)
            raise UserError(f"{folder}: holds priors, name one of them, such as {folder}/{one}")
    if not home.exists():
        raise UserError(f"{folder}: no such folder")
    return home


def digest(prior: Prior) -> str:
    """Twelve hex digits that tell whether two priors hold the same numbers under the same names."""
    sha = hashlib.sha256()
    for path, leaf in jax.tree_util.tree_leaves_with_path(_plain(prior.params)):
        sha.update(str(checkpoint.describe(path, leaf)).encode())
        sha.update(np.ascontiguousarray(leaf).tobytes())
    return sha.hexdigest()[:12]


def _structure(card: Mapping[str, Any]) -> dict[str, Any]:
    """What must be equal for policies that run in one program."""
    algorithm = algorithm_of(card)
    shared = {name: card.get(name) for name in ("network", "gamma", "ensemble_size", "plan", "estimator")}
    shared |= {name: card["config"][name] for name in algorithm.program}
    return shared | {
        "algorithm": algorithm.name,
        **variant(card),
        "value_system": card.get("value_system"),
        "gap": card.get("gap"),  # methods that ask for simulated data get that of one simulator
    }


def _plain(tree: PyTree) -> PyTree:
    """The same parameters as nested dicts, empty where there are none; raises TypeError for anything else."""
    if hasattr(tree, "_asdict"):
        tree = tree._asdict()
    if isinstance(tree, dict) and all(isinstance(name, str) and "/" not in name for name in tree):
        return {name: _plain(part) for name, part in tree.items()}
    if tree is None:
        return {}
    if isinstance(tree, np.generic):  # what NumPy makes of a number of an array
        return np.asarray(tree)
    if not isinstance(tree, (jax.Array, np.ndarray)):
        raise TypeError("prior parameters must be NamedTuples and dicts of arrays")
    return tree


def _nest(paths: Sequence[str], leaves: Sequence[Any]) -> dict[str, Any]:
    """Nested dicts from paths such as `actor/Dense_0/kernel`."""
    tree: dict[str, Any] = {}
    for path, leaf in zip(paths, leaves, strict=True):
        *parents, name = path.split("/")
        node = tree
        for parent in parents:
            node = node.setdefault(parent, {})
            if not isinstance(node, dict):
                raise UserError(f"{parent} is an array, and holds others as {path}; take another prior")
        if name in node:
            raise UserError(f"{path} comes twice; take another prior")
        node[name] = leaf
    return tree
