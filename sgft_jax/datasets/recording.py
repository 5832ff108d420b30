"""Impure: writes recorded episodes as D4RL and Minari HDF5 files, which `data.logs` and their own libraries read."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import jax
import numpy as np

from envs.rollout import Episode
from envs.types import Transition, UserError
from sgft_jax.files.jsonfile import write_json
from sgft_jax.io.real import Played

_SAME = 1e-4  # relative; compilers may round the two copies of an observation differently


class Joints(NamedTuple):
    """qpos: [..., nq] positions, qvel: [..., nv] speeds, in SI units and the order of the model."""

    qpos: Any
    qvel: Any


class Noted(NamedTuple):
    """What a recording keeps of a step beside its transition.

    before, after: `Joints` of the two states, None of a task without joints. log_prob: [] log density of the action
    under the policy that drew it, None of a policy without one.
    """

    before: Any
    after: Any
    log_prob: Any


class Recorded(NamedTuple):
    """One episode of T steps on the host, float32.

    obs: [T + 1, obs_dim]. action: [T, act_dim]. reward: [T]. terminated: whether the task ended it; else time did, or
    the recording. joints: [T + 1, ...], log_prob: [T], see `Noted`. success: whether it ended well, None where nobody
    knows.
    """

    obs: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    terminated: bool
    joints: Joints | None = None
    log_prob: np.ndarray | None = None
    success: bool | None = None


class _Rows(NamedTuple):
    """A `Transition` on the host."""

    obs: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    discount: np.ndarray
    next_obs: np.ndarray


def of_fleet(rows: Transition, environments: int, noted: Noted | None = None) -> list[Recorded]:
    """The episodes of environments that were stepped together, in the order in which they ended.

    rows: [N, ...] as a replay that has not overwritten anything keeps them: row t * environments + i is step t of
    environment i. A step whose successor is not the next observation was the last of its episode. noted: [N, ...], of
    these rows.
    """
    steps = len(rows.reward) // environments
    both = jax.tree.map(
        lambda x: np.asarray(x)[: steps * environments].reshape(steps, environments, *x.shape[1:]),
        (_Rows(*map(np.asarray, rows)), noted),
    )
    shaped = both[0]
    jump = np.abs(shaped.next_obs[:-1] - shaped.obs[1:]) > _SAME * (1 + np.abs(shaped.obs[1:]))
    ended = np.ones((steps, environments), bool)
    ended[:-1] = (shaped.discount[:-1] == 0) | jump.any(axis=2)
    found = []
    for i in range(environments):
        ends = np.flatnonzero(ended[:, i])
        for start, end in zip(np.concatenate([[0], ends[:-1] + 1]), ends, strict=True):
            found.append((end, i, jax.tree.map(lambda x, own=slice(start, end + 1), i=i: x[own, i], both)))
    return [_recorded(*own) for _, _, own in sorted(found, key=lambda each: each[:2])]


def of_episodes(played: Episode, noted: Noted | None = None) -> list[Recorded]:
    """Episodes [n] as `System.play` returns them, without the rows after their ends.

    noted: [n, T, ...], of their rows.
    """
    both = _Rows(*map(np.asarray, played.transitions)), jax.tree.map(np.asarray, noted)
    valid = np.asarray(played.valid)
    found = (jax.tree.map(lambda x, i=i: x[i][valid[i]], both) for i in range(len(valid)))
    return [_recorded(*own) for own in found if len(own[0].reward)]


def of_stored(played: Sequence[Played], measured_dim: int) -> list[Recorded]:
    """Rollouts as a run has stored them, of observations only what was measured: their first `measured_dim` numbers.

    What a policy reads beyond that, such as its last actions, follows from the episode. Episodes without a valid step
    are left out.
    """
    found = []
    for own in played:
        rows = _Rows(**own.rows)
        if len(rows.reward):
            rows = rows._replace(obs=rows.obs[:, :measured_dim], next_obs=rows.next_obs[:, :measured_dim])
            found.append(_recorded(rows, None)._replace(success=own.success))
    return found


def _recorded(rows: _Rows, noted: Noted | None) -> Recorded:
    """The episode of its rows [T]."""
    chained = lambda first, then: np.concatenate([first, then[-1:]]).astype(np.float32)  # noqa: E731
    joints = None if noted is None else jax.tree.map(chained, noted.before, noted.after)
    log_prob = None if noted is None or noted.log_prob is None else np.asarray(noted.log_prob, np.float32)
    return Recorded(
        chained(rows.obs, rows.next_obs), np.asarray(rows.action, np.float32), np.asarray(rows.reward, np.float32),
        terminated=bool(rows.discount[-1] == 0), joints=joints, log_prob=log_prob,
    )  # fmt: skip


def cut(episodes: Sequence[Recorded], transitions: int) -> list[Recorded]:
    """The first so many transitions; the last episode may lose its end. Raises UserError where there are fewer."""
    found, left = [], transitions
    for own in episodes:
        n = min(len(own.reward), left)
        found.append(_first(own, n))
        left -= n
        if not left:
            return found
    raise UserError(f"{transitions - left:,} transitions were recorded, {transitions:,} are wanted")


def _first(own: Recorded, n: int) -> Recorded:
    """The first n steps of an episode."""
    return Recorded(
        own.obs[: n + 1], own.action[:n], own.reward[:n], own.terminated and n == len(own.reward),
        joints=jax.tree.map(lambda x: x[: n + 1], own.joints),
        log_prob=None if own.log_prob is None else own.log_prob[:n],
    )  # fmt: skip


# --- files ------------------------------------------------------------------------------------------------------------


def write_d4rl(path: Path, episodes: Sequence[Recorded], about: Mapping[str, str]) -> None:
    """A flat file in D4RL's layout, v2: the end of an episode that the task did not end is a time limit.

    about: strings for `metadata/`. The file appears when it is whole.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [_flat(own) for own in episodes]
    with _new(path) as file:
        for name in rows[0]:
            file.create_dataset(name, data=np.concatenate([own[name] for own in rows]), compression="gzip")
        for name, said in about.items():
            file[f"metadata/{name}"] = np.bytes_(said)


