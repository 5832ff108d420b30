"""Impure: recorded transitions as data to learn from, whatever their layout, in memory.

Nothing is downloaded: the user supplies the file, and its `Facts` say what it holds. A file that is not what it should
be is a `UserError` with one line. Arrays are float32 on the host; `replay.full` makes them a buffer to sample.
"""

import dataclasses
import hashlib
import itertools
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, cast, get_args

import jax
import numpy as np

from envs.base import Env
from envs.files import readable
from envs.observations import remember, with_memory
from envs.types import Array, Transition, UserError, unknown
from sgft_jax.datasets import layouts, lerobot
from sgft_jax.datasets.layouts import Rows, ages
from sgft_jax.files.arrays import numbers
from sgft_jax.io.real import home_of
from sgft_jax.types import Successors

_TABLES = (".txt", ".csv")
_SAME_RATE = 0.01  # relative; clocks and rounded rates differ by less
_BEYOND = 1.01  # an action that no rounding explains
LENGTH = "mean episode length"
_MEAN, _STD, _SIZE = "mean return", "std of returns", "transitions"


@dataclasses.dataclass(frozen=True)
class Facts:
    """What a file held, for provenance and for a look before training.

    path: of the file, or of the folder. layout: "d4rl", "minari", "lerobot", "table" or "rollouts" (of a run of ours).
    size: bytes. sha256: of its bytes, of a folder of all its files, hex.
    successors: where next observations come from; "episode" for Minari, whose episodes hold one observation more.
    transitions: rows that are returned; dropped: rows of the file that are not. terminal: returned rows whose discount
        is 0. clipped: returned rows with an action beyond [-1, 1].
    episodes: in the file, one that the end of the file cuts off included; whole_episodes: the others.
    return_*: undiscounted returns of the whole episodes, or of all if none is whole. std is that of the population.
    assumed: what the file does not tell and was taken to be so, in words; "" where it tells all.
    """

    path: str
    layout: str
    size: int
    sha256: str
    successors: str
    transitions: int
    dropped: int
    terminal: int
    clipped: int
    episodes: int
    whole_episodes: int
    return_mean: float
    return_std: float
    return_min: float
    return_max: float
    assumed: str = ""


class Log(NamedTuple):
    """rows: [N, ...] transitions in the order of the file, float32 on the host. facts: where they come from.

    last: [N] bool, the rows that the row below does not follow: what `sequences.full` needs.
    """

    rows: Transition
    facts: Facts
    last: np.ndarray


def load(path: Path | str, *, gamma: float, successors: Successors = "stored", env: Env | None = None) -> Log:
    """The transitions of a D4RL file; of a data set of Minari or LeRobot v3, by its folder; of the rollouts of a run of
    ours, by the run's folder or its `real/`; or of a robot's table, see `layouts.read_table`.

    gamma: a row's discount is gamma, or 0 where it is terminal. A time limit is never terminal: it only ends episodes,
        and so does an end whose reason the file does not tell. Actions are clipped to [-1, 1].
    successors: of D4RL files. "stored" takes `next_observations` and keeps every row. "shifted" takes the observation
        of the row below and drops the rows of time limits and the last row, as D4RL's own `qlearning_dataset` does.
        The successor of a shifted terminal row is the start of the next episode: a discount of 0 hides it from
        critics, but not from a discriminator.
    env: the task that was recorded. Then observations may be what its sensors measure: what a policy reads beyond, such
        as the last actions, is added episode by episode. Rewards and terminations that the file does not tell are the
        task's. Sizes and the length of a step are checked.
    Raises UserError for a file that is missing, cut off, of another layout or task, or holds numbers that are not
    finite.
    """
    if successors not in (known := get_args(Successors)):
        raise UserError(unknown("successors", successors, known))
    path = Path(path)
    rows = layouts.check(path, _read(path, successors, env))
    rows = _judged(path, rows if env is None else _fitted(path, rows, env), env)
    rows = rows if env is None else _seen(rows, env)
    below = np.append(rows.keep[1:], False)
    return Log(_transitions(rows, gamma), _facts(rows), (rows.ends | ~below)[rows.keep])


