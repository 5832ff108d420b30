"""Draw V_sim over the place of the object, a real rollout in it, and the branches that SGFT imagines along the rollout.

What SGFT lives on, at a glance: whether V_sim leads from where the real system goes to where it should go, and whether
the models say the truth about the next steps. Source: SGFT, Figure 7.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from sgft_jax.players import Player

import envs
from envs.base import Entry, Env
from envs.gaps import Gap
from envs.mujoco.worlds import Impl
from envs.pools import heldout_worlds, load_gap, real_env
from envs.rollout import play_episode
from experiments import cli
from experiments.algorithms import make_player
from experiments.evaluation import prior_policy
from experiments.options import prior_folders
from sgft_jax.analysis import plot
from sgft_jax.io.priors import load_priors
from sgft_jax.transforms import branch
from sgft_jax.types import Array, Imagination, Key, Prior, Transition, UserError

_GRID = 80  # points along each side of the map


@dataclass(frozen=True)
class LandscapeArgs:
    """One rollout with the mean action; the same start in simulation beside it."""

    task: str = "push"
    """push, hammer or insert."""
    prior: Path | None = None
    """Folder of a prior, or of several (prior/seed-*; policy/seed-* for what fine-tuning has left); default: those of
    <out>/pretrain/<task>/<preset>."""
    preset: str = "fast"
    """Pretraining preset whose priors to take without --prior."""
    index: int = 0
    """Which of several priors."""
    real: str = "default"
    """The real system: mild, default, hard, or a .toml/.json file with tables `params` and `effects`."""
    set: tuple[str, ...] = ()
    """Changes to it, e.g. --set latency=0.05 action_scale=[1,0.5]."""
    entry: str | None = None
    """Which entry of the observation is the place, by its first two numbers; default: the last one with two or more."""
    horizon: int = 4
    """Steps of the branches."""
    branches: int = 5
    """Branches from every real state."""
    branch_noise: float = 0.5
    """Std of the noise on imagined actions, as in fine-tuning."""
    seed: int = 0
    """Another start and other branches."""
    impl: Impl = "auto"
    """Who steps the physics, as in fine-tuning."""
    out: Path = Path("runs")
    """The figure goes to <out>/figures/landscape-<task>-<real>.png."""


class Landscape(NamedTuple):
    """What is drawn; places are [..., 2].

    x, y: [G] of the map; value: [G, G], rows along y. real, simulated: [T + 1, 2] rollouts from the same start.
    imagined: [T, branches, H + 1, 2], each with the real state it starts from.
    """

    x: np.ndarray
    y: np.ndarray
    value: np.ndarray
    real: np.ndarray
    simulated: np.ndarray
    imagined: np.ndarray


def main(args: LandscapeArgs) -> None:
    """Draws and says where."""
    print(f"figure: {landscape(args)}")


def landscape(args: LandscapeArgs) -> Path:
    """The figure; raises UserError for a prior without models of the next observation."""
    for name in ("horizon", "branches"):
        if getattr(args, name) < 1:
            raise UserError(f"--{name} is {getattr(args, name)}: must be at least 1")
    env = envs.make(args.task, args.impl)
    start, entry = find_entry(env, args.entry)
    folders = prior_folders(args.prior, out=args.out, task=args.task, preset=args.preset)
    priors, card = load_priors(folders, env)
    if not 0 <= args.index < len(priors):
        raise UserError(f"--index {args.index}: there are {len(priors)} priors, counted from 0")
    player = make_player(card, env)
    if player.predict is None:
        raise UserError(f"a prior of {card['algorithm']} has no model of the next observation; choose one of SAC")
    drawn = survey(args, env, player, priors[args.index], start, gamma=card["gamma"])
    path = args.out / "figures" / f"landscape-{env.name}-{Path(args.real).stem}.png"
    title = f"{env.name} on the {Path(args.real).stem} real system: V_sim by {entry.name}"
    return plot.landscape(path, *drawn, title=title, axes=(f"x ({entry.unit})", f"y ({entry.unit})"))


def find_entry(env: Env, name: str | None) -> tuple[int, Entry]:
    """Where in the observation the entry of the object's place begins, and the entry; UserError if there is none."""
    starts = np.cumsum([0, *(entry.size for entry in env.observation)])
    wide = {e.name: (int(at), e) for at, e in zip(starts[:-1], env.observation, strict=True) if e.size >= 2}
    if not wide:
        raise UserError(f"{env.name}: no entry of its observation has two numbers to draw a map of")
    return cli.choose("--entry", name or list(wide)[-1], wide)


