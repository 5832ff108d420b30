"""The twin of Meta-World's hammer-v3: rewards by hand, hand and fingers as Meta-World's move, a script, the driver."""

import importlib.util
import sys
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import make
from franka_bench import bench, member, periods_apart
from scipy.spatial.transform import Rotation

import envs
from envs.franka import metaworld_hammer as task
from envs.mujoco.engines import warp as engine_warp

KEY = jax.random.key(0)
NOMINAL = {p.name: p.nominal for p in task.PARAMETERS} | {"start_above": 0.0, "start_held": 0.0}
DRIVER = Path(__file__).parents[3] / "docs/examples/metaworld_robot.py"
OPEN, CLOSE = -1.0, 1.0
face_of = jax.jit(task.face_of)


def rig_of(impl="c", **params):
    env = make("metaworld-hammer", impl)
    return bench(env, envs.sample_worlds(env, KEY, 1, params=NOMINAL | params, effects={"obs_noise": 0.0}))


@pytest.fixture(scope="module")
def rig():
    return rig_of()


def seen(hand=(0, 0.4, 0.2), apart=0.1, hammer=(0, 0.5, 0.0284), turn=(1, 0, 0, 0), depth=0.0, **rates):
    """[26] at rest but for the rates that are named."""
    named = {"hand": 3, "fingers": 1, "hammer": 3, "spin": 3, "nail": 1}
    v = {name: rates.get(f"{name}_rate", [0.0] * size) for name, size in named.items()}
    parts = hand, hand, v["hand"], [apart], v["fingers"], hammer, turn, v["hammer"], v["spin"], [depth], v["nail"]
    return jnp.concatenate([jnp.asarray(x, jnp.float32) for x in parts])


LYING = np.asarray(task._lying())


def play(rig, obs, actions):
    """[T + 1, 26] what is seen at first and after each action, from a state that is seen as `obs` [26]."""
    world, state = member(rig.worlds, 0), rig.env.restore(member(rig.worlds, 0), jnp.asarray(obs), KEY)
    shown = [np.asarray(state.true_obs)]
    for action in actions:
        state = rig.step(world, state, jnp.asarray(action, jnp.float32), KEY)
        assert not state.invalid
        shown.append(np.asarray(state.true_obs))
    return np.array(shown)


# --- rewards --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("obs", "wanted"),
    [
        # 10 cm above where it may grip, and 0.148259 m from face to nail: (0.08, 0.059, 0.11)
        # 0.2 (1 - tanh 1) + 0.4 (1 - tanh(5 * 0.148259))
        (seen(hand=(0, 0.5, 0.13), hammer=(0, 0.5, 0.0)), 0.195709),
        # fingers that are closed there get 0.2 (1 - tanh 1)^4
        (seen(hand=(0, 0.5, 0.13), hammer=(0, 0.5, 0.0), apart=0.05), 0.196355),
        # around the handle, 8 cm from its middle, 2 cm above: 0.2 + 0.2
        (seen(hand=(-0.08, 0.5, 0.02), hammer=(0, 0.5, 0.0), apart=0.05), 0.548028),
        # 10 cm beyond the last 11 cm of it
        (seen(hand=(-0.21, 0.5, 0.0), hammer=(0, 0.5, 0.0)), 0.195709),
        # held, the face half way up, 3.6 cm below the nail's head and 3.6 cm before it: 0.4 (1 - tanh(5 * 0.050912))
        (seen(hand=(0.08, 0.523, 0.074), hammer=(0.08, 0.523, 0.074), apart=0.05), 0.2 + 0.2 + 0.1 + 0.300320),
        # the nail is half in and the face at it
        (seen(hand=(0.08, 0.609, 0.12), hammer=(0.08, 0.609, 0.11), apart=0.05, depth=0.05), 0.6 + 0.4 + 0.5),
    ],
)
def test_rewards_by_hand(obs, wanted):
    np.testing.assert_allclose(task.reward(obs * 0, jnp.zeros(4), obs), wanted, atol=1e-5)


