"""dm_control as foreign oracle: walker-walk and cheetah-run move, look and pay alike, with the masses of Du et al."""

import functools
import warnings

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from envs.control import suite
from envs.gaps import find
from envs.locomotion import cheetah_run, cheetah_run_du, walker_walk, walker_walk_du
from envs.mujoco.worlds import PhysicsState

TASKS = {"walker": walker_walk, "cheetah": cheetah_run}
DU = {"walker": walker_walk_du, "cheetah": cheetah_run_du}
PLAIN, STEPS = {"mass": 1.0, "even": 0.0}, 200
ORDER = {"walker": [1, 0, *range(2, 9)], "cheetah": list(range(9))}  # where ours has the suite's coordinates
RAISED = {"walker": walker_walk.HEIGHT, "cheetah": 0.0}  # m: our height where the suite's is 0
SUBSTEPS = {"walker": 10, "cheetah": 1}  # of a frame


@pytest.fixture(params=TASKS)
def name(request):
    return request.param


def oracle(name):
    dm_control = pytest.importorskip("dm_control.suite", reason="make setup EXTRAS=dev")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return dm_control.load(name, {"walker": "walk", "cheetah": "run"}[name], task_kwargs={"random": 0})


def state_of(data):
    return PhysicsState(*(jnp.asarray(x, jnp.float32) for x in (data.qpos, data.qvel, data.qvel, data.ctrl)))


def place(name, data, physics):
    """Our model in the state of the suite's."""
    data.qpos[:] = physics.data.qpos[ORDER[name]]
    data.qpos[1] += RAISED[name]
    data.qvel[:] = physics.data.qvel[ORDER[name]]
    data.qacc_warmstart[:] = physics.data.qacc_warmstart[ORDER[name]]


def seen(name, observation):
    """The suite's observation in our order."""
    if name == "cheetah":
        return np.concatenate([observation["position"], observation["velocity"]])
    speeds = observation["velocity"][ORDER[name]]
    return np.concatenate([observation["orientations"], [observation["height"]], speeds])