def episodes(logs: Sequence[Log]) -> tuple[Transition, np.ndarray]:
    """All episodes of some logs, one after another: transitions [N, T, ...] and which of them are valid [N, T].

    T is the length of the longest; behind the end of an episode are zeros. A gap where rows were dropped ends one too.
    """
    separate = [
        jax.tree.map(lambda x, a=a, b=b: np.asarray(x)[a:b], (log.rows, np.ones(len(log.last), bool)))
        for log in logs
        for a, b in itertools.pairwise([0, *np.flatnonzero(np.append(log.last[:-1], True)) + 1])
    ]
    longest = max(len(valid) for _, valid in separate)

    def padded(*columns: np.ndarray) -> np.ndarray:
        return np.stack([np.pad(x, [(0, longest - len(x))] + [(0, 0)] * (x.ndim - 1)) for x in columns])

    return jax.tree.map(padded, *separate)


def _read(path: Path, successors: Successors, env: Env | None) -> Rows:
    """What lies there."""
    if path.suffix in _TABLES:
        if env is None or not env.table or env.reward is None:
            task = "another task" if env is None else env.name
            raise UserError(f"{path}: tables are logs of a wheel-legged robot; {task} wants a data set")
        return layouts.read_table(path, env.measured_dim)
    with readable(path):
        folder = stat.S_ISDIR(path.stat().st_mode)
    if folder:
        if (path / lerobot.INFO).exists():
            return lerobot.read(path)
        if (home := home_of(path)) is not None:
            return layouts.read_rollouts(home)
    return layouts.read_hdf5(path, successors, None if env is None else env.episode_length)


# --- what a task makes of it ------------------------------------------------------------------------------------------


def _fitted(path: Path, rows: Rows, env: Env) -> Rows:
    """With the task's sizes; raises UserError where they are others, or where a step lasts longer or shorter."""
    if rows.layout == "rollouts":  # of a run whose policy may have seen more, or less, than this one
        n = env.measured_dim
        rows = rows._replace(obs=rows.obs[:, :n], next_obs=rows.next_obs[:, :n])
    seen, commanded = rows.obs.shape[1], rows.action.shape[1]
    if commanded != env.act_dim or seen not in (env.measured_dim, env.obs_dim):
        more, odd = divmod(seen - env.measured_dim, env.act_dim)
        fits = commanded == env.act_dim and more >= 0 and not odd
        advice = f"previous_actions={more} would fit" if fits else "name the task that it was recorded on"
        task = f"{env.name} has {env.obs_dim} and {env.act_dim}"
        raise UserError(f"{path}: has {seen} observations and {commanded} actions, {task}; {advice}")
    if np.mean((np.abs(rows.action) > _BEYOND).any(axis=1)) > 0.5:
        raise UserError(f"{path}: most actions lie beyond [-1, 1]; scale them to what {env.name} commands")
    if rows.rate is not None and abs(rows.rate * env.control_dt - 1) > _SAME_RATE:
        rate = f"{env.name} has {1 / env.control_dt:g}"
        raise UserError(f"{path}: has {rows.rate:g} steps a second, {rate}; resample it to that")
    return rows


def _judged(path: Path, rows: Rows, env: Env | None) -> Rows:
    """With the task's rewards and terminations where the file tells none, and with sparse rewards where the task's are.
    Without a task episodes end by time alone.
    """
    step: tuple[Any, ...] = rows.obs, np.clip(rows.action, -1, 1), rows.next_obs
    if rows.reward is None or (env is not None and env.sparse):
        if env is None or env.reward is None:
            raise UserError(f"{path}: tells no rewards, and neither does a task; record them as next.reward")
        reward = np.where(rows.keep, jax.vmap(env.reward)(*step), 0.0)
        reward = numbers(path, f"the reward of {env.name}", reward, (None,), fix="leave the row out")
        rows = rows._replace(reward=reward)
    if rows.terminal is None:
        ended = np.zeros(len(rows.obs), bool)
        if env is not None and env.terminated is not None:
            ended = rows.ends & np.asarray(jax.vmap(env.terminated)(*step))
        rows = rows._replace(terminal=ended)
    return rows


def _seen(rows: Rows, env: Env) -> Rows:
    """With what a policy reads beyond measurements, as `envs.observations.with_memory` makes it."""
    if rows.obs.shape[1] == env.obs_dim:
        return rows
    action, age = np.clip(rows.action, -1, 1).astype(np.float32), ages(rows.ends)
    memory = np.zeros((len(action), env.previous_actions, env.act_dim), np.float32)
    for k in range(env.previous_actions):
        known = np.flatnonzero(age > k)
        memory[known, k] = action[known - 1 - k]
    next_obs = with_memory(env, rows.next_obs, remember(memory, action))
    return rows._replace(obs=with_memory(env, rows.obs, memory), next_obs=next_obs)


