"""The paper's theory on systems that are small enough to be solved: H-step values, improvability, bounds. Pure.

A system has finitely many states and actions; `gridded` makes one of a continuous system. V_sim, the guide, is any
number for each state. The shaped reward r(s) + gamma V_sim(s') - V_sim(s) summed over H steps is the H-step value of a
plan, the policies that act when H, ..., 1 steps are left (Yin et al. 2025, section 4 and appendix A).

The bounds are functions of four `Constants`, measured here, and are stated as corrected (docs/papers.md): Lemma 1 as
printed has one gamma too many beside the range of V_sim, Lemma 2 has lost the factor gamma alpha H of its own proof.
"""

import functools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from envs.types import Array, Key

_SWEEPS = 100_000  # of value iteration at most


class System(NamedTuple):
    """successors: [S, A, K] int32, the states that may follow a state and an action. odds: [S, A, K] how probable each
    of them is. reward: [S] of being in a state, as in the paper.
    """

    successors: Array
    odds: Array
    reward: Array


class Plan(NamedTuple):
    """values: [H + 1, S] V_h^* for h = 0, ..., H. actions: [H, S] int32, the best ones with 1, ..., H steps left."""

    values: Array
    actions: Array


class Constants(NamedTuple):
    """reward: max r - min r. guide: max V_sim - min V_sim. model: alpha, the L1 distance of the model's successors from
    the real ones at the worst state and action. error: epsilon, the largest |V_sim - V_real^*|.
    """

    reward: Array
    guide: Array
    model: Array
    error: Array


def backup(system: System, values: Array, gamma: float) -> Array:
    """[S, A] r(s) + gamma E[values(s')]."""
    return system.reward[:, None] + gamma * jnp.sum(system.odds * values[system.successors], axis=2)


@functools.partial(jax.jit, static_argnames=("gamma", "tolerance"))
def optimal(system: System, gamma: float, tolerance: float = 1e-4) -> Array:
    """[S] V^*, by value iteration until nothing changes by more than (1 - gamma) * tolerance."""
    return _fixed(lambda values: backup(system, values, gamma).max(axis=1), system, gamma, tolerance)


@functools.partial(jax.jit, static_argnames=("gamma", "tolerance"))
def followed(system: System, actions: Array, gamma: float, tolerance: float = 1e-4) -> Array:
    """[S] V^pi of the policy that takes these actions [S]."""
    successors, odds = (jnp.take_along_axis(x, actions[:, None, None], axis=1) for x in system[:2])
    chosen = System(successors, odds, system.reward)
    return _fixed(lambda values: backup(chosen, values, gamma)[:, 0], system, gamma, tolerance)


def _fixed(sweep: Callable[[Array], Array], system: System, gamma: float, tolerance: float) -> Array:
    def on(carry: tuple[Array, Array, Array]) -> Array:
        return (carry[1] > (1.0 - gamma) * tolerance) & (carry[2] < _SWEEPS)

    def step(carry: tuple[Array, Array, Array]) -> tuple[Array, Array, Array]:
        new = sweep(carry[0])
        return new, jnp.abs(new - carry[0]).max(), carry[2] + 1

    return jax.lax.while_loop(on, step, (jnp.zeros_like(system.reward), jnp.float32(jnp.inf), jnp.int32(0)))[0]


def plan(system: System, guide: Array, gamma: float, horizon: int) -> Plan:
    """The best plans of up to `horizon` steps in a system, from every state. guide: [S] V_sim."""

    def step(ahead: Array, _: None) -> tuple[Array, tuple[Array, Array]]:
        q = backup(system, ahead, gamma)
        return q.max(axis=1), (q.max(axis=1) - guide, q.argmax(axis=1).astype(jnp.int32))

    _, (values, actions) = jax.lax.scan(step, guide, None, length=horizon)
    return Plan(jnp.concatenate([jnp.zeros_like(guide)[None], values]), actions)


def worth(system: System, actions: Array, guide: Array, gamma: float) -> Array:
    """[S] the H-step value of a plan [H, S], as of `Plan`, in a system."""

    def step(ahead: Array, act: Array) -> tuple[Array, None]:
        return jnp.take_along_axis(backup(system, ahead, gamma), act[:, None], axis=1)[:, 0], None

    return jax.lax.scan(step, guide, actions)[0] - guide


