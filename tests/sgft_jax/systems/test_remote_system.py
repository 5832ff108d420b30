"""Fine-tuning's view of a robot behind a socket: the episodes of a simulation, rewards from the task, what was sent."""

import functools
import threading

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy

from envs.gaps import Gap
from envs.rollout import real_worlds
from envs.types import Policy, UserError
from sgft_jax.systems.gymnasium import Gymnasium, seed_of
from sgft_jax.systems.remote import Remote
from sgft_jax.systems.robot_client import Limits, play
from sgft_jax.systems.simulated import Simulated

pytest.importorskip("gymnasium", reason="make setup EXTRAS=dev, or pip install 'sgft-jax[gymnasium]'")

from envs.adapters.gymnasium import TaskEnv

GAMMA, TURNED = 0.9, Gap("turned", {"mass": [0.8, 2.0]}, {"action_rotation": 0.4, "obs_noise": 0.02})


class Driver:
    """A simulated robot that does not know what its steps are worth."""

    def __init__(self, env):
        self.env, self.rests = env, 0
        self.obs_size, self.action_size = env.observation_space.shape[0], env.action_space.shape[0]

    def reset(self, seed):
        return self.env.reset(seed=seed)[0]

    def step(self, action):
        obs, _, _, truncated, info = self.env.step(action)
        return obs, float("nan"), False, truncated, info

    def stop(self):
        self.rests += 1


@pytest.fixture
def robot():
    started = []

    def start(**options):
        driver = Driver(TaskEnv(toy.make(), TURNED))
        remote = Remote(driver.obs_size, driver.action_size, say=lambda line: None)
        options = {"token": remote.token, "say": lambda line: None, **options}
        thread = threading.Thread(target=play, args=(driver, remote.url), kwargs=options, daemon=True)
        thread.start()
        started.append((remote, thread))
        return remote, driver

    yield start
    for remote, thread in started:
        remote.close()
        thread.join(timeout=10)


def steady(actions):
    def act(state, carry, obs, key, *, explore):
        return jnp.tanh(state * obs.sum() + 0.3 * jax.random.normal(key, (actions,))), carry

    return Policy(lambda: jnp.zeros(()), act)


@pytest.mark.heavy
def test_a_robot_plays_the_episodes_of_the_simulation(robot):
    env = toy.make()
    policy, states = steady(env.act_dim), jnp.array([0.7])
    keys = jax.random.split(jax.random.key(3), (1, 2))
    same = jax.vmap(jax.vmap(lambda key: jax.random.key(seed_of(key))))(keys)
    simulated = Simulated(env, real_worlds(env, [TURNED], jax.random.key(0)), jnp.zeros(1, int), gamma=GAMMA)
    expected = simulated.play(policy, states, same, explore=True)
    remote, driver = robot()
    found = Gymnasium(env, remote, gamma=GAMMA).play(policy, states, keys, explore=True)
    for name in ("valid", "success", "transitions"):
        pair = getattr(found, name), getattr(expected, name)
        jax.tree.map(functools.partial(np.testing.assert_allclose, atol=0.1 if name == "transitions" else 0), *pair)
    # the task rewards what is seen, the simulation what is true: they differ by the noise of the sensors
    seen = jax.vmap(env.reward)(
        *(jnp.asarray(x[0, 0]) for x in (found.transitions.obs, found.transitions.action, found.transitions.next_obs))
    )
    np.testing.assert_allclose(found.transitions.reward[0, 0], jnp.where(found.valid[0, 0], seen, 0.0), atol=1e-6)
    assert driver.rests >= 2


@pytest.mark.heavy
def test_what_was_sent_is_what_is_kept(robot):
    env = toy.make()
    remote, _ = robot(limits=Limits(low=-0.2, high=0.2))
    episode = Gymnasium(env, remote, gamma=GAMMA).play(
        steady(env.act_dim), jnp.array([5.0]), jax.random.split(jax.random.key(0), (1, 1)), explore=True
    )
    kept = np.asarray(episode.transitions.action)[np.asarray(episode.valid)]
    assert kept.size and np.abs(kept).max() == pytest.approx(0.2)


def test_a_task_that_cannot_tell_rewards_needs_a_robot_that_can(robot):
    env = toy.make()._replace(reward=None)
    remote, _ = robot()
    with pytest.raises(UserError, match="does not know its reward, and"):
        Gymnasium(env, remote, gamma=GAMMA).play(
            steady(env.act_dim), jnp.array([1.0]), jax.random.split(jax.random.key(0), (1, 1)), explore=True
        )