def test_a_hammer_that_is_turned_is_rewarded_for_where_its_face_is():
    """A quarter turn to the left brings the head to +y, the face to -x."""
    obs = seen(turn=(np.sqrt(0.5), 0, 0, np.sqrt(0.5)))
    np.testing.assert_allclose(task.face_of(obs), [-0.072, 0.66, 0.0284], atol=1e-6)
    across = seen(hand=(0.02, 0.55, 0.04), turn=(np.sqrt(0.5), 0, 0, np.sqrt(0.5)))  # the handle lies along y now
    np.testing.assert_allclose(task.off_handle(across), [0.02, 0.0, 0.0], atol=1e-6)


def test_success_is_a_nail_more_than_nine_centimetres_deep():
    assert task.success(seen(depth=0.0901)) and not task.success(seen(depth=0.0899))


# --- starts and states that are restored ----------------------------------------------------------------------------


@pytest.mark.heavy
def test_starts_fill_the_rectangle_and_every_kind_of_start_is_drawn():
    params = jnp.array([p.nominal for p in task.PARAMETERS])
    starts = jax.jit(jax.vmap(lambda key: task.initial(params, key)))(jax.random.split(KEY, 3000))
    effort, z, hand = starts.ctrl[:, 3], np.asarray(starts.qpos[:, 7]), np.asarray(starts.qpos[:, :3])
    held = np.asarray(effort > 0)
    at_start = np.abs(hand - (task.START - [0, 0, task.SAG])[None]).max(1) < 1e-5
    assert abs(held.mean() - 0.25) < 0.03 and abs(at_start.mean() - 0.5) < 0.03 and not (held & at_start).any()
    xy = np.asarray(starts.qpos[~held, 5:7])
    np.testing.assert_allclose([xy.min(0), xy.max(0)], task.HAMMER_AT, atol=2e-3)
    np.testing.assert_allclose(z[~held], task.LYING, atol=1e-6)
    above = ~held & ~at_start
    off = hand[above] - np.asarray(starts.qpos[above, 5:8])
    assert np.abs(off[:, 1]).max() < task.OPEN - task.INSIDE - task.HANDLE_RADIUS  # no finger in the handle
    assert np.abs(off[:, 0]).max() < task.HANDLE_HALF - task.FINGER_HALF[0]
    faces = starts.qpos[held, 6] + task.FACE_Y
    assert (faces < task.NAIL[1]).all() and (z[held] > task.LYING).all()


@pytest.mark.heavy
def test_a_hammer_that_starts_in_hand_stays_there():
    rig = rig_of(start_held=1.0)
    for seed in range(4):
        state = rig.reset(member(rig.worlds, 0), jax.random.key(seed))
        first = np.asarray(state.true_obs)
        for _ in range(10):
            state = rig.step(member(rig.worlds, 0), state, jnp.array([0, 0, 0, CLOSE]), KEY)
        np.testing.assert_allclose(state.true_obs[11:14], first[11:14], atol=4e-3)  # its weight bends the servo
        np.testing.assert_allclose(state.true_obs[14:18], first[14:18], atol=5e-3)


def test_fingers_close_around_a_handle_that_is_off_their_middle():
    """What is seen of them is their distance alone."""
    aside = seen(hand=(0, 0.5, 0.1), hammer=(0, 0.508, 0.09), apart=0.052)  # 2.6 cm each, of which 6 mm are thickness
    state = task.settled(jnp.zeros(9), aside)
    np.testing.assert_allclose(state.qpos[3:5], [0.05 - 0.026 + 0.008, 0.05 - 0.026 - 0.008], atol=1e-6)
    wide = seen(hand=(0, 0.5, 0.1), hammer=(0, 0.508, 0.09), apart=0.1)
    np.testing.assert_allclose(task.settled(jnp.zeros(9), wide).qpos[3:5], 0.0, atol=1e-6)
    elsewhere = seen(hand=(0, 0.5, 0.3), hammer=(0, 0.508, 0.09), apart=0.052)
    np.testing.assert_allclose(task.settled(jnp.zeros(9), elsewhere).qpos[3:5], 0.024, atol=1e-6)