def improvability(system: System, guide: Array, gamma: float) -> Array:
    """[S] max_a E[r + gamma V_sim(s') - V_sim(s)]: V_sim is improvable where it is not negative (Definition 1)."""
    return plan(system, guide, gamma, 1).values[1]


def lowered(system: System, guide: Array, gamma: float) -> Array:
    """[S] V_sim minus the least constant that makes it improvable: it changes no plan, but its distance from V^*."""
    short = jnp.maximum(-improvability(system, guide, gamma).min(), 0.0)
    return guide - short / (1.0 - gamma)


def constants(real: System, model: System, guide: Array, best: Array) -> Constants:
    """What the bounds need of a real system, the model that plans, V_sim [S] and V_real^* [S]."""

    def distance(real: tuple[Array, Array], model: tuple[Array, Array]) -> Array:
        states = jnp.concatenate([real[0], model[0]])
        same = states[:, None] == states[None]
        apart = jnp.where(same, jnp.concatenate([real[1], -model[1]])[None], 0.0).sum(axis=1)
        return jnp.sum(jnp.abs(apart) / same.sum(axis=1))

    def worst(rows: tuple[tuple[Array, Array], tuple[Array, Array]]) -> Array:
        return jax.vmap(distance)(*rows).max()

    alpha = jax.lax.map(worst, ((*real[:2],), (*model[:2],)), batch_size=64).max()
    return Constants(jnp.ptp(real.reward), jnp.ptp(guide), alpha, jnp.abs(guide - best).max())


def lemma_1(c: Constants, gamma: float, horizon: int, *, printed: bool = False) -> Array:
    """[] by how much the H-step values of one plan may differ between the model and the real system."""
    late = horizon if printed else horizon - 1
    spread = (_before(gamma, horizon) * c.reward + gamma**late * c.guide) / 2.0
    return gamma * spread * c.model * horizon


def lemma_2(c: Constants, gamma: float, horizon: int, *, printed: bool = False) -> Array:
    """[] how much of the real H-step value the model's best plan may lose: twice Lemma 1.

    As printed it holds as well, but says nothing: rewards from the second one on, and V_sim after the last step, cannot
    differ by more between any two plans.
    """
    if printed:
        return _before(gamma, horizon) * c.reward + gamma**horizon * c.guide
    return 2.0 * lemma_1(c, gamma, horizon)


def lemma_4(c: Constants, gamma: float, horizon: int, loss: Array | float) -> Array:
    """[] how much of V_real^* a policy may lose whose first actions lose at most `loss` of V_H^*, if V_sim is
    improvable.
    """
    return gamma**horizon * c.error + loss / (1.0 - gamma)


def theorem_1(c: Constants, gamma: float, horizon: int) -> Array:
    """[] how much of V_real^* the policy may lose that begins the model's best plan anew at every step, if V_sim is
    improvable.
    """
    return lemma_4(c, gamma, horizon, lemma_2(c, gamma, horizon))


def bhardwaj(c: Constants, gamma: float, horizon: int) -> Array:
    """[] the same bound without improvability (Bhardwaj et al. 2020, Theorem 3.1, with the true reward)."""
    return (lemma_2(c, gamma, horizon) + 2.0 * gamma**horizon * c.error) / (1.0 - gamma**horizon)


def _before(gamma: float, horizon: int) -> float:
    """The weight of the rewards that come before the last step, but for the first."""
    return (1.0 - gamma ** (horizon - 1)) / (1.0 - gamma)


# --- bounds against the truth -----------------------------------------------------------------------------------------


class Measured(NamedTuple):
    """What the bounds are about, all [] but the first: by how much H-step values of plans differ between model and real
    system (`apart`, Lemma 1); what the model's best plan loses of V_H^* (`plan`, Lemma 2), and what the worst plan of
    all that were tried does (`any_plan`); the least change of V_h^* with one step more (`growth`, Lemma 3); what the
    first action of that plan loses of V_H^* (`first`) and the policy of these actions of V_real^* (`policy`, Lemma 4
    and Theorem 1). improvability: [] at the worst state.
    """

    constants: Constants
    improvability: Array
    apart: Array
    plan: Array
    any_plan: Array
    growth: Array
    first: Array
    policy: Array


