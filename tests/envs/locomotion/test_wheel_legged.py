"""The wheel-legged robot: physics by hand, engines, rewards, measures; and its operator."""

import c_reference
import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import scipy.linalg
from compiled import make
from runners import member, pool_of

import envs
from envs import gaps
from envs.locomotion import wheel_forward, wheel_legged
from envs.locomotion.wheel_legged import Hand, nominal_gain, operator
from envs.mujoco.engines import warp as engine_warp

KEY = jax.random.key(0)
NAMES = (gaps.SIM, *gaps.presets("wheel-legged"))
NOMINAL = {p.name: p.nominal for p in wheel_legged.PARAMETERS}
SLOWER = ["jax", *(["warp"] if engine_warp.available() else [])]
ENGINES = ["c", *(pytest.param(impl, marks=pytest.mark.slow) for impl in SLOWER)]


def by_hand(theta):
    """Of the body its mass (kg), distance of its centre from the axle (m) and angle forwards (rad); (a, b, c).

    The mass matrix of x and pitch is [[a, b cos], [b cos, c]].
    """
    mass, height, ahead = theta["mass"] - 1.5, theta["com_height"], theta["com_x"]
    arm = np.hypot(height, ahead)
    inertia = mass * (0.2**2 + 0.3**2) / 12  # a box of 20 x 30 cm
    a = theta["mass"] + 1.5 / 2  # discs that roll add half of their mass
    return mass, arm, np.arctan2(ahead, height), (a, mass * arm, inertia + mass * arm**2)


def acceleration(theta, qpos, qvel, torque, rolling=0.0):
    """m/s^2, rad/s^2 of an inverted pendulum on wheels; Lagrange. rolling: N against x."""
    mass, arm, lean, (a, b, c) = by_hand(theta)
    angle, spin = qpos[1] + lean, qvel[1]
    push = torque / 0.065 - rolling + b * np.sin(angle) * spin**2
    turn = mass * 9.81 * arm * np.sin(angle) - torque
    return np.linalg.solve([[a, b * np.cos(angle)], [b * np.cos(angle), c]], [push, turn])


@pytest.mark.parametrize("name", NAMES)
def test_the_motion_is_that_of_an_inverted_pendulum(name):
    """Rolling friction of 1e-9 N m leaves only the motion; that of the gap then is a force at the wheel's rim."""
    theta = NOMINAL | gaps.find("wheel-legged", name).params
    rng = np.random.default_rng(0)
    smooth, rough = (
        wheel_legged.build(theta | {"wheel_friction": f}).compile() for f in (1e-9, theta["wheel_friction"])
    )
    np.testing.assert_allclose(smooth.body_mass.sum(), theta["mass"])
    for _ in range(5):
        qpos, qvel, action = rng.normal(size=2) * [1, 0.2], rng.normal(size=2) * [1, 2], rng.uniform(-1, 1)
        qvel[0] = abs(qvel[0]) + 0.2
        for model, rolling in ((smooth, 0.0), (rough, theta["wheel_friction"] / 0.065)):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:], data.ctrl[:] = qpos, qvel, action
            mujoco.mj_forward(model, data)
            wanted = acceleration(theta, qpos, qvel, 3.0 * action, rolling)
            np.testing.assert_allclose(data.qacc, wanted, atol=1e-5)


def test_motors_lag():
    """With 0.02 s, after k periods of 5 ms a step has come to 1 - exp(-k / 4); without, at once."""
    params = jnp.array([{**NOMINAL, "motor_lag": 0.02}[p.name] for p in wheel_legged.PARAMETERS])
    control, seen = jnp.zeros(1), []
    for _ in range(4):
        control = wheel_legged.follow(params, control, jnp.ones(1))
        seen.append(float(control[0]))
    np.testing.assert_allclose(seen, 1 - np.exp(-np.arange(1, 5) / 4), rtol=1e-5)
    assert float(wheel_legged.follow(params.at[-1].set(0.0), jnp.zeros(1), jnp.full(1, 0.7))[0]) == np.float32(0.7)


@pytest.mark.heavy
def test_the_lag_of_a_gap_reaches_the_motors():
    env = make("wheel-legged", "c")
    pool = pool_of(env, [gaps.SIM, "lag"])
    states = jax.vmap(env.reset)(pool, jax.random.split(KEY, 2))
    after = jax.vmap(env.step, (0, 0, None, None))(pool, states, jnp.full(1, -0.5), KEY)
    np.testing.assert_allclose(after.physics.ctrl[:, 0], [-0.5, -0.5 * (1 - np.exp(-5 / 30))], rtol=1e-5)