@pytest.mark.filterwarnings("ignore")
def test_moves_looks_and_pays_like_dm_control(name):
    task, theirs = TASKS[name], oracle(name)
    model = task.SCENE.build(PLAIN).compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    np.testing.assert_allclose(model.body_mass, theirs.physics.model.body_mass, rtol=1e-6)
    np.testing.assert_allclose(model.dof_armature, theirs.physics.model.dof_armature[ORDER[name]])
    look = jax.jit(functools.partial(task.observe, jnp.zeros(2)))
    pay = jax.jit(functools.partial(task.frame_reward, jnp.asarray(model.body_mass[1:])))
    theirs.reset()
    touched, paid = 0, []
    for i in range(STEPS):
        if i % 5 == 0:
            action = rng.uniform(-1, 1, 6)
        place(name, data, theirs.physics)
        data.ctrl[:] = action
        mujoco.mj_step(model, data, SUBSTEPS[name])
        step = theirs.step(action)
        touched += data.ncon
        obs = look(state_of(data))
        np.testing.assert_allclose(obs, seen(name, step.observation), rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(pay(obs), step.reward, atol=1e-4)
        paid.append(step.reward)
    assert touched > STEPS / 4 and max(paid) > 0.02


@pytest.mark.filterwarnings("ignore")
def test_the_same_links_touch(name):
    """In any posture, also links that touch each other."""
    theirs, model = oracle(name).physics, TASKS[name].SCENE.build(PLAIN).compile()
    data, rng, each_other = mujoco.MjData(model), np.random.default_rng(0), 0
    for _ in range(300):
        with theirs.reset_context():
            theirs.data.qpos[:3] = 0.0
            theirs.data.qpos[3:] = rng.uniform(*theirs.model.jnt_range[3:].T)
        place(name, data, theirs)
        mujoco.mj_forward(model, data)
        assert data.ncon == theirs.data.ncon
        np.testing.assert_allclose(np.sort(data.contact.dist), np.sort(theirs.data.contact.dist), atol=1e-6)
        each_other += (model.geom_bodyid[data.contact.geom].min(axis=-1, initial=99) > 0).sum()
    assert (each_other > 0) == (name == "cheetah")


def test_a_step_pays_for_all_of_its_frames(name):
    """Straight from one end of a step to the other: 2 % of an episode's reward at most."""
    task = TASKS[name]
    model = task.SCENE.build(PLAIN).compile()
    data, rng, masses = mujoco.MjData(model), np.random.default_rng(0), jnp.asarray(model.body_mass[1:])
    start = task.initial(jnp.zeros(2), jax.random.key(0))
    data.qpos[:], data.qvel[:] = start.qpos, start.qvel
    step = jax.jit(task.SCENE.reward)
    frame = jax.jit(lambda state: task.frame_reward(masses, task.observe(jnp.zeros(2), state)))
    total, exact = 0.0, 0.0
    for i in range(STEPS):
        data.ctrl[:] = rng.uniform(-1, 1, 6) if i % 4 == 0 else data.ctrl
        before = task.observe(jnp.zeros(2), state_of(data))
        for _ in range(task.REPEAT):
            mujoco.mj_step(model, data, SUBSTEPS[name])
            exact += float(frame(state_of(data)))
        total += float(step(before, jnp.zeros(6), task.observe(jnp.zeros(2), state_of(data))))
    assert exact > 2.0
    np.testing.assert_allclose(total, exact, rtol=0.02)


def test_masses_are_those_of_du_et_al(name):
    """kg, from their code: every link has one; in training twice that and half as much more or less."""
    torso = {"walker": 10.3138485, "cheetah": 6.3603134}[name]
    scene = DU[name].SCENE
    (real,) = (find(scene.name, "du").params,)
    nominal = {p.name: p.nominal for p in scene.parameters}
    low, high = (
        {p.name: value for p, value in zip(scene.parameters, row, strict=True)}
        for row in zip(*((p.low, p.high) for p in scene.parameters), strict=True)
    )
    for theta, wanted in ((nominal | dict(real), torso), (nominal, 2 * torso), (low, torso), (high, 3 * torso)):
        np.testing.assert_allclose(scene.build(theta).compile().body_mass[1:], wanted, rtol=1e-5)


def test_doubled_masses_keep_their_inertias(name):
    plain, heavy = (TASKS[name].SCENE.build(PLAIN | {"mass": mass}).compile() for mass in (1.0, 2.0))
    np.testing.assert_allclose(heavy.body_mass, 2 * plain.body_mass, rtol=1e-6)
    np.testing.assert_allclose(heavy.body_inertia, plain.body_inertia)
    assert find(TASKS[name].SCENE.name, "x2").params == {"mass": 2}


def test_speed_is_that_of_the_walker_as_it_is(name):
    """The centre of mass of links that all weigh the same, which MuJoCo knows."""
    task, theta = TASKS[name], {"mass": 1.5, "even": 1.0}
    model = task.SCENE.build(theta).compile()
    data, rng = mujoco.MjData(model), np.random.default_rng(1)
    data.qpos[:] = rng.uniform(-1, 1, 9)
    data.qpos[1], data.qvel[:] = 1.5, rng.normal(size=9)
    data.qvel[0] = 1.0
    mujoco.mj_forward(model, data)
    mujoco.mj_subtreeVel(model, data)
    masses = suite.masses_of(task.SCENE.build(PLAIN).compile(), task.ALIKE, jnp.array([1.5, 1.0]))
    state, speed = state_of(data), float(data.subtree_linvel[1][0])
    assert 0.1 < speed < task.SPEED
    paid = float(task.frame_reward(masses, task.observe(jnp.zeros(2), state)))
    if name == "cheetah":
        np.testing.assert_allclose(paid, speed / task.SPEED, rtol=1e-4)
    else:
        upright = (3 + (1 + np.cos(data.qpos[2])) / 2) / 4
        np.testing.assert_allclose(paid, upright * (5 * min(speed, 1.0) + 1) / 6, rtol=1e-4)


def test_an_observation_tells_the_state(name):
    task = TASKS[name]
    for key in jax.random.split(jax.random.key(0), 5):
        start = task.initial(jnp.zeros(2), key)
        start = start._replace(qvel=jax.random.normal(key, (9,)))
        obs = task.observe(jnp.zeros(2), start)
        told = task.SCENE.settled(jnp.zeros(2), obs)
        np.testing.assert_allclose(task.observe(jnp.zeros(2), told), obs, atol=1e-5)
        np.testing.assert_allclose(told.qpos[3:], start.qpos[3:], atol=1e-5)
