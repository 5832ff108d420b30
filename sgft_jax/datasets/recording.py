"""Impure: writes recorded episodes as D4RL and Minari HDF5 files, which `data.logs` and their own libraries read."""

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import jax
import numpy as np

from envs.rollout import Episode
from envs.types import Transition, UserError
from sgft_jax.files.disk import write_json, written
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


def of_fleet(rows: Transition, environments: int, noted: Noted | None = None) -> list[Recorded]:
    """The episodes of environments that were stepped together, in the order in which they ended.

    rows: [N, ...] as a replay that has not overwritten anything keeps them: row t * environments + i is step t of
    environment i. A step whose successor is not the next observation was the last of its episode. noted: [N, ...], of
    these rows.
    """
    steps = len(rows.reward) // environments
    both = jax.tree.map(
        lambda x: np.asarray(x)[: steps * environments].reshape(steps, environments, *x.shape[1:]), (rows, noted)
    )
    obs, next_obs, discount = both[0].obs, both[0].next_obs, both[0].discount
    jump = np.abs(next_obs[:-1] - obs[1:]) > _SAME * (1 + np.abs(obs[1:]))
    ended = np.ones((steps, environments), bool)
    ended[:-1] = (discount[:-1] == 0) | jump.any(axis=2)
    recorded = []
    for i in range(environments):
        ends = np.flatnonzero(ended[:, i])
        for start, end in zip(np.append(0, ends[:-1] + 1), ends, strict=True):
            rows_of, noted_of = jax.tree.map(lambda x, start=start, end=end, i=i: x[start : end + 1, i], both)
            recorded.append((end, i, _recorded(rows_of, noted_of)))
    return [episode for _, _, episode in sorted(recorded, key=lambda entry: entry[:2])]


def of_episodes(played: Episode, noted: Noted | None = None) -> list[Recorded]:
    """Episodes [n] as `System.play` returns them, without the rows after their ends.

    noted: [n, T, ...], of their rows.
    """
    both, valid = jax.tree.map(np.asarray, (played.transitions, noted)), np.asarray(played.valid)
    rows = (jax.tree.map(lambda x, i=i: x[i][valid[i]], both) for i in np.flatnonzero(valid.any(1)))
    return [_recorded(*pair) for pair in rows]


def of_stored(played: Sequence[Played], measured_dim: int) -> list[Recorded]:
    """Rollouts as a run has stored them, of observations only what was measured: their first `measured_dim` numbers.

    What a policy reads beyond that, such as its last actions, follows from the episode. Episodes without a valid step
    are left out.
    """
    recorded = []
    for episode in played:
        rows = episode.rows
        if len(rows.reward):
            rows = rows._replace(obs=rows.obs[:, :measured_dim], next_obs=rows.next_obs[:, :measured_dim])
            recorded.append(_recorded(rows, None)._replace(success=episode.success))
    return recorded


def _recorded(rows: Transition, noted: Noted | None) -> Recorded:
    """The episode of its rows [T]."""

    def chained(first: Any, then: Any) -> np.ndarray:
        return np.concatenate([first, then[-1:]]).astype(np.float32)

    joints = None if noted is None else jax.tree.map(chained, noted.before, noted.after)
    log_prob = None if noted is None or noted.log_prob is None else np.asarray(noted.log_prob, np.float32)
    action, reward = np.asarray(rows.action, np.float32), np.asarray(rows.reward, np.float32)
    return Recorded(chained(rows.obs, rows.next_obs), action, reward, bool(rows.discount[-1] == 0), joints, log_prob)


def cut(episodes: Sequence[Recorded], transitions: int) -> list[Recorded]:
    """The first so many transitions; the last episode may lose its end. Raises UserError where there are fewer."""
    ends = np.cumsum([len(episode.reward) for episode in episodes])
    if not len(ends) or ends[-1] < transitions:
        raise UserError(f"{sum(ends[-1:]):,} transitions were recorded, {transitions:,} are wanted")
    whole = int(np.searchsorted(ends, transitions))  # episodes before the last one
    return [*episodes[:whole], _first(episodes[whole], transitions - sum(ends[:whole][-1:]))]


def _first(episode: Recorded, n: int) -> Recorded:
    """The first n steps of an episode."""
    joints, log_prob = jax.tree.map(lambda x: x[: n + 1], episode.joints), episode.log_prob
    terminated = episode.terminated and n == len(episode.reward)
    log_prob = None if log_prob is None else log_prob[:n]
    return Recorded(episode.obs[: n + 1], episode.action[:n], episode.reward[:n], terminated, joints, log_prob)


