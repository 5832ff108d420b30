"""Is V_sim a guide in the real system? Asked of the real simulator itself, in true states that the policy visits.

In each state many actions are tried, for one step and for four: V_sim is improvable there if the best of them keeps
what it promises, r + gamma V_sim(s') >= V_sim(s), but for its noise in simulation (Definition 1 of Yin et al. 2025).
At goals is how often V_sim is higher in a state of success than in another.
"""

import functools
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import envs
from envs import gaps
from envs.base import Env, EnvState, World
from envs.gaps import SIM
from envs.rollout import begin_episode, episode_keys, real_env, real_worlds
from envs.types import Array, Key, Policy, PyTree, UserError
from experiments.runner import cli
from experiments.runner.cli import Json
from experiments.runner.options import Impl, Out, at_least_one, each_once, seed_list
from experiments.runner.progress import doing
from experiments.runner.real_systems import by_scene, title
from sgft_jax.algorithms import make_policy
from sgft_jax.analysis import tables
from sgft_jax.api import check_prior
from sgft_jax.io.log import write_summary
from sgft_jax.io.priors import load_prior, variant
from sgft_jax.io.runs import check_folder
from sgft_jax.methods import get_method
from sgft_jax.types import Prior

_HORIZONS = (1, 4)
_WORLDS, _AT_ONCE = 64, 32  # worlds of a real system; states that are looked at in one program


@dataclass(frozen=True)
class GuidanceArgs:
    """One prior on several real systems."""

    prior: str = "shipped:push/seed-0"
    """A prior of SAC with a V_sim."""
    real: tuple[str, ...] = ("default",)
    """Real systems: gaps by name, or files of gaps. The simulator itself comes first, for comparison."""
    states: int = 256
    """Visited states in each."""
    actions: int = 64
    """Actions tried in each state."""
    seed: int = 0
    """Expert: another seed visits other states."""
    impl: Impl = "auto"
    json: Json = False
    out: Out = Path("runs")


class Seen(NamedTuple):
    """States [n] that a policy visits. headroom: [n, horizons] by how much the best action exceeds V_sim. surprise: r +
    gamma V_sim(s') - V_sim(s) of the policy's next step. value: V_sim. goal: whether the state is one of success.
    success: whether its episode ends in one.
    """

    headroom: Any
    surprise: Any
    value: Any
    goal: Any
    success: Any


def main(args: GuidanceArgs) -> None:
    """Measures, prints a table, and leaves `guidance/<task>/summary.json`."""
    at_least_one(args, "states", "actions")
    each_once(args, "real")
    seed_list(args.seed, 1)
    prior = load_prior(args.prior)
    task = prior.card["task"]
    folder = args.out / "guidance" / task
    check_folder(folder)
    if not args.real:
        raise UserError("--real: name at least one")
    env = envs.make(task, args.impl, **variant(prior.card))
    check_prior(prior, get_method("sgft"), env)  # it has a V_sim
    policy = make_policy(prior.card, env)
    names = [SIM, *(name for name in gaps.expand(args.real) if name != SIM)]
    seen = {name: x for group in by_scene(task, names) for name, x in _seen(args, env, policy, prior, group).items()}
    margin = 1.48 * float(np.median(np.abs(seen[SIM].surprise)))
    lines = [{"real": title(name)} | _judged(seen[name], margin) for name in names]
    folder.mkdir(parents=True, exist_ok=True)
    numbers = write_summary(folder, {"prior": args.prior, "margin": margin, "lines": lines})
    if args.json:
        print(json.dumps(lines))
        return
    print(tables.markdown(list(lines[0]), [[_text(x) for x in line.values()] for line in lines]))
    print(f"\nnumbers: {numbers}")


def _text(value: Any) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)


def _seen(args: GuidanceArgs, env: Env, policy: Policy, prior: Prior, names: tuple[str, ...]) -> dict[str, Seen]:
    """What is seen in real systems of one scene, which share a program."""
    reals = [gaps.load(env, name) for name in names]
    env = real_env(env, reals)
    with doing(f"building {len(reals) * _WORLDS} worlds of {env.name}", 20, once=True):
        pool = real_worlds(env, reals, jax.random.key(0), _WORLDS)
    look = jax.jit(functools.partial(_look, env, policy, prior.card["gamma"], args.actions))
    keys = jax.random.split(jax.random.fold_in(jax.random.key(2**31 + 11), args.seed), args.states)
    with doing(f"trying {args.actions} actions in {args.states} states of each system of {env.name}", 60, once=True):
        return {
            name: jax.tree.map(np.asarray, look(prior.params, pool, jnp.int32(i), keys)) for i, name in enumerate(names)
        }