@pytest.mark.heavy
def test_an_observation_tells_what_the_next_step_does(rig):
    """Through a whole scripted episode, in which hammer and hand move by centimetres: to a millimetre, typically far
    less.
    """
    world, state, errors = member(rig.worlds, 0), rig.reset(member(rig.worlds, 0), jax.random.key(1)), []
    for _ in range(48):
        again = rig.env.restore(world, state.true_obs, KEY)
        np.testing.assert_allclose(again.true_obs, state.true_obs, atol=2e-5)
        action = jnp.asarray(strike(np.asarray(state.true_obs)), jnp.float32)
        state, other = (rig.step(world, s, action, KEY) for s in (state, again))
        errors.append(np.abs(other.true_obs - state.true_obs)[np.r_[0:3, 9, 11:14, 24]].max())
    assert state.success
    assert np.median(errors) < 1e-4 and np.max(errors) < 2e-3


# --- as Meta-World moves --------------------------------------------------------------------------------------------


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("action", "axis", "wanted"),
    [
        ((1, 0, 0, OPEN), 0, (2.89, 11.9, 26.1, 43.5, 62.5, 82.2)),
        ((0, 1, 0, OPEN), 1, (3.74, 14.4, 29.6, 47.1, 65.6, 84.5)),
        ((0, 0, -1, OPEN), 2, (3.53, 13.1, 26.6, 42.5, 59.6, 77.5)),
    ],
)
def test_the_hand_lags_about_as_meta_worlds_does(rig, action, axis, wanted):
    """mm after 1 to 6 full actions from rest, as measured of Meta-World 3.1.1; to 15 % and 1 mm."""
    start = rig.reset(member(rig.worlds, 0), KEY).true_obs
    moved = 1000 * (play(rig, start, [action] * 6) - np.asarray(start)[None])[1:, :3]
    np.testing.assert_allclose(np.abs(moved[:, axis]), wanted, rtol=0.15, atol=1.0)
    np.testing.assert_allclose(np.delete(moved, axis, 1), 0.0, atol=1e-2)


def test_the_hand_is_sent_no_further_than_its_workspace(rig):
    start = rig.reset(member(rig.worlds, 0), KEY).true_obs
    shown = play(rig, start, [(0, -1, -1, OPEN)] * 12)
    np.testing.assert_allclose(shown[-1, 3:6], [0.0, 0.4, 0.05], atol=1e-6)
    np.testing.assert_allclose(shown[:3, 5], [0.2, 0.18, 0.16], atol=1e-6)  # from where it was sent, not where it is


def test_fingers_close_about_as_fast_as_meta_worlds(rig):
    """m between them after 1 to 7 full efforts, as measured of Meta-World 3.1.1; to 2 mm."""
    shown = play(rig, rig.reset(member(rig.worlds, 0), KEY).true_obs, [(0, 0, 0, CLOSE)] * 7)
    np.testing.assert_allclose(shown[1:, 9], [0.098, 0.092, 0.082, 0.071, 0.057, 0.043, 0.031], atol=2e-3)