# --- files ------------------------------------------------------------------------------------------------------------


def write_d4rl(path: Path, episodes: Sequence[Recorded], about: Mapping[str, str]) -> None:
    """A flat file in D4RL's layout, v2: the end of an episode that the task did not end is a time limit.

    about: strings for `metadata/`. The file appears when it is whole.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    rows = [_flat(episode) for episode in episodes]
    with written(path) as part, h5py.File(part, "w") as file:
        for name in rows[0]:
            file.create_dataset(name, data=np.concatenate([arrays[name] for arrays in rows]), compression="gzip")
        for name, text in about.items():
            file[f"metadata/{name}"] = np.bytes_(text)


def _flat(episode: Recorded) -> dict[str, np.ndarray]:
    """The arrays [T, ...] of one episode."""
    last = np.arange(len(episode.reward)) == len(episode.reward) - 1
    step = {"observations": episode.obs[:-1], "actions": episode.action, "next_observations": episode.obs[1:]}
    ends = {"terminals": last & episode.terminated, "timeouts": last & (not episode.terminated)}
    return {**step, "rewards": episode.reward, **ends, **{name: x[:-1] for name, x in _infos(episode).items()}}


def _infos(episode: Recorded) -> dict[str, np.ndarray]:
    """The arrays [T + 1, ...] of one episode under D4RL's names; no action follows the last row: there it is nan."""
    infos = {} if episode.joints is None else {f"infos/{name}": x for name, x in episode.joints._asdict().items()}
    if episode.log_prob is not None:
        infos["infos/action_log_probs"] = np.append(episode.log_prob, np.float32(np.nan))
    return infos


def write_table(path: Path, episodes: Sequence[Recorded], *, scale: float) -> None:
    """A text file as `layouts.read_table` reads it: episodes of the wheel-legged robot, whose obs are [T + 1, 4].

    scale: N m at an action of 1. The state in which an episode ended is a row of its own, with `done` where it fell.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    tables = []
    for obs, action, reward, terminated, *_ in episodes:
        tables.append(np.column_stack([obs, np.append(scale * action[:, 0], 0.0), np.append(0 * reward, terminated)]))
    with written(path) as part:
        np.savetxt(part, np.concatenate(tables), fmt="%.8g")


def write_minari(folder: Path, episodes: Sequence[Recorded], about: Mapping[str, Any]) -> None:
    """A data set in Minari's layout: `<folder>/data/main_data.hdf5` and `metadata.json`.

    folder: its name must end in a version, such as `-v0`; the data set is `sgft/<name>` for Minari. about: more of
    `metadata.json`. Whether an episode ended well is in its metadata, as `success`.
    """
    data = folder / "data"
    data.mkdir(parents=True, exist_ok=True)
    with written(data / "main_data.hdf5") as part, h5py.File(part, "w") as file:
        for number, episode in enumerate(episodes):
            group = file.create_group(f"episode_{number}")
            group.attrs.update(id=number, total_steps=len(episode.reward))
            if episode.success is not None:
                group.attrs["success"] = episode.success
            flat = _flat(episode)
            arrays = {"observations": episode.obs, "actions": episode.action, "rewards": episode.reward}
            arrays |= {"terminations": flat["terminals"], "truncations": flat["timeouts"], **_infos(episode)}
            for name, values in arrays.items():
                group.create_dataset(name, data=values, compression="gzip")
    obs, action = episodes[0].obs.shape[1], episodes[0].action.shape[1]
    steps = sum(len(episode.reward) for episode in episodes)
    counts = {"data_format": "hdf5", "total_episodes": len(episodes), "total_steps": steps}
    spaces = {"observation_space": _box(-np.inf, np.inf, obs), "action_space": _box(-1.0, 1.0, action)}
    origin = {"dataset_id": f"sgft/{folder.name}", "minari_version": "0.5.3"}
    write_json(data / "metadata.json", {**counts, **spaces, **origin, **about})


def _box(low: float, high: float, size: int) -> str:
    """A Gymnasium box as Minari writes it down."""
    bounds = {"low": [low] * size, "high": [high] * size}
    return json.dumps({"type": "Box", "dtype": "float32", "shape": [size], **bounds})
