"""The twin of panda-gym's PandaPush: rotations and rewards by hand, servos and friction as Bullet has them, engines."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import make
from franka_bench import bench, member, periods_apart
from scipy.spatial.transform import Rotation

import envs
from envs.franka import panda_push
from envs.mujoco.engines import warp as engine_warp

KEY = jax.random.key(0)
NOMINAL = {p.name: p.nominal for p in panda_push.PARAMETERS}
NOMINAL["start_beside"] = 0.0
FAR = [0.3, 0.3, 0.02, *[0.0] * 9, 0.0, 0.1, 0.02]  # cube and mark out of the way


def rig_of(impl):
    env = make("panda-push", impl)
    return bench(env, envs.sample_worlds(env, KEY, 1, params=NOMINAL, effects={"obs_noise": 0.0}))


@pytest.fixture(scope="module")
def rig():
    return rig_of("c")


def play(rig, obs, actions):
    """[T, 21] what is seen after each action from a state that is seen as `obs` [21]."""
    world, seen = member(rig.worlds, 0), []
    state = rig.env.restore(world, jnp.asarray(obs, jnp.float32), KEY)
    for action in actions:
        state = rig.step(world, state, jnp.asarray(action, jnp.float32), KEY)
        assert not state.invalid
        seen.append(np.asarray(state.true_obs))
    return np.array(seen)


def test_angles_are_those_of_scipy_and_back():
    for seed in range(5):
        turn = Rotation.random(rng=np.random.default_rng(seed))
        quaternion = jnp.asarray(turn.as_quat(scalar_first=True), jnp.float32)
        angles = panda_push.euler(quaternion)
        np.testing.assert_allclose(angles, turn.as_euler("xyz"), atol=1e-5)  # about fixed axes
        back = panda_push._quaternion(angles)
        np.testing.assert_allclose(back * jnp.sign(back @ quaternion), quaternion, atol=1e-6)


def seen(tip, cube, mark):
    return jnp.concatenate([jnp.array([*tip, 0, 0, 0, *cube]), jnp.zeros(9), jnp.array(mark)])


@pytest.mark.parametrize(
    ("tip", "cube", "mark", "wanted"),
    [
        # 10 cm to go along x; the tip is 2 cm from its place, 2 cm behind the cube: 1 - tanh(0.5) - tanh(0.2) / 2
        ((-0.04, 0.0, 0.02), (0.0, 0.0, 0.02), (0.1, 0.0, 0.02), 0.439195),
        # in front of it, 6 cm from that place
        ((0.04, 0.0, 0.02), (0.0, 0.0, 0.02), (0.1, 0.0, 0.02), 0.269358),
        # 3 cm above the place of a cube that has 20 cm to go along -y
        ((0.1, 0.22, 0.05), (0.1, 0.2, 0.02), (0.1, 0.0, 0.02), 0.092750),
        # 2.5 cm from the mark: the place is half as far behind, 1 cm from the tip
        ((-0.02, 0.0, 0.02), (0.0, 0.0, 0.02), (0.025, 0.0, 0.02), 0.825813),
        ((0.0, 0.0, 0.02), (0.0, 0.0, 0.02), (0.0, 0.0, 0.02), 1.0),
    ],
)
def test_rewards_by_hand(tip, cube, mark, wanted):
    obs = seen(tip, cube, mark)
    np.testing.assert_allclose(panda_push.reward(obs * 0, jnp.zeros(3), obs), wanted, atol=1e-6)


def test_success_is_less_than_five_centimetres_in_space():
    def at(*cube):
        return bool(panda_push.success(seen((0, 0, 0), cube, (0.1, 0.0, 0.02))))

    assert at(0.051, 0.0, 0.02) and not at(0.049, 0.0, 0.02)
    assert not at(0.1, 0.0, 0.08)  # above the mark


@pytest.mark.heavy
def test_fingers_that_start_beside_the_cube_do_not_touch_it():
    cube, keys = jnp.array([0.1, -0.05]), jax.random.split(KEY, 1000)
    off = jax.jit(jax.vmap(lambda key: panda_push.beside(cube, key)))(keys) - jnp.append(cube, 0.0)[None]
    reach = np.abs(off[:, :2]) - np.array(panda_push.FINGER_HALF[:2]) - panda_push.CUBE_HALF
    assert (reach.max(1) > 0).all() and (off[:, 2] > panda_push.TABLE_AT).all()
    assert all((np.sign(off[:, :2]) == corner).all(1).any() for corner in [(1, 1), (1, -1), (-1, 1), (-1, -1)])
    params = jnp.array([{**NOMINAL, "start_beside": 0.5}[p.name] for p in panda_push.PARAMETERS])
    starts = jax.jit(jax.vmap(lambda key: panda_push.initial(params, key).qpos[2]))(keys)
    assert 0.4 < (starts == np.float32(panda_push.START[2])).mean() < 0.6


@pytest.mark.slow
def test_starts_fill_the_square_and_the_mark_stays(rig):
    states = jax.vmap(lambda key: rig.env.reset(member(rig.worlds, 0), key).true_obs)(jax.random.split(KEY, 2000))
    for place in (slice(6, 8), slice(18, 20)):
        np.testing.assert_allclose(np.abs(states[:, place]).max(0), 0.15, atol=1e-3)
    assert abs(np.corrcoef(states[:, 6], states[:, 18])[0, 1]) < 0.1  # drawn apart
    np.testing.assert_allclose(states[:, :3], np.tile(panda_push.START, (2000, 1)), atol=1e-6)
    moved = play(rig, states[0], np.ones((5, 3)))
    np.testing.assert_allclose(moved[:, 18:], np.tile(states[0, 18:], (5, 1)), atol=1e-6)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("action", "axis", "first", "second"),
    [((1, 0, 0), 0, 0.0275, 0.0539), ((0, 1, 0), 1, 0.0268, 0.0777), ((0, 0, -1), 2, 0.0279, 0.0875)],
)
def test_servos_move_about_as_far_as_bullets_arm(rig, action, axis, first, second):
    """One and two periods of a full action from rest, as measured of panda-gym 3.0.7; to 20 %."""
    found = play(rig, [*panda_push.START, 0, 0, 0, *FAR], [action, action])
    moved = np.abs(found[:, axis] - panda_push.START[axis])
    np.testing.assert_allclose(moved, [first, second], rtol=0.2)
    others = [i for i in range(3) if i != axis]
    np.testing.assert_allclose(found[:, others], np.tile(panda_push.START[others], (2, 1)), atol=3e-3)  # its weight


def test_the_table_holds_the_fingers(rig):
    found = play(rig, [*panda_push.START, 0, 0, 0, *FAR], [(0.0, 0.0, -1.0)] * 8)
    assert found[:, 2].min() > panda_push.TABLE_AT - 3e-3  # at 1.4 m/s
    np.testing.assert_allclose(found[-1, 2], panda_push.TABLE_AT, atol=1e-3)


def test_a_cube_slides_as_far_as_friction_says_and_does_not_trip(rig):
    """v^2 / (2 mu g) = 0.49 / 4.905 m; Bullet's does the same (0.0721 m from 0.6 m/s)."""
    for speed in (0.6, 0.7):
        obs = [*panda_push.START, 0, 0, 0, -0.2, 0.3, 0.02, 0, 0, 0, speed, 0, 0, 0, 0, 1.0, 0, 0, 0.02]
        found = play(rig, obs, np.zeros((10, 3)))
        np.testing.assert_allclose(found[-1, 6] + 0.2, speed**2 / (2 * 0.25 * 9.81), rtol=0.05)
        assert np.abs(found[:, 9:11]).max() < 0.06 and np.abs(found[:, 8] - 0.02).max() < 1e-3


