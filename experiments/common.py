"""Impure: what the commands that train and evaluate share: seeds, worlds and priors by name, a stopwatch."""

import contextlib
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env, World
from envs.domains.uniform import sample_worlds
from envs.gaps import Gap
from envs.rollout import pool_size
from experiments import cli
from sgft_jax.io import checkpoint
from sgft_jax.io.config import differences
from sgft_jax.types import Array, Key, PyTree, UserError

SIM = "sim"


def option(argv: Sequence[str], name: str, default: str) -> str:
    """The value of one option, looked up before the command line is parsed: it decides the defaults of the others."""
    value = default
    for i, word in enumerate(argv):
        if word.startswith(f"{name}="):
            value = word.partition("=")[2]
        elif word == name and i + 1 < len(argv):
            value = argv[i + 1]
    return value


def seed_list(first: int, count: int) -> list[int]:
    """`count` seeds from `first` on; raises UserError for none."""
    if count < 1 or first < 0:
        raise UserError(f"--seed {first} --seeds {count}: seeds are counted from 0 and there must be at least one")
    return list(range(first, first + count))


def seeds_name(seeds: Sequence[int]) -> str:
    """The folder of a run with these seeds: `seed-3`, or `seeds-0-9`."""
    return f"seed-{seeds[0]}" if len(seeds) == 1 else f"seeds-{seeds[0]}-{seeds[-1]}"


def seed_keys(seeds: Sequence[int], purpose: int) -> Key:
    """Keys [n_seeds] that depend on nothing but the seed and a number that stands for the purpose."""
    return jnp.stack([jax.random.fold_in(jax.random.key(seed), purpose) for seed in seeds])


def stack(trees: Sequence[PyTree]) -> PyTree:
    """Equal pytrees stacked on a new leading axis."""
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *trees)


def member(tree: PyTree, i: int | Array) -> PyTree:
    """The i-th of stacked pytrees."""
    return jax.tree.map(lambda x: x[i], tree)


def part(tree: PyTree, i: int | Array, n: int) -> PyTree:
    """The i-th n of stacked pytrees."""
    return jax.tree.map(lambda x: x.reshape(-1, n, *x.shape[1:])[i], tree)


def over_seeds(function: Callable[..., PyTree], seeds: int, *, shared: int = 0) -> Callable[..., PyTree]:
    """`function` of one seed for arguments and results with a leading seeds axis; the first `shared` have none.

    A single seed is not vmapped, because vmap would make a `cond` (resets, only where an episode ended) compute both of
    its branches at every step.
    """
    if seeds > 1:
        return lambda *args: jax.vmap(function, [None] * shared + [0] * (len(args) - shared))(*args)
    return lambda *args: jax.tree.map(lambda x: x[None], function(*args[:shared], *member(args[shared:], 0)))


def reserve(parts: Mapping[str, int], *, copies: int, devices: int = 1) -> None:
    """Prints how much experience each device will hold; raises UserError if it is more than the device has room for.

    parts: bytes of one agent's by the setting of pretraining that decides them. copies: agents trained together.
    """
    share = {name: copies * size / devices for name, size in parts.items()}
    need, room = sum(share.values()), free_memory()
    there = "" if room is None else f" of {_gib(room)} free"
    print(f"experience: {_gib(need)}{there} on each device ({', '.join(f'{k} {_gib(v)}' for k, v in share.items())})")
    if room is not None and need > room:
        option = max(share, key=share.__getitem__).replace("_", "-")
        raise UserError(f"experience takes {_gib(need)}{there} on each device: lower --config.{option} or train fewer")


def free_memory() -> int | None:
    """Bytes that the first device can still hold; None where nobody says."""
    if stats := jax.local_devices()[0].memory_stats():
        return stats["bytes_limit"] - stats["bytes_in_use"]
    table = Path("/proc/meminfo")
    found = re.search(r"MemAvailable:\s+(\d+) kB", table.read_text()) if table.exists() else None
    return int(found[1]) * 1024 if found else None


def _gib(size: float) -> str:
    return f"{size / 2**30:.2f} GiB"


def load_gap(env: Env, real: str | None, overrides: Sequence[str]) -> Gap | None:
    """The gap that `--real` and `--set` describe; None for the simulator itself."""
    if real is None or real == SIM:
        if overrides:
            raise UserError(f"--set {overrides[0]}: changes a real system; name one with --real")
        return None
    return gaps.load(env, real, overrides)


def real_env(env: Env, found: Sequence[Gap]) -> Env:
    """The Env of these real systems: that of the simulator, or of the other scene that they name.

    Raises UserError where they name several, which no one program can step.
    """
    scenes = {gap.scene: gap.name for gap in found}
    if len(scenes) > 1:
        (one, first), (other, second) = sorted(scenes.items())[:2]
        said = f"{first} is in {f"scene '{one}'" if one else 'the simulated scene'} and {second} in scene '{other}'"
        raise UserError(f"{said}: real systems of different scenes cannot share a program, run them one at a time")
    scene = "".join(scenes)
    return envs.make(env.name, env.impl, scene) if scene else env