def _flat(own: Recorded) -> dict[str, np.ndarray]:
    """The arrays [T, ...] of one episode."""
    last = np.arange(len(own.reward)) == len(own.reward) - 1
    return {
        "observations": own.obs[:-1],
        "actions": own.action,
        "next_observations": own.obs[1:],
        "rewards": own.reward,
        "terminals": last & own.terminated,
        "timeouts": last & (not own.terminated),
        **{name: x[:-1] for name, x in _infos(own).items()},
    }


def _infos(own: Recorded) -> dict[str, np.ndarray]:
    """The arrays [T + 1, ...] of one episode under D4RL's names; no action follows the last row: there it is nan."""
    found = {} if own.joints is None else {"infos/qpos": own.joints.qpos, "infos/qvel": own.joints.qvel}
    if own.log_prob is not None:
        found["infos/action_log_probs"] = np.append(own.log_prob, np.float32(np.nan))
    return found


def write_table(path: Path, episodes: Sequence[Recorded], *, scale: float) -> None:
    """A text file as `logs.load_table` reads it: episodes of the wheel-legged robot, whose obs are [T + 1, 4].

    scale: N m at an action of 1. The state in which an episode ended is a row of its own, with `done` where it fell.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [
        np.column_stack([own.obs, np.append(scale * own.action[:, 0], 0.0), np.append(0 * own.reward, own.terminated)])
        for own in episodes
    ]
    part = path.with_name(f".{path.name}.part")
    np.savetxt(part, np.concatenate(rows), fmt="%.8g")
    part.replace(path)


def write_minari(folder: Path, episodes: Sequence[Recorded], about: Mapping[str, Any]) -> None:
    """A data set in Minari's layout: `<folder>/data/main_data.hdf5` and `metadata.json`.

    folder: its name must end in a version, such as `-v0`; the data set is `sgft/<name>` for Minari. about: more of
    `metadata.json`. Whether an episode ended well is in its metadata, as `success`.
    """
    data = folder / "data"
    data.mkdir(parents=True, exist_ok=True)
    with _new(data / "main_data.hdf5") as file:
        for number, own in enumerate(episodes):
            group = file.create_group(f"episode_{number}")
            group.attrs.update(id=number, total_steps=len(own.reward))
            if own.success is not None:
                group.attrs["success"] = own.success
            flat = _flat(own)
            arrays = {"observations": own.obs, "actions": own.action, "rewards": own.reward}
            arrays |= {"terminations": flat["terminals"], "truncations": flat["timeouts"], **_infos(own)}
            for name, values in arrays.items():
                group.create_dataset(name, data=values, compression="gzip")
    obs, action = episodes[0].obs.shape[1], episodes[0].action.shape[1]
    facts = {
        "data_format": "hdf5",
        "total_episodes": len(episodes),
        "total_steps": sum(len(own.reward) for own in episodes),
        "observation_space": _box(-np.inf, np.inf, obs),
        "action_space": _box(-1.0, 1.0, action),
        "dataset_id": f"sgft/{folder.name}",
        "minari_version": "0.5.3",
    }
    write_json(data / "metadata.json", {**facts, **about})


def _box(low: float, high: float, size: int) -> str:
    """A Gymnasium box as Minari writes it down."""
    bounds = {"low": [low] * size, "high": [high] * size}
    return json.dumps({"type": "Box", "dtype": "float32", "shape": [size], **bounds})


@contextmanager
def _new(path: Path) -> Iterator[h5py.File]:
    """A file that gets its name when it is whole."""
    part = path.with_name(f".{path.name}.part")
    try:
        with h5py.File(part, "w") as file:
            yield file
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)