def measure(real: System, model: System, guide: Array, gamma: float, horizon: int, key: Key) -> Measured:
    """The truth. guide: [S] V_sim. key: of a plan that nothing recommends."""
    best, planned = (plan(system, guide, gamma, horizon) for system in (real, model))
    anything = jax.random.randint(key, planned.actions.shape, 0, real.odds.shape[1])
    plans = jnp.stack([planned.actions, anything])
    promised, played = (jax.vmap(lambda plan, s=s: worth(s, plan, guide, gamma))(plans) for s in (model, real))
    actions, most = planned.actions[-1], best.values[-1]
    q, value = backup(real, best.values[-2] + guide, gamma) - guide[:, None], optimal(real, gamma)
    return Measured(
        constants=constants(real, model, guide, value),
        improvability=best.values[1].min(),
        apart=jnp.abs(promised - played).max(),
        plan=(most - played[0]).max(),
        any_plan=(most[None] - played).max(),
        growth=(best.values[1:] - best.values[:-1]).min(),
        first=(most - jnp.take_along_axis(q, actions[:, None], axis=1)[:, 0]).max(),
        policy=(value - followed(real, actions, gamma)).max(),
    )


def draw_systems(key: Key, states: int, actions: int) -> tuple[System, System, System]:
    """A random simulator, a real system that is partly another one, and a model that errs by less, with one reward in
    [0, 1]. Successors are few or many (Dirichlet), and how far the systems are apart differs from draw to draw.
    """
    keys = jax.random.split(key, 7)
    concentration = jnp.exp(jax.random.uniform(keys[0], minval=-3.0, maxval=1.0))
    parts = [jax.random.dirichlet(k, jnp.full(states, concentration), (states, actions)) for k in keys[1:4]]
    share, wrong = jax.random.uniform(keys[4]), jax.random.uniform(keys[5]) ** 3
    real = (1.0 - share) * parts[0] + share * parts[1]
    reward = jax.random.uniform(keys[6], (states,))
    model = (1.0 - wrong) * real + wrong * parts[2]
    return dense(parts[0], reward), dense(real, reward), dense(model, reward)


def dense(odds: Array, reward: Array) -> System:
    """A system in which every state may follow. odds: [S, A, S]. reward: [S]."""
    return System(jnp.broadcast_to(jnp.arange(odds.shape[2], dtype=jnp.int32), odds.shape), odds, reward)


# --- continuous systems -----------------------------------------------------------------------------------------------


def gridded(
    step: Callable[[Array, Array], Array],
    reward: Callable[[Array], Array],
    axes: Sequence[np.ndarray],
    actions: Array,
    *,
    wraps: Sequence[bool],
) -> System:
    """A continuous system on a grid: a state between grid points follows as these do, by multilinear interpolation.

    step(state [d], action [...]) -> the next state [d]. reward(state [d]) -> []. axes: d axes of evenly spaced values;
    states beyond their ends count as these. wraps: whether an axis goes round, from its last value on to its first.
    actions: [A, ...].
    """
    grid = jnp.stack(jnp.meshgrid(*map(jnp.asarray, axes), indexing="ij"), -1).reshape(-1, len(axes))
    sizes = [len(axis) for axis in axes]

    def follow(state: Array, action: Array) -> tuple[Array, Array]:
        after, index, odds = step(state, action), jnp.zeros(1, jnp.int32), jnp.ones(1)
        for x, axis, size, wrap in zip(after, axes, sizes, wraps, strict=True):
            place = (x - axis[0]) / (axis[1] - axis[0])
            place = jnp.mod(place, size) if wrap else jnp.clip(place, 0.0, size - 1.0)
            low = jnp.floor(place)
            share = place - low
            ends = jnp.stack([low, low + 1.0]).astype(jnp.int32)
            ends = ends % size if wrap else jnp.minimum(ends, size - 1)
            index = (index[:, None] * size + ends[None]).reshape(-1)
            odds = (odds[:, None] * jnp.stack([1.0 - share, share])[None]).reshape(-1)
        return index, odds

    return System(*jax.vmap(jax.vmap(follow, (None, 0)), (0, None))(grid, actions), jax.vmap(reward)(grid))
