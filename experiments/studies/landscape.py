"""V_sim of push over where the hand is, beside a rollout and what the models imagine (Yin et al. 2025, figure 7).

An episode of the policy, as far as the puck rests; from every state of it the models imagine branches of H steps. On
the map the puck lies where it began, and nothing was commanded before.
"""

from dataclasses import dataclass
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env, World
from envs.rollout import play_episode, real_env, real_worlds
from envs.types import Array, Key, Policy, PyTree, UserError
from experiments.runner import cli
from experiments.runner.options import Impl, Out, at_least_one, seed_list
from experiments.runner.progress import doing
from sgft_jax.algorithms import make_policy
from sgft_jax.analysis import figures
from sgft_jax.api import check_prior
from sgft_jax.io.priors import load_prior, variant
from sgft_jax.io.runs import check_folder
from sgft_jax.methods import get_method
from sgft_jax.models import dynamics
from sgft_jax.models.config import network_of
from sgft_jax.models.networks import make_dynamics
from sgft_jax.types import Prior

_RESTS = 1e-3  # m that a puck which rests may seem to move
_GRID, _MARGIN = 121, 0.03  # points to a side, and m beside what is shown
_NOISE = 0.5  # std of imagined actions, as in `sgft-sac`


@dataclass(frozen=True)
class LandscapeArgs:
    """One figure."""

    prior: str = "shipped:push/seed-0"
    """A prior of SAC on push, push-towel or push-ball."""
    real: str = gaps.SIM
    """Real system: a gap by name, or a file; sim: the simulator, as in the paper."""
    branches: int = 5
    """Imagined from each state."""
    horizon: int = 1
    """Steps of a branch."""
    seed: int = 0
    """Expert: another seed plays another episode."""
    impl: Impl = "auto"
    out: Out = Path("runs")


def main(args: LandscapeArgs) -> None:
    """Draws landscape/<task>.png."""
    at_least_one(args, "branches", "horizon")
    seed_list(args.seed, 1)
    prior = load_prior(args.prior)
    folder = args.out / "landscape"
    check_folder(folder)
    env = envs.make(prior.card["task"], args.impl, **variant(prior.card))
    check_prior(prior, get_method("sgft-sac"), env)  # it has a V_sim and models
    if {"hand_xy", "puck_xy"} - {entry.name for entry in env.observation}:
        raise UserError(f"--prior {args.prior}: is of {env.name}; this figure shows a hand that pushes a puck")
    policy, real = make_policy(prior.card, env), gaps.load(env, args.real)
    env = real_env(env, [real])
    key_play, key_imagine = jax.random.split(jax.random.key(args.seed))
    with doing(f"playing an episode of {env.name}", 30, once=True):
        pool = jax.tree.map(lambda x: x[0], real_worlds(env, [real], jax.random.key(0), 1))
        path = _path(env, policy, prior.params, pool, key_play)
    imagined = _imagined(env, policy, prior, path, key_imagine, args.branches, args.horizon)
    shown = np.concatenate([path[:, :2], path[:1, 2:4], imagined])
    ends = zip(shown.min(axis=0) - _MARGIN, shown.max(axis=0) + _MARGIN, strict=True)
    x, y = (np.linspace(low, high, _GRID) for low, high in ends)
    values = _values(policy, prior.params, path[0], x, y)
    title = f"V_sim of {env.name} by where the hand is, while the puck rests"
    drawn = {"rollout": path[:, :2], "imagined": imagined, "puck": path[:1, 2:4]}
    print(figures.landscape(folder / f"{env.name}.png", x, y, values, drawn, title=title))


def _path(env: Env, policy: Policy, params: PyTree, pool: World, key: Key) -> np.ndarray:
    """[n, obs_dim] states of an episode until the puck moves."""

    def act(carry: PyTree, obs: Array, key: Key) -> tuple[Array, PyTree]:
        return policy.act(params, carry, obs, key, explore=False)

    episode = jax.jit(lambda key: play_episode(env, pool, act, policy.init_carry(), key, gamma=1.0))(key)
    obs = np.asarray(episode.transitions.obs)[np.asarray(episode.valid)]
    moved = np.linalg.norm(obs[:, 2:4] - obs[0, 2:4], axis=1) > _RESTS
    return obs[: int(np.argmax(moved)) if moved.any() else len(obs)]


def _imagined(
    env: Env, policy: Policy, prior: Prior, path: np.ndarray, key: Key, branches: int, horizon: int
) -> np.ndarray:
    """[k, 2] where the hand is in imagined states."""
    model, params = make_dynamics(env.obs_dim, env.act_dim, network_of(prior.card)), prior.params

    def branch(obs: Array, key: Key) -> Array:
        def step(obs: Array, key: Key) -> tuple[Array, Array]:
            key_act, key_noise, key_member = jax.random.split(key, 3)
            action, _ = policy.act(params, policy.init_carry(), obs, key_act, explore=True)
            noisy = jnp.clip(action + _NOISE * jax.random.normal(key_noise, action.shape), -1.0, 1.0)
            member = dynamics.draw_member(params.dynamics, key_member)
            after = dynamics.predict(model, member, params.normalizer, obs, noisy)[0]
            return after, after[:2]

        return jax.lax.scan(step, obs, jax.random.split(key, horizon))[1]

    keys = jax.random.split(key, (len(path), branches))
    of_state = jax.vmap(branch, (None, 0))
    return np.asarray(jax.jit(jax.vmap(of_state))(jnp.asarray(path), keys)).reshape(-1, 2)


def _values(policy: Policy, params: PyTree, start: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """[y, x] V_sim with the hand there and all else as at the start."""
    v_sim = policy.value
    assert v_sim is not None  # as `main` has asked

    def value(x: Array, y: Array) -> Array:
        return v_sim(params, jnp.asarray(start).at[:2].set(jnp.stack([x, y])))

    return np.asarray(jax.jit(jax.vmap(jax.vmap(value, (0, None)), (None, 0)))(jnp.asarray(x), jnp.asarray(y)))


if __name__ == "__main__":
    cli.run_main(main, LandscapeArgs, __doc__ or "")