def test_rewards_by_hand():
    """x 0.3 m, v 0.5 m/s, pitch 0.1 rad, its speed -2 rad/s, torque 3 * -0.4 = -1.2 N m; commands stop at 1."""
    obs = jnp.array([0.3, 0.5, 0.1, -2.0])
    action = jnp.array([-0.4])
    np.testing.assert_allclose(wheel_legged.reward(obs * 0, action, obs), 30 - 0.09 - 0.25 - 0.01 - 4 - 1.44, rtol=1e-6)
    np.testing.assert_allclose(wheel_forward.reward(obs[1:] * 0, action, obs[1:]), 15 - 0.09 - 1.44, rtol=1e-6)
    np.testing.assert_allclose(wheel_forward.reward(obs[1:], jnp.array([7.0]), obs[1:] * 0), 15 - 0.04 - 9, rtol=1e-6)


@pytest.mark.parametrize(("degrees", "fallen"), [(0.0, False), (29.9, False), (30.1, True), (-30.1, True)])
def test_it_has_fallen(degrees, fallen):
    obs = jnp.array([0.0, 0.0, np.radians(degrees), 0.0])
    assert bool(wheel_legged.terminated(obs * 0, jnp.zeros(1), obs)) == fallen
    assert bool(wheel_forward.terminated(obs[1:] * 0, jnp.zeros(1), obs[1:])) == fallen


def gain(theta):
    """[4] of the linear-quadratic controller: action = -gain . (x, v, pitch, its speed)."""
    mass, arm, _, (a, b, c) = by_hand(theta)
    inverse = np.linalg.inv([[a, b], [b, c]])
    dynamics, control = np.zeros((4, 4)), np.zeros((4, 1))
    dynamics[:2, 2:] = np.eye(2)
    dynamics[2:, :2] = inverse @ [[0, 0], [0, mass * 9.81 * arm]]
    control[2:] = 3.0 * inverse @ [[1 / 0.065], [-1]]
    cost = scipy.linalg.solve_continuous_are(dynamics, control, np.eye(4), np.array([[9.0]]))
    return jnp.asarray((control.T @ cost / 9.0)[0][[0, 2, 1, 3]], jnp.float32)


def episodes(env, names, act):
    """One episode [gaps] in each of them."""

    def play(pool, key):
        return envs.play_episode(env, member(pool, None), act, (), key, gamma=1.0)

    return jax.jit(jax.vmap(play))(pool_of(env, names), jax.random.split(KEY, len(names)))


@pytest.mark.slow
def test_a_linear_controller_stands_in_every_gap_and_nothing_falls():
    """That of the nominal robot. Where the centre of mass is ahead or the floor is rough, it does not stay in place."""
    env, feedback = make("wheel-legged", "c"), gain(NOMINAL)

    def steady(carry, obs, key):
        return jnp.clip(-feedback @ obs, -1.0, 1.0)[None], carry

    stood = episodes(env, NAMES, steady)
    assert (stood.valid.sum(1) == env.episode_length).all() and not stood.exploded.any()
    away = dict(zip(NAMES, np.abs(stood.transitions.next_obs[:, 1000:, 0]).max(1), strict=True))
    assert away[gaps.SIM] < 0.05 and away["leaning"] > 0.5 and away["robot"] > 0.2  # m; H2O+ calls 0.2 standing still
    still = episodes(env, [gaps.SIM] * 4, lambda carry, obs, key: (jnp.zeros(1), carry))
    last = still.valid.sum(1) - 1
    assert (last < 400).all()  # 2 s
    assert (still.transitions.discount[jnp.arange(4), last] == 0.0).all()


@pytest.mark.slow
def test_it_can_roll_forward():
    env, feedback = make("wheel-legged-forward", "c"), gain(NOMINAL)[1:]
    aim = jnp.array([wheel_forward.SPEED, 0.0, 0.0])

    def roll(carry, obs, key):
        return jnp.clip(-feedback @ (obs - aim), -1, 1)[None], carry

    rolled = episodes(env, [gaps.SIM] * 4, roll)
    assert (rolled.valid.sum(1) == env.episode_length).all()
    np.testing.assert_allclose(rolled.transitions.next_obs[:, 1000:, 0], wheel_forward.SPEED, atol=0.03)
    assert (rolled.total_reward > 14.9 * env.episode_length).all()


