"""V_sim's own stage, after training: the policy is frozen, and V is fitted to its returns on and off its path. Pure.

Episodes begin with random actions, as many of them as a share from 0 to 1 says, until a random step; from then on the
policy acts as it is deployed. The returns of these steps know no entropy and no exploration.
"""

import functools
import math
from typing import NamedTuple

import jax
import jax.numpy as jnp

from envs.base import Env, EnvState, Varying, World
from envs.effects import measure
from envs.mesh import split_vmap, whole
from envs.observations import with_system
from envs.rollout import play_episode
from envs.types import Array, Key, Policy, PyTree
from sgft_jax.math import optim
from sgft_jax.models.networks import make_value, precision
from sgft_jax.models.normalizer import normalize
from sgft_jax.models.value import discounted_returns, inputs, lambda_returns, make_v_sim
from sgft_jax.presets import PretrainConfig
from sgft_jax.types import Normalizer

__all__ = ["Held", "Rows", "fit", "fit_value", "hold", "play_ladder", "replays"]

_ROUNDS, _MIXED = 40, 0.9  # times that targets are computed anew, and lambda of the returns that they are
_PLAYED, _VALUED = 4096, 1024  # episodes that are played, and valued, together
WORLDS = 256  # of the pool, at least
_LEFT = 0.01  # share of the discounted weight that is left where a measured episode ends
_LR = 3e-3  # of Adam at the start; it falls to 0 along half a cosine


class Rows(NamedTuple):
    """Episodes of T steps.

    obs: [T + 1, obs_dim] raw. system: [k] in [-1, 1]. reward, discount: [T]. switch: [] int32, the step from which on
    the policy acts. intact: [] bool, whether the physics did not explode. valid: [T] bool, False after the end.
    world: [] int32, where it took place in the pool.
    """

    obs: Array
    system: Array
    reward: Array
    discount: Array
    switch: Array
    intact: Array
    valid: Array
    world: Array


def length_of(env: Env, gamma: float, left: float) -> int:
    """Steps of an episode past whose time limit this share of the discounted weight is left."""
    return env.episode_length + math.ceil(math.log(left) / math.log(max(gamma, 1e-9)))


def play_ladder(
    env: Env,
    system: tuple[Varying, ...],
    policy: Policy,
    pool: World,
    params: PyTree,
    key: Key,
    *,
    gamma: float,
    length: int,
) -> Rows:
    """One episode. env: as the policy sees it. system: what `Rows` tells of the episode's system."""
    key_ladder, key_episode = jax.random.split(key)
    share, when = jax.random.uniform(key_ladder, (2,))
    switch = jnp.int32(when * env.episode_length)

    def act(carry: tuple[PyTree, Array], obs: Array, key: Key) -> tuple[Array, tuple[PyTree, Array]]:
        key_policy, key_replace, key_random = jax.random.split(key, 3)
        action, inner = policy.act(params, carry[0], obs[: env.obs_dim], key_policy, explore=False)
        random = jax.random.uniform(key_random, (env.act_dim,), minval=-1.0, maxval=1.0)
        replaced = (carry[1] < switch) & (jax.random.uniform(key_replace) < share)
        return jnp.where(replaced, random, action), (inner, carry[1] + 1)

    start = policy.init_carry(), jnp.int32(0)
    played = play_episode(with_system(env, system), pool, act, start, key_episode, gamma=gamma, length=length)
    rows = played.transitions
    seen = jnp.concatenate([rows.obs, rows.next_obs[-1:]])
    return Rows(
        obs=seen[:, : env.obs_dim],
        system=seen[0, env.obs_dim :],
        reward=rows.reward,
        discount=rows.discount,
        switch=switch,
        intact=~played.exploded,
        valid=played.valid,
        world=played.world,
    )


