"""Tasks as Gymnasium environments: Gymnasium's own checks, and the episodes that the project's own loops play."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
import toy_terminating

import envs
from envs.gaps import Gap
from envs.rollout import play_episode, real_worlds
from envs.types import UserError

gymnasium = pytest.importorskip("gymnasium", reason="make setup EXTRAS=dev, or pip install 'sgft-jax[gymnasium]'")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from envs.adapters.gymnasium import TaskEnv, TaskVectorEnv, name_of  # noqa: E402

GAP = Gap("odd", {"mass": [0.8, 2.0]}, {"action_rotation": 0.4, "obs_noise": 0.02})
ALARM = Gap("alarm", {"risk": 0.3}, {})


def played(env, gap, seeds, actions):
    """The episodes [n] of seeds with given actions [T, act_dim], by the project's own loop."""
    pool = jax.tree.map(lambda x: x[0], real_worlds(env, [gap], jax.random.key(0)))
    given = jnp.asarray(actions)

    def act(step, obs, key):
        return given[step], step + 1

    def play(seed):
        return play_episode(env, pool, act, jnp.int32(0), jax.random.key(seed), gamma=1.0)

    return jax.jit(jax.vmap(play))(jnp.asarray(seeds, jnp.uint32))


def steps(env, seed, actions):
    """Observations [n + 1], rewards, terminated, truncated [n] of an episode, and what it said at its end."""
    obs, _ = env.reset(seed=seed)
    found = [(obs, 0.0, False, False, {})]
    for action in actions:
        found.append(env.step(action))
        if found[-1][2] or found[-1][3]:
            break
    obs, reward, terminated, truncated, told = zip(*found, strict=True)
    return np.stack(obs), np.array(reward[1:]), np.array(terminated[1:]), np.array(truncated[1:]), told[-1]


# --- one environment --------------------------------------------------------------------------------------------------