@pytest.mark.heavy
@pytest.mark.parametrize("impl", ENGINES)
def test_every_engine_moves_it_like_mujoco(impl):
    """A micrometre and a microradian after a period, in every gap, under torques that change."""
    env, c = make("wheel-legged", impl), make("wheel-legged", "c")
    pool = pool_of(c, NAMES)
    states = jax.vmap(c.reset)(pool, jax.random.split(KEY, len(NAMES)))
    steps = [jax.jit(jax.vmap(e.step, (0, 0, 0, None))) for e in (env, c)]
    models = [wheel_legged.build(NOMINAL | gaps.find("wheel-legged", name).params).compile() for name in NAMES]
    actions = np.random.default_rng(0).uniform(-1, 1, (10, len(NAMES), 1)).astype(np.float32)
    for action in actions:
        with jax.numpy_rank_promotion("allow"):  # MJX broadcasts matrices against vectors
            seen, after = (step(pool, states, action, KEY) for step in steps)
        for i, model in enumerate(models):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = states.physics.qpos[i], states.physics.qvel[i]
            data.ctrl[:] = after.physics.ctrl[i]
            mujoco.mj_step(model, data, wheel_legged.SUBSTEPS)
            np.testing.assert_allclose(seen.physics.qpos[i], data.qpos, atol=1e-6)
            np.testing.assert_allclose(seen.physics.qvel[i], data.qvel, atol=1e-4)
        states = after


def test_the_time_step_is_fine_enough():
    """0.4 s of a fall under changing torques end as with a step a tenth as long, to 1 cm and 1 % of the pitch."""
    start = wheel_legged.state_of(jnp.array([0.0, 0.02]), jnp.zeros(2))
    actions = jnp.sin(jnp.arange(80) / 5.0)[:, None] * 0.5
    own, fine = (
        c_reference.play(wheel_legged.SCENE, NOMINAL, start, actions, refine=n, iterations=20)[-1].qpos for n in (1, 10)
    )
    np.testing.assert_allclose(own, fine, atol=1e-2, rtol=1e-2)


@pytest.mark.heavy
@pytest.mark.parametrize("task", ["wheel-legged", "wheel-legged-forward"])
def test_starts_and_states_that_are_seen_again(task):
    env = make(task, "c")
    world = member(pool_of(env, [gaps.SIM]), 0)
    states = jax.vmap(lambda key: env.reset(world, key))(jax.random.split(KEY, 500))
    wide = np.abs(np.concatenate([states.physics.qpos, states.physics.qvel], axis=1)).max(0)
    np.testing.assert_allclose(wide, wheel_legged.START, rtol=0.02)
    state = env.step(world, member(states, 0), jnp.zeros(1), KEY)
    again = env.restore(world, state.obs, KEY)
    np.testing.assert_array_equal(again.true_obs, state.true_obs)
    one, other = (env.step(world, s, jnp.full(1, 0.3), KEY).true_obs for s in (state, again))
    np.testing.assert_allclose(one, other, atol=1e-6)
    late = env.step(world, state._replace(time=jnp.int32(env.episode_length - 1)), jnp.zeros(1), KEY)
    assert late.truncated and not late.terminated and not state.truncated


def test_seconds_upright_and_in_place():
    """The first robot drifts beyond 0.2 m in its third step and comes back; the second falls in its fourth."""
    x = [[0.0, 0.19, -0.21, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0, 0.0]]
    pitch = np.radians([[0.0, 29.0, -29.0, 0.0, 0.0], [0.0, 0.0, 0.0, -31.0, 0.0]])
    obs = np.zeros((2, 5, 4))
    obs[..., 0], obs[..., 2] = x, pitch
    valid = np.array([[True] * 5, [True] * 4 + [False]])  # the step of the fall is the last that counts
    measured = wheel_legged.measures(obs, valid)
    assert measured["upright_s"].tolist() == pytest.approx([5 * wheel_legged.CONTROL_DT, 3 * wheel_legged.CONTROL_DT])
    assert measured["in_place_s"].tolist() == pytest.approx([2 * wheel_legged.CONTROL_DT, 3 * wheel_legged.CONTROL_DT])