def test_the_hammer_lies_as_meta_worlds_and_slides_as_far_as_friction_says(rig):
    """v^2 / (2 mu g) = 0.36 / 19.6 m across its handle, of which Meta-World's comes 0.018 m far."""
    lying = {"hammer": (0, 0.45, LYING[0]), "turn": LYING[1:]}
    shown = play(rig, seen(**lying), np.tile([0.0, 0, 0, OPEN], (8, 1)))
    np.testing.assert_allclose(shown[-1, 11:18], [0, 0.45, 0.0284, 0.9996, 0, -0.0297, 0], atol=5e-4)
    shown = play(rig, seen(**lying, hammer_rate=(0, 0.6, 0)), np.tile([0.0, 0, 0, OPEN], (8, 1)))
    np.testing.assert_allclose(shown[-1, 12] - 0.45, 0.0183, rtol=0.1)
    assert np.abs(shown[:, 13] - task.LYING).max() < 2e-3


def test_the_nail_slides_as_far_as_its_damper_lets_it(rig):
    """From 1 m/s: 0.09 kg / 2 N s/m = 4.5 cm; Meta-World's goes 4.4 cm."""
    shown = play(rig, seen(nail_rate=[1.0]), np.zeros((12, 4)))
    np.testing.assert_allclose(shown[-1, 24], 0.045, rtol=0.03)


# --- a script -------------------------------------------------------------------------------------------------------


def strike(obs):
    """[4]: go above the handle, go down, close, lift, bring the face before the nail, drive it in, stay there."""
    hand, sent, apart, hammer, depth = obs[:3], obs[3:6], obs[9], obs[11:14], obs[24]
    grip = hammer - [0.04, 0.0, 0.0]
    off, effort = hand - grip, OPEN
    if apart < 0.06 and np.abs(off).max() < 0.06:
        effort = CLOSE
        way = task.NAIL + np.array([0.0, depth, 0.0]) - np.asarray(face_of(jnp.asarray(obs)))
        if depth > task.DRIVEN:
            goal = sent
        elif hammer[2] < 0.08 and way[1] > 0.03:
            goal = sent + np.array([0.0, 0.0, 0.05])
        elif abs(way[0]) > 0.03 or abs(way[2]) > 0.03:
            goal = hand + way - np.array([0.0, 0.06, 0.0])
        else:
            goal = hand + np.array([way[0], 0.2, way[2]])
    elif np.abs(off[:2]).max() > 0.015:
        goal = np.array([*grip[:2], 0.12])
    elif off[2] > 0.025:
        goal = grip
    else:
        goal, effort = sent, CLOSE
    return np.clip([*((goal - sent) / task.STEP), effort], -1.0, 1.0)


def played(rig, key, policy, steps=75):
    state, shown = rig.reset(member(rig.worlds, 0), key), []
    for _ in range(steps):
        action = jnp.asarray(policy(np.asarray(state.true_obs)), jnp.float32)
        state = rig.step(member(rig.worlds, 0), state, action, KEY)
        shown.append((float(state.reward), bool(state.success), np.asarray(state.true_obs)))
    rewards, done, obs = zip(*shown, strict=True)
    return np.array(rewards), np.array(done), np.array(obs)


@pytest.mark.heavy
def test_a_script_takes_the_hammer_and_drives_the_nail_in(rig):
    for seed in range(3):
        rewards, done, obs = played(rig, jax.random.key(seed), strike)
        assert done[-1] and np.argmax(done) < 60
        carried = obs[(obs[:, 13] > 0.08) & ~done]
        assert len(carried) > 5 and np.abs(carried[:, 15:18]).max() < 0.08  # level: friction resists its turning
        # Every stage of it pays more than the one before, and the end more than anything else.
        assert rewards[-1] > 1.8 and rewards[-1] > rewards[~done].max()
        assert rewards[~done][-1] > 1.5 and rewards[~done].argmax() == (~done).sum() - 1
    assert rig.env.episode_length == 75


def test_a_hand_without_fingers_that_close_lifts_nothing(rig):
    _, done, obs = played(rig, KEY, lambda obs: [*strike(obs)[:3], OPEN])
    assert not done.any() and obs[:, 13].max() < 0.035 and obs[:, 24].max() < 1e-3