def survey(args: LandscapeArgs, env: Env, player: Player, prior: Prior, start: int, *, gamma: float) -> Landscape:
    """Plays, imagines and evaluates V_sim; `start`: of the object's place in the observation."""
    gap = load_gap(env, args.real, args.set)
    system = real_env(env, [gap] if gap else [])
    key = jax.random.fold_in(jax.random.key(args.seed), 0)

    def play(env: Env, gap: Gap | None) -> Array:
        world = heldout_worlds(env, gap, jax.random.key(args.seed), 1)
        return jax.jit(lambda world: _observations(env, player, prior, world, key, gamma=gamma))(world)

    real, simulated = play(system, gap), play(env, None)
    branches = imagine(
        env, player, prior, real[:-1], jax.random.fold_in(key, 1),
        horizon=args.horizon, branches=args.branches, noise=args.branch_noise, gamma=gamma,
    )  # fmt: skip
    place = slice(start, start + 2)
    seen = np.concatenate([np.asarray(x)[..., place].reshape(-1, 2) for x in (real, simulated, branches)])
    low, high = _frame(seen)
    x, y = np.linspace(low[0], high[0], _GRID), np.linspace(low[1], high[1], _GRID)
    beside = _moved(env, start)
    judge = jax.jit(jax.vmap(jax.vmap(lambda to: player.value(prior, beside(real[0], to)))))
    value = judge(jnp.stack(jnp.meshgrid(x, y), axis=-1))
    return Landscape(x, y, *(np.asarray(a) for a in (value, *(o[..., place] for o in (real, simulated, branches)))))


def imagine(
    env: Env,
    player: Player,
    prior: Prior,
    obs: Array,
    key: Key,
    *,
    horizon: int,
    branches: int,
    noise: float,
    gamma: float,
) -> Array:
    """The branches of fine-tuning from real observations [T, obs_dim]: [T, branches, horizon + 1, obs_dim]."""
    predict = player.predict
    assert predict is not None  # checked before
    imagination = Imagination(
        value=lambda obs: player.value(prior, obs),
        policy=lambda obs, _, key: player.act(prior, player.init_carry(), obs, key, explore=True)[0],
        dynamics=lambda obs, action, key: predict(prior, obs, action, key),
        reward=env.reward,
        terminated=env.terminated,
        gamma=gamma,
    )
    n, zero = len(obs), jnp.zeros(len(obs))
    blank = jnp.zeros((n, env.act_dim))
    rows = Transition(obs, blank, zero, zero, obs, jnp.zeros(n, bool), jnp.zeros(n, jnp.int32))
    steps = jax.jit(branch(horizon, branches, noise=noise), static_argnums=0)(imagination, rows, key).next_obs[n:]
    starts = jnp.broadcast_to(obs[:, None, None], (n, branches, 1, obs.shape[-1]))
    return jnp.concatenate([starts, steps.reshape(n, branches, horizon, -1)], axis=2)


def _observations(env: Env, player: Player, prior: Prior, pool: Any, key: Key, *, gamma: float) -> Array:
    """[T + 1, obs_dim] of an episode with the mean action, the start included."""
    policy = prior_policy(player, prior, explore=False)
    episode = play_episode(env, pool, policy, player.init_carry(), key, gamma=gamma)
    return jnp.concatenate([episode.transitions.obs[:1], episode.transitions.next_obs])


def _moved(env: Env, start: int) -> Callable[[Array, Array], Array]:
    """(obs, to [2]) -> the observation with the object there, and beside it whatever else has a place of its kind.

    A hand that stayed behind would make most of the map a matter of how far it has to go.
    """
    starts = np.cumsum([0, *(entry.size for entry in env.observation)])[:-1]
    (own,) = [entry for at, entry in zip(starts, env.observation, strict=True) if at == start]
    alike = [int(at) for at, e in zip(starts, env.observation, strict=True) if (e.unit, e.size) == (own.unit, own.size)]

    def moved(obs: Array, to: Array) -> Array:
        by = to - obs[start : start + 2]
        for at in alike:
            obs = obs.at[at : at + 2].add(by)
        return obs

    return moved


def _frame(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners of a square around places [n, 2], with a margin."""
    low, high = places.min(0), places.max(0)
    half = 0.65 * max((high - low).max(), 1e-3)
    return (low + high) / 2 - half, (low + high) / 2 + half


if __name__ == "__main__":
    cli.run_main(main, LandscapeArgs, __doc__ or "")