# --- facts ------------------------------------------------------------------------------------------------------------


def _transitions(rows: Rows, gamma: float) -> Transition:
    def kept(array: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(array[rows.keep], np.float32)

    assert rows.reward is not None and rows.terminal is not None
    action = np.clip(kept(rows.action), -1.0, 1.0)
    discount = kept(np.where(rows.terminal, 0.0, gamma))
    columns = kept(rows.obs), action, kept(rows.reward), discount, kept(rows.next_obs)
    return Transition(*cast(tuple[Array, ...], columns))


def _facts(rows: Rows) -> Facts:
    assert rows.reward is not None and rows.terminal is not None
    size, digest = _fingerprint(rows.source)
    keep, whole = rows.keep, int(np.sum(rows.ends))
    number = np.cumsum(rows.ends) - rows.ends  # of the episode of every row
    returns = np.bincount(number, weights=rows.reward.astype(np.float64))
    judged = returns[:whole] if whole else returns
    clipped = (np.abs(rows.action) > 1).any(axis=1) & keep
    counts = {"transitions": keep, "dropped": ~keep, "terminal": rows.terminal & keep, "clipped": clipped}
    facts: dict[str, Any] = {name: int(np.sum(which)) for name, which in counts.items()}
    facts |= {f"return_{name}": float(getattr(np, name)(judged)) for name in ("mean", "std", "min", "max")}
    facts |= {"episodes": len(returns), "whole_episodes": whole, "dropped": facts["dropped"] + rows.dropped}
    return Facts(str(rows.source), rows.layout, size, digest, rows.successors, **facts, assumed=rows.assumed)


def _fingerprint(source: Path) -> tuple[int, str]:
    """Bytes of a file and their SHA-256; of a folder those of its files, in the order of their names."""
    if not source.is_dir():
        with readable(source), open(source, "rb") as stream:
            return source.stat().st_size, hashlib.file_digest(stream, "sha256").hexdigest()
    files = [(path.relative_to(source).as_posix(), *_fingerprint(path)) for path in layouts.files_of(source)]
    names = repr([(name, digest) for name, _, digest in files])
    return sum(size for _, size, _ in files), hashlib.sha256(names.encode()).hexdigest()


# --- whether a set that was made anew may stand for one of D4RL's -----------------------------------------------------


class Band(NamedTuple):
    """What a number has to be: that of D4RL, give or take a share of it."""

    published: float
    share: float


class Verdict(NamedTuple):
    """A criterion of a set: its name, the value, and the bounds within which the value is accepted."""

    criterion: str
    value: float
    low: float
    high: float

    @property
    def passed(self) -> bool:
        """Whether the value is within the bounds."""
        return self.low <= self.value <= self.high

    def __str__(self) -> str:
        verdict = "pass" if self.passed else "FAIL"
        return f"{verdict}: {self.criterion} {self.value:,.0f}, accepted from {self.low:,.0f} to {self.high:,.0f}"


# A walker that never falls would walk 1,000 steps, one that falls twice as often as D4RL's 420: 15 % tells both apart.
BANDS: Mapping[str, Mapping[str, Band]] = {
    "halfcheetah-medium": {_MEAN: Band(4770.3, 0.05)},
    "halfcheetah-medium-replay": {_SIZE: Band(202_000, 0.25)},
    "walker2d-medium": {_MEAN: Band(2852.1, 0.05), _STD: Band(1095.0, 0.25), LENGTH: Band(840.0, 0.15)},
    "walker2d-medium-replay": {_SIZE: Band(302_000, 0.25)},
}


def judge(name: str, facts: Facts, *, mean_length: float) -> Sequence[Verdict]:
    """A verdict for each criterion of the set `TASK-KIND`; none for a set that D4RL does not have.

    facts: of the file. mean_length: steps of an episode on average.
    """
    values = {_MEAN: facts.return_mean, _STD: facts.return_std, _SIZE: facts.transitions, LENGTH: mean_length}
    return [
        Verdict(criterion, float(values[criterion]), published * (1 - share), published * (1 + share))
        for criterion, (published, share) in BANDS.get(name, {}).items()
    ]