@pytest.mark.heavy
@pytest.mark.parametrize("make", [pytest.param(toy.make, marks=pytest.mark.slow), toy_terminating.make])
def test_gymnasiums_own_check_finds_nothing(make):
    """Except that the observations have no bounds, which is so, and that no spec says how to make it once more."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", ".*infinity|.*alternative render modes")
        check_env(TaskEnv(make(), worlds=2))


@pytest.mark.slow
@pytest.mark.parametrize("task", envs.TASKS)
def test_every_task_passes_gymnasiums_check(task):
    """By name, on its gap called default where it has one: what is declared is what is returned."""
    gap = {"gap": "default"} if "default" in envs.gaps.presets(task) else {}
    env = gymnasium.make(name_of(task), impl="c", worlds=2, **gap)
    with warnings.catch_warnings(), jax.numpy_rank_promotion("allow"):
        warnings.filterwarnings("ignore", ".*infinity")
        check_env(env.unwrapped)
    env.close()


def test_names_are_gymnasiums_way_of_writing():
    assert name_of("push-ball") == "sgft_jax/PushBall-v0" and name_of("walker2d") == "sgft_jax/Walker2d-v0"
    assert {name_of(task) for task in envs.TASKS} <= set(gymnasium.registry)


@pytest.mark.heavy
def test_an_episode_is_the_one_that_the_project_plays():
    env, actions = toy.make(), np.random.default_rng(0).uniform(-1, 1, (20, 2)).astype(np.float32)
    expected = played(env, GAP, [7, 8], actions)
    one = TaskEnv(env, GAP)
    for i, seed in enumerate([7, 8]):
        obs, reward, terminated, truncated, told = steps(one, seed, actions)
        np.testing.assert_allclose(obs[:-1], expected.transitions.obs[i], atol=1e-5)
        np.testing.assert_allclose(obs[-1], expected.transitions.next_obs[i, -1], atol=1e-5)
        np.testing.assert_allclose(reward, expected.transitions.reward[i], atol=1e-5)
        assert not terminated.any() and truncated.tolist() == [False] * 19 + [True]
        assert told == {"is_success": bool(expected.success[i]), "invalid": False}


@pytest.mark.heavy
def test_a_termination_is_no_truncation():
    env, actions = toy_terminating.make(), np.ones((12, 1), np.float32)
    lengths = np.asarray(played(env, ALARM, range(8), actions).valid).sum(1)
    assert lengths.min() < 12
    one = TaskEnv(env, ALARM)
    for seed, length in enumerate(lengths):
        _, reward, terminated, truncated, told = steps(one, seed, actions)
        assert len(reward) == length and terminated[-1] == (length < 12) and truncated[-1] == (length == 12)
        assert "is_success" not in told  # judged by return, and without a success


def test_exploded_physics_truncates_with_what_was_seen_last():
    env = toy.make()

    def explodes(world, state, action, key):
        after = env.step(world, state, action, key)
        over = after.time == 3
        return after._replace(invalid=over, obs=jnp.where(over, jnp.nan, after.obs), reward=after.reward * jnp.nan)

    obs, reward, terminated, truncated, told = steps(TaskEnv(env._replace(step=explodes)), 0, np.ones((20, 2)))
    assert truncated.tolist() == [False, False, True] and not terminated.any() and told["invalid"]
    np.testing.assert_array_equal(obs[-1], obs[-2])
    assert reward[-1] == 0.0 and not told["is_success"]


def test_a_seed_decides_the_episodes_that_follow_too():
    env = TaskEnv(toy.make())
    first, second = ([env.reset(seed=seed)[0], env.reset()[0], env.reset()[0]] for seed in (3, 3))
    np.testing.assert_array_equal(first, second)
    assert len({obs.tobytes() for obs in first}) == 3


def test_an_unknown_gap_is_one_line():
    with pytest.raises(UserError, match="toy has no gap 'hardd'"):
        TaskEnv(toy.make(), "hardd")


# --- many -------------------------------------------------------------------------------------------------------------


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("make", "gap"), [pytest.param(toy.make, GAP, marks=pytest.mark.slow), (toy_terminating.make, ALARM)]
)
def test_many_play_what_one_plays_from_reset_to_reset(make, gap):
    """Each with its own seed, over several episodes; the step that begins an episode anew ignores its action."""
    one, many = TaskEnv(make(), gap), TaskVectorEnv(make(), gap, num_envs=3)
    actions = np.random.default_rng(1).uniform(-1, 1, (45, 3, *one.action_space.shape)).astype(np.float32)
    start, _ = many.reset(seed=5)
    together = [many.step(action) for action in actions]
    assert many.observation_space.contains(together[0][0]) and together[0][0].shape == (
        3,
        one.observation_space.shape[0],
    )
    for i in range(3):
        obs, _ = one.reset(seed=5 + i)
        np.testing.assert_allclose(obs, start[i], atol=1e-6)
        over = False
        for action, (seen, reward, terminated, truncated, told) in zip(actions[:, i], together, strict=True):
            alone = (one.reset()[0], 0.0, False, False) if over else one.step(action)
            np.testing.assert_allclose(alone[0], seen[i], atol=1e-5)
            assert alone[1] == pytest.approx(reward[i], abs=1e-5)
            assert (alone[2], alone[3]) == (terminated[i], truncated[i])
            assert bool(told["_invalid"][i]) != over
            over = alone[2] or alone[3]


@pytest.mark.heavy
def test_many_by_name():
    env = gymnasium.make_vec("sgft_jax/Push-v0", num_envs=2, gap="default", impl="c", worlds=1)
    assert isinstance(env, TaskVectorEnv) and env.reset(seed=[1, None])[0].shape == (2, 4)


# --- what trains on it ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_stable_baselines_trains_on_it_unchanged():
    """SAC of Stable-Baselines3 learns the point mass: its mean return rises, measured by its own evaluation."""
    sb3 = pytest.importorskip("stable_baselines3", reason="pip install stable-baselines3")
    from stable_baselines3.common.env_checker import check_env as sb3_check
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.monitor import Monitor

    torch = pytest.importorskip("torch")
    torch.set_num_threads(1)
    env, other = (Monitor(TaskEnv(toy.make(), GAP)) for _ in range(2))
    sb3_check(env)
    small = {"learning_starts": 200, "learning_rate": 1e-3, "policy_kwargs": {"net_arch": [32, 32]}}
    agent = sb3.SAC("MlpPolicy", env, seed=0, device="cpu", **small)
    before, _ = evaluate_policy(agent, other, n_eval_episodes=20)
    agent.learn(1_500)
    after, _ = evaluate_policy(agent, other, n_eval_episodes=20)
    assert after > before + 2


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(envs.TASKS))
def test_stable_baselines_trains_on_every_task_by_name(name):
    """Its own check finds nothing, and 100 steps with updates run; their episodes are too few to learn from."""
    sb3 = pytest.importorskip("stable_baselines3", reason="pip install stable-baselines3")
    from stable_baselines3.common.env_checker import check_env as sb3_check

    env = gymnasium.make(name_of(name), gap="sim", impl="c", worlds=1)
    sb3_check(env)
    agent = sb3.SAC("MlpPolicy", env, seed=0, device="cpu", learning_starts=50, policy_kwargs={"net_arch": [32]})
    agent.learn(100)
    action, _ = agent.predict(env.reset(seed=0)[0])
    assert agent.num_timesteps == 100 and env.action_space.contains(action)
