"""The runners as environments: rewards and ends by hand, noise, starts, and states that are seen again."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from compiled import make
from runners import TASKS, at_rest, begun, compiled, member, play, pool_of, thrown

import envs
from envs import gaps
from envs.locomotion import halfcheetah, walker2d

KEY = jax.random.key(0)
FAST = ["halfcheetah", pytest.param("walker2d", marks=pytest.mark.slow)]


@pytest.mark.heavy
@pytest.mark.parametrize("task", FAST)
def test_observations_hold_everything_but_x(task):
    env = make(task, "c")
    states = thrown(env, pool_of(env, [gaps.SIM]), 24)[0]
    physics = states.physics
    assert [e.name for e in env.observation][:3] == ["height", "pitch", "joint_angles"] and env.obs_dim == 17
    np.testing.assert_array_equal(states.true_obs[..., :8], physics.qpos[..., 1:])
    speeds = physics.qvel if task == "halfcheetah" else np.clip(physics.qvel, -10, 10)
    np.testing.assert_array_equal(states.true_obs[..., 8:], speeds)
    assert np.abs(physics.qvel).max() > 10.0  # the clipping had something to do
    np.testing.assert_array_equal(states.obs, states.true_obs)  # exact sensors


@pytest.mark.parametrize("task", TASKS)
def test_the_reward_is_speed_and_bonus_less_control(task):
    """1.5 cm forward; controls 0.5, -1, 0, 0, 0, 0.2 of which the squares add up to 1.29."""
    scene = TASKS[task].SCENE
    before = at_rest(task)
    control = jnp.array([0.5, -1.0, 0.0, 0.0, 0.0, 0.2])
    after = before._replace(qpos=before.qpos.at[0].add(0.015), ctrl=control)
    params = jnp.ones(len(scene.parameters))
    wanted = {"halfcheetah": 0.3 - 0.129, "walker2d": 1.875 + 1.0 - 0.00129}[task]  # 0.015 / 0.05, 0.015 / 0.008
    np.testing.assert_allclose(scene.measured(params, before, None, after).reward, wanted, rtol=1e-5)


@pytest.mark.parametrize(("task", "way"), [("halfcheetah", 1.0 * 0.4 + 2.0 * 0.6), ("walker2d", 1.5)])
def test_the_reward_of_what_is_seen_by_hand(task, way):
    """From 1 to 2 m/s in one posture. Of five steps of Euler's each moves by its last speed: 1.2, ..., 2.0, on average
    1.6. Controls of 0.5 and 2, the latter cut to 1: squares of 1.25. Other postures and speeds of joints: see below."""
    cost, bonus = {"halfcheetah": (0.1, 0.0), "walker2d": (0.001, 1.0)}[task]
    obs = jnp.zeros(17).at[1:8].set(0.3)
    action = jnp.array([0.5, 0, 0, 0, 0, -2.0])
    found = make(task, "c").reward(obs.at[8].set(1.0), action, obs.at[8].set(2.0))
    np.testing.assert_allclose(found, way + bonus - cost * 1.25, rtol=1e-5)


def test_the_centre_of_mass_leads_the_root_as_mujoco_says():
    model = compiled("halfcheetah")
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for pose in rng.uniform(-1, 1, (4, 7)):
        data.qpos[:] = [0.7, 0.2, *pose]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(
            halfcheetah.lead(jnp.asarray(pose, jnp.float32)), data.subtree_com[0, 0] - 0.7, atol=1e-5
        )


@pytest.mark.heavy
@pytest.mark.parametrize(("task", "least", "error"), [("halfcheetah", 0.99, 0.1), ("walker2d", 0.99, 0.06)])
def test_the_reward_of_what_is_seen_is_nearly_what_is_measured(task, least, error):
    """Their correlation, and the root mean square of what is between them, m/s, in a motion of the nominal runner."""
    env = make(task, "c")
    states, actions = thrown(env, pool_of(env, [gaps.SIM]), 200)
    alive = ~states.terminated[:-1, 0].astype(bool)
    seen = jax.jit(jax.vmap(env.reward))(states.true_obs[:-1, 0], actions[:, 0], states.true_obs[1:, 0])
    seen, measured = (np.asarray(x)[alive] for x in (seen, states.reward[1:, 0]))
    assert np.corrcoef(seen, measured)[0, 1] > least and np.sqrt(np.mean((seen - measured) ** 2)) < error


def test_stronger_thighs_cost_as_much_as_their_control():
    """Twice the torque of thighs at 0.5 and -1: squares of 1 and -2 in place of 0.25 and 1, 3.75 more."""
    still = at_rest("walker2d")
    after = still._replace(ctrl=jnp.array([0.5, 0.0, 0.0, -1.0, 0.0, 0.0]))
    params = jnp.ones(5)
    stronger = params.at[[p.name for p in walker2d.PARAMETERS].index("thigh_torque")].set(2.0)
    weak, strong = (walker2d.SCENE.measured(p, still, None, after).reward for p in (params, stronger))
    np.testing.assert_allclose(weak - strong, 0.001 * 3.75, rtol=1e-4)


@pytest.mark.parametrize(
    ("height", "pitch", "fallen"),
    [
        (1.25, 0.0, False),
        (0.81, 0.99, False),
        (0.79, 0.0, True),
        (2.01, 0.0, True),
        (1.25, 1.01, True),
        (1.25, -1.01, True),
    ],
)
def test_the_walker_has_fallen(height, pitch, fallen):
    obs = jnp.zeros(17).at[0].set(height).at[1].set(pitch)
    assert bool(walker2d.terminated(jnp.zeros(17), jnp.zeros(6), obs)) == fallen


@pytest.mark.heavy
def test_a_fall_ends_the_episode_and_the_time_limit_truncates_it():
    """The bonus is paid in the step of the fall too. HalfCheetah upside down runs on."""
    for task, ends in (("walker2d", True), ("halfcheetah", False)):
        env = make(task, "c")
        pool = pool_of(env, [gaps.SIM])
        turned = at_rest(task)
        state = begun(env, pool, turned._replace(qpos=turned.qpos.at[2].set(2.0)))
        late = state._replace(time=jnp.full(1, 998, jnp.int32))
        states = play(env, pool, late, jnp.zeros((2, 1, 6)))
        assert states.truncated[1:, 0].tolist() == [False, True]
        assert states.terminated[1:, 0].tolist() == [ends, ends]
        moved = (states.physics.qpos[1, 0, 0] - states.physics.qpos[0, 0, 0]) / env.control_dt
        np.testing.assert_allclose(states.reward[1, 0] - moved, 1.0 if ends else 0.0, atol=1e-4)


@pytest.mark.heavy
@pytest.mark.parametrize("task", TASKS)
def test_starts_are_gyms(task):
    env = make(task, "c")
    world = member(pool_of(env, [gaps.SIM]), 0)
    states = jax.vmap(lambda key: env.reset(world, key))(jax.random.split(KEY, 1000))
    position = np.asarray(states.physics.qpos) - np.asarray(at_rest(task).qpos)
    half = {"halfcheetah": 0.1, "walker2d": 0.005}[task]
    assert (np.abs(position) <= half + 1e-6).all() and (np.abs(position).max(0) > 0.99 * half).all()
    speed = np.asarray(states.physics.qvel)
    if task == "halfcheetah":
        np.testing.assert_allclose(speed.std(0), 0.1, rtol=0.08)
        assert np.abs(speed).max() > 0.3  # normal, not uniform
    else:
        assert (np.abs(speed) <= half).all() and (np.abs(speed).max(0) > 0.99 * half).all()
    assert not states.terminated.any()


@pytest.mark.heavy
@pytest.mark.parametrize("task", FAST)
def test_joint_noise_moves_the_motors_and_what_they_cost(task):
    """Executed is clip(0.5 + n): the share at either bound, and a step and its reward are those of what is executed."""
    env = make(task, "c")
    real, noisy = (member(pool_of(env, [name]), 0) for name in (gaps.SIM, "joint-noise"))
    start = member(begun(env, pool_of(env, [gaps.SIM]), at_rest(task)), 0)
    start = start._replace(effects=env.reset(noisy, KEY).effects)
    action = jnp.full(6, 0.5)
    states = jax.jit(jax.vmap(lambda key: env.step(noisy, start, action, key)))(jax.random.split(KEY, 2000))
    control = np.asarray(states.physics.ctrl)
    assert (np.abs(control) <= 1.0 + 1e-6).all()
    # P(n > 0.5) = 0.3085, P(n < -1.5) = 0.0668
    np.testing.assert_allclose([(control > 0.999).mean(), (control < -0.999).mean()], [0.3085, 0.0668], atol=0.015)
    assert abs(np.corrcoef(control[:, 0], control[:, 1])[0, 1]) < 0.1  # each joint has its own
    exact = start._replace(effects=env.reset(real, KEY).effects)
    for i in range(3):
        same = env.step(real, exact, states.physics.ctrl[i], KEY)
        np.testing.assert_allclose(states.physics.qvel[i], same.physics.qvel, atol=1e-4)
        np.testing.assert_allclose(states.reward[i], same.reward, atol=1e-4)


@pytest.mark.heavy
@pytest.mark.parametrize("task", FAST)
def test_a_state_that_was_seen_is_restored(task):
    """The next observation is the same from there on, wherever along x it was seen."""
    env = make(task, "c")
    pool = pool_of(env, [gaps.SIM])
    actions = 0.3 * jax.random.normal(KEY, (6, 1, 6))
    states = play(env, pool, begun(env, pool, at_rest(task)), actions)
    last = member(states, -1, 0)
    assert np.abs(last.physics.qvel).max() < walker2d.MOST_SPEED and abs(float(last.physics.qpos[0])) > 1e-3
    again = env.restore(member(pool, 0), last.obs, KEY)
    np.testing.assert_array_equal(again.true_obs, last.true_obs)
    one, other = (env.step(member(pool, 0), state, jnp.full(6, 0.4), KEY) for state in (last, again))
    np.testing.assert_allclose(one.true_obs, other.true_obs, atol=1e-4)
    np.testing.assert_allclose(one.reward, other.reward, atol=1e-3)


@pytest.mark.slow
def test_random_commands_earn_what_d4rl_says():
    """Its reference for a random policy is -280 on HalfCheetah and 1.6 on Walker2d, which soon falls."""
    for task, (low, high) in {"halfcheetah": (-400.0, -180.0), "walker2d": (-15.0, 30.0)}.items():
        env = make(task, "c")
        pool = pool_of(env, [gaps.SIM])

        def act(carry, obs, key):
            return jax.random.uniform(key, (6,), minval=-1.0, maxval=1.0), carry

        play_one = jax.jit(
            jax.vmap(lambda key, env=env, pool=pool: envs.play_episode(env, pool, act, (), key, gamma=1.0))
        )
        episodes = play_one(jax.random.split(KEY, 6))
        assert low < float(episodes.score.mean()) < high, task
        lengths = episodes.valid.sum(1)
        assert (lengths == 1000).all() if task == "halfcheetah" else (lengths < 200).all()
        np.testing.assert_array_equal(episodes.score, episodes.total_reward)