@pytest.mark.heavy
def test_a_hammer_that_keeps_pushing_does_not_pull_the_nail_out(rig):
    """The block stops it, the grip slips."""

    def push(obs):
        return strike(obs) if obs[24] < 0.02 else [0.0, 1.0, 0.0, CLOSE]

    for seed in range(3):
        _, done, obs = played(rig, jax.random.key(seed), push)
        assert done[-1] and obs[:, 24].max() < 0.115
        after = obs[np.argmax(done) :, 24]
        assert after.min() > task.DRIVEN


def test_a_turned_hammer_does_not_pull_the_nail_out_by_its_side(rig):
    """A face that presses on the nail from below goes back by 6 cm; with friction of 1 the nail went with it."""
    turn = np.array([0.981, -0.186, 0.048, 0.014])
    obs = seen(hand=(0.036, 0.664, 0.107), apart=0.051, hammer=(0.072, 0.663, 0.079), turn=turn / 0.99970, depth=0.087)
    obs = obs.at[3:6].set(jnp.array([0.044, 0.664, 0.137]))
    shown = play(rig, obs, [(0, -1, 0, CLOSE)] * 5)
    assert shown[-1, 12] < 0.61 and shown[-1, 24] > 0.07


# --- the driver and the engines -------------------------------------------------------------------------------------


@pytest.fixture
def driver(monkeypatch):
    """The module of the driver, without Meta-World."""
    monkeypatch.setitem(sys.modules, "metaworld", types.ModuleType("metaworld"))
    monkeypatch.setattr(sys, "path", [*sys.path])
    spec = importlib.util.spec_from_file_location("metaworld_robot", DRIVER)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_driver_measures_what_the_task_observes(driver):
    """Of a body that turns evenly and speeds up evenly, three frames tell the rates of the last one exactly."""
    env = envs.make("metaworld-hammer", "c")
    assert (driver.Hammer.obs_size, driver.Hammer.action_size) == (env.obs_dim, env.act_dim)
    assert env.control_dt == driver.FRAMES * driver.FRAME and driver.DRIVEN == task.DRIVEN
    rng = np.random.default_rng(0)
    place, speed, push = rng.normal(size=(3, 8))  # hand [3], fingers, hammer [3], nail
    spin, sent = np.array([3.0, -5.0, 8.0]), rng.normal(size=3)

    def frame(back):
        t = -back * driver.FRAME
        x = place + speed * t + push * t**2 / 2
        turn = (Rotation.from_rotvec(spin * t) * Rotation.from_rotvec([0.4, 0.2, -3.0])).as_quat(scalar_first=True)
        return np.concatenate([x[:7], turn, [0.24, driver.NAIL_Y + x[7], 0.11], np.zeros(4)])

    seen = driver.measured(frame(2), frame(1), frame(0), sent)
    assert seen[14] >= 0
    turn = frame(0)[7:11] * np.sign(frame(0)[7])
    parts = place[:3], sent, speed[:3], 0.1 * place[3:4], 0.1 * speed[3:4], place[4:7], turn, speed[4:7], spin
    np.testing.assert_allclose(seen, np.concatenate([*parts, place[7:], speed[7:]]), rtol=1e-3)


def test_the_nails_place_is_that_of_the_driver(driver):
    """It names the middle of a head of 18 mm, the task its front."""
    np.testing.assert_allclose(task.NAIL[1], driver.NAIL_Y - 0.009)


@pytest.mark.slow
@pytest.mark.parametrize("impl", ["jax", *(["warp"] if engine_warp.available() else [])])
def test_engines_agree(rig, impl):
    """One period from each state of a scripted episode: two millimetres where the face meets the block, typically far
    less.
    """
    apart, state = periods_apart(rig, rig_of(impl), strike, steps=60, key=KEY)
    errors = apart[:, np.r_[0:3, 9, 11:14, 24]].max(1)
    assert state.success
    assert np.median(errors) < 1e-5 and np.max(errors) < 2e-3