def training_worlds(env: Env, gap: Gap | None, key: Key, n: int) -> World:
    """Worlds to learn in: the training domain, or the real system of a gap."""
    return sample_worlds(env, key, n) if gap is None else gaps.worlds(env, gap, key, n)


def real_worlds(env: Env, found: Sequence[Gap], key: Key, n: int = 256) -> World:
    """The real systems of gaps as pools of one size, [gaps, n]; [gaps, 1] where nothing varies in any of them."""
    pools = [gaps.worlds(env, gap, key, n) for gap in found]
    size = max(map(pool_size, pools))
    repeat = lambda x: jnp.repeat(x, size // x.shape[0], axis=0)  # noqa: E731
    return stack([jax.tree.map(repeat, pool) for pool in pools])


def exam_worlds(env: Env, gap: Gap | None, key: Key, n: int) -> World:
    """Worlds to evaluate in: the training domain without sensor noise, or the real system as its gap describes it."""
    return sample_worlds(env, key, n, effects={"obs_noise": 0.0}) if gap is None else gaps.worlds(env, gap, key, n)


def find_priors(prior: Path | None, *, out: Path, env: Env, preset: str) -> tuple[list[PyTree], dict[str, Any]]:
    """The priors of `prior_folders`, loaded, and the card of the first.

    Raises UserError if one is of another task or differs from the first in its networks.
    """
    return load_priors(prior_folders(prior, out=out, task=env.name, preset=preset), env)


def prior_home(out: Path, task: str, preset: str) -> Path:
    """Where the runs of pretraining are that leave the priors of a task."""
    return out / "pretrain" / task / preset


def prior_folders(prior: Path | None, *, out: Path, task: str, preset: str) -> list[Path]:
    """Where priors are: `prior` itself if it is one, else the `seed-*` folders in it, in its `prior/` or its `policy/`,
    or in the `prior/` of the runs in it.

    prior: None looks for all seeds of `<out>/pretrain/<task>/<preset>`. `policy/` is what fine-tuning leaves, in the
    same form. Raises UserError if there is none.
    """
    home = prior or prior_home(out, task, preset)
    if (home / "prior.json").exists():
        cards = [home / "prior.json"]
    else:
        cards = [card for sub in ("", "prior/", "policy/", "*/prior/") for card in home.glob(f"{sub}seed-*/prior.json")]
    if not cards:
        command = f"python -m experiments.pretrain --task {task} --preset {preset}"
        raise UserError(f"{home}: holds no prior; make one with: {command}")
    return sorted((card.parent for card in cards), key=_seed_number)


def load_priors(folders: Sequence[Path], env: Env) -> tuple[list[PyTree], dict[str, Any]]:
    """The priors in these folders and the card of the first; raises UserError where they do not fit together."""
    sizes = {"task": env.name, "obs_dim": env.obs_dim, "act_dim": env.act_dim}
    priors, cards = zip(*(checkpoint.load_prior(folder, **sizes) for folder in folders), strict=True)
    for folder, card in zip(folders, cards, strict=True):
        odd = [key for key in ("network", "gamma", "ensemble_size") if differences(cards[0][key], card[key])]
        odd += ["plan"] if card.get("plan") != cards[0].get("plan") else []
        if checkpoint.algorithm_of(card) != checkpoint.algorithm_of(cards[0]):
            odd.append("algorithm")
        if odd:
            raise UserError(f"{folder}: differs from {folders[0]} in {', '.join(odd)}; choose one with --prior")
    return list(priors), cards[0]


def _seed_number(folder: Path) -> tuple[int, str]:
    number = folder.name.removeprefix("seed-")
    return (int(number) if number.isdigit() else 0, str(folder))


def film(env: Env, theta: Array, qpos: np.ndarray, path: Path) -> str:
    """Renders an episode, qpos [T + 1, nq], in a world with domain parameters theta; says in one line how it went."""
    scene = envs.scene(env.name, env.scene)
    if scene is None:
        return f"no video: {env.name} has no scene to draw"
    if reason := cli.select_renderer():
        return f"no video: {reason}"
    from envs.mujoco.render import render_episode

    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        render_episode(scene, np.asarray(theta).tolist(), qpos, path)
    except UserError as error:
        return f"no video: {error}"
    return f"video: {path}"


class Clock:
    """Wall-clock seconds per phase; what a checkpoint remembers of an earlier start counts too."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextlib.contextmanager
    def __call__(self, phase: str) -> Iterator[None]:
        """Count the time inside the `with` block, which must wait for its own results."""
        begun = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[phase] = self.seconds.get(phase, 0.0) + time.perf_counter() - begun

    def record(self) -> dict[str, float]:
        """{"time/<phase>_s": seconds}."""
        return {f"time/{phase}_s": round(seconds, 3) for phase, seconds in self.seconds.items()}