def test_the_error_of_the_speed_counts_while_it_is_upright():
    """0.3 and 0.1 m/s are 0.1 off. A robot that falls at once is judged by its first step."""
    obs = np.zeros((2, 3, 3))
    obs[..., 0] = [[0.3, 0.1, 9.0], [-0.8, 5.0, 5.0]]
    obs[..., 1] = [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]
    valid = np.array([[True, True, True], [True, False, False]])
    measured = wheel_forward.measures(obs, valid)
    assert measured["upright_s"].tolist() == pytest.approx([2 * wheel_legged.CONTROL_DT, 0.0])
    assert measured["speed_error"].tolist() == pytest.approx([0.1, 1.0])


def test_the_gain_is_that_of_the_riccati_equation():
    """For the upright robot of Lagrange's equations: it is stable, and Kalman's identity holds at every frequency.

    |1 + K (iw - A)^-1 B|^2 = 1 + |Q^(1/2) (iw - A)^-1 B|^2 for one input of cost 1 is true of optimal gains alone.
    """
    mass, arm, _, (a, b, c) = by_hand(NOMINAL)
    gain = nominal_gain()
    inverse = np.linalg.inv([[a, b], [b, c]])
    turn, push = inverse @ [0.0, mass * 9.81 * arm], inverse @ [1 / 0.065, -1.0]
    drift = np.array([[0, 1, 0, 0], [0, 0, turn[0], 0], [0, 0, 0, 1], [0, 0, turn[1], 0]])
    closed = drift - np.outer([0, push[0], 0, push[1]], gain)
    assert (np.linalg.eigvals(closed).real < -0.5).all()
    for frequency in (0.1, 1.0, 3.0, 10.0, 30.0):  # rad/s
        state = np.linalg.solve(1j * frequency * np.eye(4) - drift, [0, push[0], 0, push[1]])
        cost = np.vdot(state, np.array([4.0, 1.0, 1.0, 1.0]) * state).real
        np.testing.assert_allclose(abs(1 + gain @ state) ** 2, 1 + cost, rtol=1e-6)


def test_the_aim_moves_and_noise_has_the_spread_that_it_says(key):
    """After 5 s at 0.2 m/s the aim is 1 m ahead; over many starts wander and shake have their stationary spread."""
    policy = operator(0.2)

    def step(carry, key):
        return policy.act(jnp.zeros(4), carry, jnp.zeros(4), key, explore=True)[1], None

    def play(start, key):
        return jax.lax.scan(step, start, jax.random.split(key, 1000))[0]

    draw = np.random.default_rng(0).normal(size=(2, 400))
    start = Hand(jnp.zeros(400), 0.2 * jnp.asarray(draw[0], jnp.float32), 0.65 * jnp.asarray(draw[1], jnp.float32))
    end = jax.jit(jax.vmap(play))(start, jax.random.split(key, 400))
    np.testing.assert_allclose(end.aim, 1.0, rtol=1e-4)
    np.testing.assert_allclose([end.wander.std(), end.shake.std()], [0.2, 0.65], rtol=0.1)
    # it forgets: over 5 s of a memory of 15 s the correlation is exp(-1/3) = 0.72, over 60 memories of a shake none
    np.testing.assert_allclose(np.corrcoef(start.wander, end.wander)[0, 1], 0.72, atol=0.08)
    assert abs(np.corrcoef(start.shake, end.shake)[0, 1]) < 0.15


def test_an_action_is_the_torque_over_its_bound(key):
    """At x = 0.1 m ahead of a place that does not shake or wander yet, the torque is -gain[0] * 0.1 N m."""
    gain = jnp.asarray(nominal_gain(), jnp.float32)
    still = operator(0.0)
    quiet = Hand(jnp.zeros(()), jnp.zeros(()), jnp.zeros(()))
    acts = jax.vmap(lambda key: still.act(gain, quiet, jnp.array([0.1, 0.0, 0.0, 0.0]), key, explore=True)[0])
    found = acts(jax.random.split(key, 20_000))[:, 0]
    np.testing.assert_allclose(found.mean(), -gain[0] * 0.1 / 3, atol=3e-3)
    assert float(still.act(gain, quiet, jnp.array([0.0, 0.0, 1.0, 0.0]), key, explore=True)[0][0]) == 1.0