def test_an_observation_tells_what_the_next_step_does(rig):
    """All but the servos' last command, which the next one replaces: to a tenth of a millimetre while it pushes."""
    world = member(rig.worlds, 0)
    start = [0.0, -0.05, 0.02, 0, 0.2, 0, 0.005, 0.0, 0.02, 0, 0, 0.3, 0, 0, 0, 0, 0, 0, 0.1, 0.1, 0.02]
    state = rig.env.restore(world, jnp.asarray(start), KEY)
    np.testing.assert_allclose(state.true_obs, start, atol=1e-6)
    for _ in range(6):
        again = rig.env.restore(world, state.true_obs, KEY)
        np.testing.assert_allclose(again.true_obs, state.true_obs, atol=2e-5)
        action = jnp.array([0.1, 0.4, 0.0])
        state, other = (rig.step(world, s, action, KEY) for s in (state, again))
        np.testing.assert_allclose(other.true_obs[:9], state.true_obs[:9], atol=1e-4)
    assert np.linalg.norm(state.true_obs[6:8] - np.array(start[6:8])) > 0.05


def push(obs):
    """[3]: go round the cube above it, come down behind it, push it slowly to the mark."""
    tip, cube, way = obs[:3], obs[6:9], (obs[18:21] - obs[6:9])[:2]
    away = np.linalg.norm(way)
    if away < 0.03:
        return np.zeros(3)
    ahead = way / away
    aside, behind, off = np.array([-ahead[1], ahead[0]]), cube[:2] - 0.06 * ahead, (tip - cube)[:2]
    if abs(off @ aside) < 0.02 and off @ ahead < 0 and tip[2] < 0.035:
        move = [*(0.03 * ahead - aside * (off @ aside)), 0.02 - tip[2]]
    else:
        over = np.linalg.norm(tip[:2] - behind) > 0.02
        move = [*(behind - tip[:2]), (0.08 if over else 0.02) - tip[2]]
    return np.clip(np.array(move) / 0.05, -1.0, 1.0)


@pytest.mark.heavy
def test_a_script_pushes_the_cube_to_the_mark(rig):
    world, done = member(rig.worlds, 0), []
    for seed in range(12):
        state = rig.reset(world, jax.random.key(seed))
        for _ in range(rig.env.episode_length):
            state = rig.step(world, state, jnp.asarray(push(np.asarray(state.true_obs)), jnp.float32), KEY)
        done.append(bool(state.success))
    assert state.truncated and not state.terminated
    assert sum(done) >= 7  # of a fingertip that stays where it is: one


@pytest.mark.slow
@pytest.mark.parametrize("impl", ["jax", *(["warp"] if engine_warp.available() else [])])
def test_engines_agree(rig, impl):
    """One period from each state of a pushing episode. Where fingers slide along the cube, the solver's few iterations
    leave more than rounding, in three of forty periods at most, but less than the time step costs (docs/physics.md).
    """
    apart, _ = periods_apart(rig, rig_of(impl), push, steps=40, key=jax.random.key(3))
    places, speeds = apart[:, [0, 1, 2, 6, 7, 8]].max(1), apart[:, 3:6].max(1)
    assert np.median(places) < 1e-5 and np.mean(places) < 2e-4
    assert np.median(speeds) < 1e-4 and np.mean(speeds) < 1.5e-3
    assert np.sort(places)[-4] < 5e-4 and np.max(places) < 2.5e-3
    assert np.sort(speeds)[-4] < 3e-3 and np.max(speeds) < 0.03
