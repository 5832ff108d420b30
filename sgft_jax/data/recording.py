"""Impure: writes recorded episodes as D4RL and Minari HDF5 files, which `data.logs` and their own libraries read."""

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np

from envs.rollout import Episode
from sgft_jax.io.jsonfile import write_json
from sgft_jax.types import Transition, UserError

_SAME = 1e-4  # relative; compilers may round the two copies of an observation differently


class Recorded(NamedTuple):
    """One episode of T steps on the host, float32.

    obs: [T + 1, obs_dim]. action: [T, act_dim]. reward: [T]. terminated: whether the task ended it; else time did, or
    the recording.
    """

    obs: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    terminated: bool


class _Rows(NamedTuple):
    """A `Transition` on the host."""

    obs: np.ndarray
    action: np.ndarray
    reward: np.ndarray
    discount: np.ndarray
    next_obs: np.ndarray


def of_fleet(rows: Transition, environments: int) -> list[Recorded]:
    """The episodes of environments that were stepped together, in the order in which they ended.

    rows: [N, ...] as a replay that has not overwritten anything keeps them: row t * environments + i is step t of
    environment i. A step whose successor is not the next observation was the last of its episode.
    """
    steps = len(rows.reward) // environments
    shaped = _Rows(*(np.asarray(x)[: steps * environments].reshape(steps, environments, *x.shape[1:]) for x in rows))
    jump = np.abs(shaped.next_obs[:-1] - shaped.obs[1:]) > _SAME * (1 + np.abs(shaped.obs[1:]))
    ended = np.ones((steps, environments), bool)
    ended[:-1] = (shaped.discount[:-1] == 0) | jump.any(axis=2)
    found = []
    for i in range(environments):
        ends = np.flatnonzero(ended[:, i])
        for start, end in zip(np.concatenate([[0], ends[:-1] + 1]), ends, strict=True):
            found.append((end, i, _Rows(*(x[start : end + 1, i] for x in shaped))))
    return [_recorded(own) for _, _, own in sorted(found, key=lambda each: each[:2])]


def of_episodes(played: Episode) -> list[Recorded]:
    """Episodes [n] as `System.play` returns them, without the rows after their ends."""
    rows, valid = played.transitions, np.asarray(played.valid)
    found = (_Rows(*(np.asarray(x)[i][valid[i]] for x in rows)) for i in range(len(valid)))
    return [_recorded(own) for own in found if len(own.reward)]


def _recorded(rows: _Rows) -> Recorded:
    """The episode of its rows [T]."""
    obs = np.concatenate([rows.obs, rows.next_obs[-1:]]).astype(np.float32)
    terminated = bool(rows.discount[-1] == 0)
    return Recorded(obs, np.asarray(rows.action, np.float32), np.asarray(rows.reward, np.float32), terminated)


def cut(episodes: Sequence[Recorded], transitions: int) -> list[Recorded]:
    """The first so many transitions; the last episode may lose its end. Raises UserError where there are fewer."""
    found, left = [], transitions
    for own in episodes:
        n = min(len(own.reward), left)
        whole = n == len(own.reward)
        found.append(Recorded(own.obs[: n + 1], own.action[:n], own.reward[:n], own.terminated and whole))
        left -= n
        if not left:
            return found
    raise UserError(f"{transitions - left:,} transitions were recorded, {transitions:,} are wanted")


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
    }


def write_minari(folder: Path, episodes: Sequence[Recorded], about: Mapping[str, str]) -> None:
    """A data set in Minari's layout: `<folder>/data/main_data.hdf5` and `metadata.json`.

    folder: its name must end in a version, such as `-v0`; the data set is `sgft/<name>` for Minari. about: more of
    `metadata.json`.
    """
    data = folder / "data"
    data.mkdir(parents=True, exist_ok=True)
    with _new(data / "main_data.hdf5") as file:
        for number, own in enumerate(episodes):
            group = file.create_group(f"episode_{number}")
            group.attrs.update(id=number, total_steps=len(own.reward))
            flat = _flat(own)
            arrays = {"observations": own.obs, "actions": own.action, "rewards": own.reward}
            arrays |= {"terminations": flat["terminals"], "truncations": flat["timeouts"]}
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
