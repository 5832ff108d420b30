"""Pools of worlds: the training domain, real systems, and the worlds that policies are evaluated in."""

from collections.abc import Sequence

import jax
import jax.numpy as jnp

import envs
from envs import gaps
from envs.base import Env, World
from envs.domains.uniform import sample_worlds
from envs.gaps import SIM, Gap
from envs.rollout import pool_size
from envs.system import concealed
from envs.types import Key, UserError


def load_gap(env: Env, real: str | None, overrides: Sequence[str]) -> Gap | None:
    """The gap that `--real` and `--set` describe; None for the simulator itself."""
    if real is None or real == SIM:
        if overrides:
            raise UserError(f"--set {overrides[0]}: changes a real system; name one with --real")
        return None
    return gaps.load(env, real, overrides)


def real_env(env: Env, real_gaps: Sequence[Gap]) -> Env:
    """The Env of these real systems: that of the simulator, or of the other scene that they name.

    None of them tells what system it is, see `envs.system.concealed`.

    Raises UserError where they name several, which no one program can step.
    """
    scenes = {gap.scene: gap.name for gap in real_gaps}
    if len(scenes) > 1:
        (one, first), (other, second) = sorted(scenes.items())[:2]
        differ = f"{first} is in {f"scene '{one}'" if one else 'the simulated scene'} and {second} in scene '{other}'"
        raise UserError(f"{differ}: real systems of different scenes cannot share a program, run them one at a time")
    scene = "".join(scenes)
    return concealed(envs.make(env.name, env.impl, scene, env.previous_actions, env.system) if scene else env)


def training_worlds(env: Env, gap: Gap | None, key: Key, n: int) -> World:
    """Worlds to learn in: the training domain, or the real system of a gap."""
    return sample_worlds(env, key, n) if gap is None else gaps.worlds(env, gap, key, n)


def real_worlds(env: Env, real_gaps: Sequence[Gap], key: Key, n: int = 256) -> World:
    """The real systems of gaps as pools of one size, [gaps, n]; [gaps, 1] where nothing varies in any of them."""
    pools = [gaps.worlds(env, gap, key, n) for gap in real_gaps]
    size = max(map(pool_size, pools))
    return jax.tree.map(lambda *x: jnp.stack(x), *[padded(pool, size) for pool in pools])


def padded(pool: World, n: int) -> World:
    """The same worlds as a pool [n], where there are n of them or one."""
    return jax.tree.map(lambda x: jnp.repeat(x, n // x.shape[0], axis=0), pool)


def heldout_worlds(env: Env, gap: Gap | None, key: Key, n: int) -> World:
    """Worlds to evaluate in: the training domain without sensor noise, or the real system as its gap describes it."""
    return sample_worlds(env, key, n, effects={"obs_noise": 0.0}) if gap is None else gaps.worlds(env, gap, key, n)