def fit(config: PretrainConfig, rows: Rows, normalizer: Normalizer, key: Key, *, starts: int) -> PyTree:
    """Parameters of `make_v_sim`, fitted to lambda-returns of episodes [E] in float32.

    Targets end in V of what follows, told the system, and are computed anew in every round. Half of a batch is told the
    system. The other half learns the mean given the observation, where the policy takes over: of later states slow
    systems have more. Each member draws rows of its own. starts: the last step whose state is learned from.
    """
    episodes, _, obs_dim = rows.obs.shape
    network = make_v_sim(obs_dim, config.network, system=rows.system.shape[1], members=config.ensemble_size)
    member, optimiser = make_value(0, config.network), optim.adam()
    seen = jax.vmap(jax.vmap(normalize, (None, 0)), (None, 0))(normalizer, rows.obs)
    steps = jnp.arange(rows.reward.shape[1])[None]
    counts = (steps >= rows.switch[:, None]) & (steps <= starts) & rows.valid & rows.intact[:, None]
    returns = jax.vmap(discounted_returns, (0, 0, None))(rows.reward, rows.discount, jnp.zeros(()))
    middle = jnp.mean(returns, where=counts)
    scale = jnp.std(returns, where=counts) + 1e-6
    known = (jnp.arange(config.batch_size) % 2).astype(jnp.float32)

    def targets(params: PyTree) -> Array:
        """[E, T] in units of the network's output."""

        def of_episode(episode: tuple[Array, Rows]) -> Array:
            obs, row = episode
            values = middle + scale * jax.vmap(network.apply, (None, 0, None))(params, obs, row.system)
            return lambda_returns(row.reward, row.discount, values, mixed=_MIXED)

        return (jax.lax.map(of_episode, (seen, rows), batch_size=min(episodes, _VALUED)) - middle) / scale

    def update(state: tuple[optim.Fit, Array], step: tuple[Key, Array]) -> tuple[tuple[optim.Fit, Array], None]:
        (held, wanted), (key, number) = state, step
        key_episode, key_time = jax.random.split(key)
        shape = config.ensemble_size, config.batch_size
        which = jax.random.randint(key_episode, shape, 0, episodes)
        first = rows.switch[which]
        when = first + jnp.int32(jax.random.uniform(key_time, shape) * (starts + 1 - first))
        when = jnp.where(known[None] > 0, when, first)
        read = jax.vmap(jax.vmap(inputs))(seen[which, when], rows.system[which], jnp.tile(known, (shape[0], 1)))
        goal, weight = wanted[which, when], counts[which, when].astype(jnp.float32)

        def loss(params: PyTree) -> tuple[Array, tuple[()]]:
            guess = jax.vmap(jax.vmap(member.apply, (None, 0)))(params, read)
            return jnp.sum(weight * (guess - goal) ** 2) / config.batch_size, ()

        rate = _LR * optim.cosine_factor(number, per_round * _ROUNDS)
        held, _, _ = optim.minimise(optimiser, loss, held, rate)
        return (held, wanted), None

    def one_round(held: optim.Fit, steps: tuple[Key, Array]) -> tuple[optim.Fit, None]:
        (held, _), _ = jax.lax.scan(update, (held, targets(held.params)), steps)
        return held, None

    per_round = -(-config.value_updates // _ROUNDS)
    key_init, key_steps = jax.random.split(key)
    keys = jax.random.split(key_steps, (_ROUNDS, per_round))
    numbers = jnp.arange(_ROUNDS * per_round).reshape(_ROUNDS, per_round)
    with precision("float32"):
        held, _ = jax.lax.scan(one_round, optim.start(optimiser, network.init(key_init)), (keys, numbers))
    return _rescaled(held.params, f"Dense_{len(config.network.hidden)}", middle, scale)


def _rescaled(params: PyTree, last: str, middle: Array, scale: Array) -> PyTree:
    """The network whose output is middle + scale * output. last: the name of its last layer."""
    layer = params[last]
    return {**params, last: {"kernel": scale * layer["kernel"], "bias": middle + scale * layer["bias"]}}


def fit_value(
    env: Env, system: tuple[Varying, ...], policy: Policy, config: PretrainConfig, pool: World, params: PyTree, key: Key
) -> PyTree:
    """Parameters of V_sim of one prior: plays the episodes and fits. params: of the prior, without a value."""
    key_play, key_fit = jax.random.split(key)
    at_once = min(config.value_episodes, _PLAYED)
    parts = -(-config.value_episodes // at_once)
    numbers = {"gamma": config.gamma, "length": length_of(env, config.gamma, config.value_left)}
    play = functools.partial(play_ladder, env, system, policy, pool, params, **numbers)
    keys = jax.random.split(key_play, (parts, at_once))
    rows = jax.lax.map(split_vmap(play), keys)
    # In so many words: where nothing varies, there is nothing to tell, and -1 would not do.
    rows = whole(jax.tree.map(lambda x: x.reshape(parts * at_once, *x.shape[2:]), rows))
    return fit(config, rows, params.normalizer, key_fit, starts=env.episode_length)


# --- how good it is ---------------------------------------------------------------------------------------------------


class Held(NamedTuple):
    """What one prior promises and earns in states off its path, where its policy takes over; of n episodes.

    value, told: [n] V(obs) and V(obs, system). returns: [n] discounted, of the policy. obs: [n, obs_dim]. world: [n]
    int32. intact: [n] bool, neither exploded nor over before.
    """

    value: Array
    told: Array
    returns: Array
    obs: Array
    world: Array
    intact: Array


def hold(
    env: Env,
    system: tuple[Varying, ...],
    policy: Policy,
    gamma: float,
    episodes: int,
    pool: World,
    params: PyTree,
    key: Key,
) -> Held:
    """Fresh episodes in worlds that the fit has not seen, until 1 % of the discounted weight is left.

    Then V of the last state stands for the rest.
    """
    value_of = policy.value
    assert value_of is not None  # checked before
    promise = functools.partial(value_of, params)
    length = length_of(env, gamma, _LEFT)

    def one(key: Key) -> Held:
        rows = play_ladder(env, system, policy, pool, params, key, gamma=gamma, length=length)
        obs = rows.obs[rows.switch]
        returns = discounted_returns(rows.reward, rows.discount, promise(rows.obs[-1]))[rows.switch]
        told = promise(obs, rows.system) if system else promise(obs)
        return Held(promise(obs), told, returns, obs, rows.world, rows.intact & rows.valid[rows.switch])

    return whole(split_vmap(one)(jax.random.split(key, episodes)))


def replays(
    env: Env, policy: Policy, gamma: float, worlds: World, params: PyTree, obs: Array, keys: Key
) -> tuple[Array, Array]:
    """Returns [n, w] of the policy from the same observations [n, obs_dim] in worlds [n, w], and which are intact.

    The state is one that these sensors may have read so: at rest, off by a draw of their noise. keys: [n, w, 2], that
    of the effects, then of all else.
    """
    restore, value_of = env.restore, policy.value
    assert restore is not None and value_of is not None  # checked before
    act = functools.partial(policy.act, params, explore=False)
    length = length_of(env, gamma, _LEFT) - env.episode_length

    def one(world: World, obs: Array, keys: Key) -> tuple[Array, Array]:
        key_noise, key_episode = jax.random.split(keys[1])

        def start(world: World, key: Key) -> EnvState:
            effects = restore(world, obs, keys[0]).effects
            unbiased = effects._replace(obs_bias=jnp.zeros_like(effects.obs_bias))
            read = measure(unbiased, obs[: env.measured_dim], key_noise)
            return restore(world, jnp.concatenate([read, obs[env.measured_dim :]]), keys[0])

        alone = jax.tree.map(lambda x: x[None], world)
        begun = env._replace(reset=start)
        played = play_episode(begun, alone, act, policy.init_carry(), key_episode, gamma=gamma, length=length)
        rows = played.transitions
        last = value_of(params, rows.next_obs[-1])
        return discounted_returns(rows.reward, rows.discount, last)[0], ~played.exploded

    return whole(split_vmap(jax.vmap(one, (0, None, 0)))(worlds, obs, keys))


def bytes_of(env: Env, config: PretrainConfig) -> int:
    """Bytes that the episodes of one fit take: observations as they are and normalised, rewards, targets."""
    steps = config.value_episodes * length_of(env, config.gamma, config.value_left)
    return 4 * steps * (2 * env.obs_dim + 4)