def _look(
    env: Env, policy: Policy, gamma: float, actions: int, params: PyTree, pool: World, which: Array, keys: Key
) -> Seen:
    """keys: [n], of an episode each, in which one state is looked at."""
    assert policy.value is not None  # as `main` has asked
    value = functools.partial(policy.value, params)

    def one(key: Key) -> Seen:
        key_episode, key_stop, key_offsets, key_steps = jax.random.split(key, 4)
        stop = jax.random.randint(key_stop, (), 0, env.episode_length)
        world, state, success = _visit(env, policy, params, pool, which, key_episode, stop)
        offsets = _draw_offsets(key_offsets, actions, env.act_dim)
        keys = jax.random.split(key_steps, max(_HORIZONS))
        along = functools.partial(_along, env, policy, params, value, gamma, world, state, keys=keys)
        exceeds = jax.vmap(along)(offsets)
        best = jnp.stack([exceeds[:, h - 1].max() for h in _HORIZONS])
        # The first offset is none: what the policy itself would do.
        return Seen(best, exceeds[0, 0], value(state.true_obs), state.success, success)

    return jax.lax.map(one, keys, batch_size=_AT_ONCE)


def _visit(
    env: Env, policy: Policy, params: PyTree, pool: World, which: Array, key: Key, stop: Array
) -> tuple[World, EnvState, Array]:
    """A world, the state there at step `stop` [] of an episode, and whether the episode succeeds []."""
    key_world, key_reset, key_steps = episode_keys(key, env.episode_length)
    _, world, start = begin_episode(env, pool, key_world, key_reset, which)

    def step(loop: tuple[EnvState, EnvState], row: tuple[Key, Array]) -> tuple[tuple[EnvState, EnvState], None]:
        (state, kept), (keys, time) = loop, row
        kept = jax.tree.map(lambda new, old: jnp.where(time == stop, new, old), state, kept)
        action, _ = policy.act(params, policy.init_carry(), state.obs, keys[0], explore=False)
        return (env.step(world, state, action, keys[1]), kept), None

    rows = key_steps, jnp.arange(env.episode_length)
    (last, kept), _ = jax.lax.scan(step, (start, start), rows)
    return world, kept, last.success


def _along(
    env: Env,
    policy: Policy,
    params: PyTree,
    value: Callable[[Array], Array],
    gamma: float,
    world: World,
    state: EnvState,
    offset: Array,
    *,
    keys: Key,
) -> Array:
    """[steps] sum of gamma^t r_t and gamma^H V_sim(s_H), minus V_sim(s), after 1, 2, ... steps with an offset [act_dim]
    on every command of the policy, which reads what sensors measure; V_sim reads the truth.
    """

    def step(carry: tuple[EnvState, Array, Array], key: Key) -> tuple[tuple[EnvState, Array, Array], Array]:
        (state, earned, weight), (key_act, key_env) = carry, jax.random.split(key)
        action, _ = policy.act(params, policy.init_carry(), state.obs, key_act, explore=False)
        after = env.step(world, state, jnp.clip(action + offset, -1.0, 1.0), key_env)
        earned = earned + weight * after.reward
        weight = weight * gamma * (1.0 - after.terminated.astype(jnp.float32))
        return (after, earned, weight), earned + weight * value(after.true_obs)

    start = state, jnp.float32(0), jnp.float32(1)
    return jax.lax.scan(step, start, keys)[1] - value(state.true_obs)


def _draw_offsets(key: Key, n: int, act_dim: int) -> Array:
    """[n, act_dim]: none, then uniform ones of all sizes up to the whole range of commands."""
    key_size, key_way = jax.random.split(key)
    size = jax.random.uniform(key_size, (n, 1), maxval=2.0).at[0].set(0.0)
    return size * jax.random.uniform(key_way, (n, act_dim), minval=-1.0, maxval=1.0)


def _judged(seen: Seen, margin: float) -> dict[str, Any]:
    shares = [float((seen.headroom[:, i] >= -margin).mean()) for i in range(len(_HORIZONS))]
    return {
        "success": float(seen.success.mean()),
        **{f"improvable, H = {h}": share for h, share in zip(_HORIZONS, shares, strict=True)},
        "V_sim higher at goals": _higher(seen.value[seen.goal], seen.value[~seen.goal]),
    }


def _higher(goals: np.ndarray, others: np.ndarray) -> float:
    """How often one of these values is above one of the others; nan where there are none."""
    return float((goals[:, None] > others[None]).mean()) if len(goals) and len(others) else float("nan")


if __name__ == "__main__":
    cli.run_main(main, GuidanceArgs, __doc__ or "")
