"""Rollouts are explained best by the system that made them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy

from envs.base import EffectRange, Entry, Theta, World
from envs.effects import make_range
from sgft_jax.posterior.candidates import Candidates
from sgft_jax.posterior.replay import Rollout, replay

TOY = toy.make()
NOISE = 0.01
NOWHERE = jnp.zeros(0)


def world(mass=1.0, friction=0.3, **effects):
    values = make_range(TOY, {"obs_noise": NOISE, "obs_noise_prob": 1.0, **effects}).low
    return World(Theta(jnp.array([mass, friction]), EffectRange(values, values)), {})


def played(there, key, env=TOY, steps=20):
    """A rollout of random commands."""
    key_reset, key_actions, key_steps = jax.random.split(key, 3)
    start = env.reset(there, key_reset)
    actions = jax.random.uniform(key_actions, (steps, 2), minval=-1.0)

    def step(state, row):
        after = env.step(there, state, *row)
        return after, (after.obs, after.success)

    _, (obs, success) = jax.lax.scan(step, start, (actions, jax.random.split(key_steps, steps)))
    return Rollout(jnp.concatenate([start.obs[None], obs]), actions, jnp.ones(steps, bool), success[-1])


def candidates(world, low=NOWHERE, high=NOWHERE):
    """Systems of one place parameter at most, and no other."""
    return Candidates((), lambda point, place: world(place), low, high, low, high)


def evidence(rollout, there, key, **options):
    return replay(TOY, candidates(lambda place: there), NOWHERE, rollout, key, **options)


OTHERS = {
    "mass": {"mass": 1.3},
    "friction": {"friction": 0.8},
    "scale": {"action_scale": 0.7},
    "turn": {"action_rotation": 0.4},
    "latency": {"latency": 0.08},
}


@pytest.mark.parametrize("name", OTHERS)
def test_the_true_system_explains_more(name, key):
    rollout = played(world(**OTHERS[name]), key)
    compiled = jax.jit(lambda there, key: evidence(rollout, there, key).log_likelihood.sum())
    keys = jax.random.split(key, 4)
    true, false = (np.mean([compiled(world(**x), k) for k in keys]) for x in (OTHERS[name], {}))
    assert true > false + 10


def test_evidence_is_a_density(key):
    """Of white noise around the truth: at most minus its entropy, on average, and less by what it forgives."""
    rollout = played(world(), key)
    mean = evidence(rollout, world(), key, states=64).log_likelihood[2:].mean()
    entropy = 4 * (0.5 * np.log(2 * np.pi * np.e) + np.log(NOISE))
    assert 0.0 < -mean - entropy < 2.5


def test_steps_that_are_not_valid_count_nothing(key):
    rollout = played(world(), key)
    cut = rollout._replace(valid=jnp.arange(20) < 7, measured=rollout.measured.at[8:].set(jnp.nan))
    whole, part = (evidence(r, world(), key).log_likelihood for r in (rollout, cut))
    np.testing.assert_array_equal(part[:7], whole[:7])
    np.testing.assert_array_equal(part[7:], 0.0)


@pytest.mark.heavy
def test_more_states_err_less(key):
    rollout = played(world(), key)

    def spread(states):
        keys = jax.random.split(key, 16)
        return np.std(jax.vmap(lambda k: evidence(rollout, world(), k, states=states).log_likelihood.sum())(keys))

    assert spread(32) < 0.6 * spread(2)


def showing(env):
    """The same task whose last measurement is the friction, as a camera sees where a hole is."""

    def shown(there, state):
        friction, error = there.theta.params[1:], state.effects.obs_bias[-1:]
        noisy = jnp.concatenate([state.obs, friction + error])
        return state._replace(obs=noisy, true_obs=jnp.concatenate([state.true_obs, friction]))

    def bare(state):
        effects = state.effects._replace(obs_bias=state.effects.obs_bias[:-1])
        return state._replace(obs=state.obs[:4], true_obs=state.true_obs[:4], effects=effects)

    def bared(there):
        ends = (end._replace(obs_bias=end.obs_bias[:-1]) for end in there.theta.effects)
        return there._replace(theta=there.theta._replace(effects=EffectRange(*ends)))

    def whole(there, state):
        effects = state.effects._replace(obs_bias=there.theta.effects.low.obs_bias)
        return shown(there, state._replace(effects=effects))

    return env._replace(
        observation=(*env.observation, Entry("friction", "1/s", 1)),
        reset=lambda there, key: whole(there, env.reset(bared(there), key)),
        restore=lambda there, obs, key: whole(there, env.restore(bared(there), obs[:4], key)),
        step=lambda there, state, action, key: whole(there, env.step(bared(there), bare(state), action, key)),
    )


@pytest.mark.heavy
def test_what_an_episode_draws_is_taken_from_its_first_measurement(key):
    """A friction of 0.7 is seen as 0.8 by a camera that errs by 0.1: whoever knows the error knows the friction."""
    env = showing(TOY)

    def there(friction, error):
        plain = world(friction=friction)
        ends = [end._replace(obs_bias=jnp.append(end.obs_bias, error)) for end in plain.theta.effects]
        return plain._replace(theta=plain.theta._replace(effects=EffectRange(*ends)))

    rollout = played(there(0.7, 0.1), key, env)

    def total(error, low=0.0, high=1.0):
        systems = candidates(lambda place: there(place[0], error), jnp.array([low]), jnp.array([high]))
        keys = jax.random.split(key, 8)
        return jnp.mean(jax.vmap(lambda k: replay(env, systems, NOWHERE, rollout, k).log_likelihood.sum())(keys))

    assert total(0.1) > total(0.0) + 10  # friction 0.8 moves otherwise
    assert abs(total(0.1) - total(0.1, 0.69, 0.71)) < 8  # as if it had been told
