"""A task that has nothing of ours: a ball is driven into a wall, with a touch sensor, an early end and its own camera.

It goes through every engine that is here.
"""

import os

import c_reference as reference
import jax
import jax.numpy as jnp
import mediapy
import mujoco
import numpy as np
import pytest
from compiled import compiled

import envs
from envs.base import Entry, Parameter
from envs.franka import push
from envs.mujoco import render
from envs.mujoco.engines import mjx as engine_jax
from envs.mujoco.engines import warp as engine_warp
from envs.mujoco.scene import Measured, Scene, View, make_env
from envs.mujoco.worlds import PhysicsState
from envs.types import UserError
from experiments.runner.pictures import select_renderer

WALL = 0.2  # m
MJCF = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast" gravity="0 0 0"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body>
      <joint name="x" type="slide" axis="1 0 0" damping="2"/><joint name="z" type="slide" axis="0 0 1" stiffness="9"/>
      <geom name="ball" type="sphere" size="0.05" mass="1" rgba="0.9 0.2 0.1 1"/>
      <site name="skin" size="0.06" rgba="0 0 0 0"/>
    </body>
    <geom name="wall" type="box" pos="0.3 0 0" size="0.1 1 1" rgba="0.2 0.3 0.9 1"/>
  </worldbody>
  <contact><pair geom1="ball" geom2="wall" condim="1"/></contact>
  <actuator>
    <motor joint="x" gear="4"/>
    <position joint="z" kp="40" kv="5" gear="2" forcelimited="true" forcerange="-1 1"/>
  </actuator>
  <sensor><touch site="skin"/><jointvel joint="x"/></sensor>
</mujoco>
"""


def build(theta):
    spec = mujoco.MjSpec.from_string(MJCF)
    spec.geom("ball").mass = theta["mass"]
    return spec


def observe(params, state):
    touch, speed = state.sensordata
    return {"x": state.qpos[:1], "touch": touch[None], "speed": speed[None]}


SCENE = Scene(
    name="bump",
    observation=(Entry("x", "m", 1), Entry("touch", "N", 1), Entry("speed", "m/s", 1)),
    action=(Entry("force", "4 N", 1), Entry("lift", "0.3 m", 1)),
    parameters=(Parameter("mass", "kg", 1.0, 0.5, 2.0, minimum=0.01),),
    episode_length=30,
    control_dt=0.05,
    substeps=10,
    build=build,
    initial=lambda params, key: PhysicsState(jnp.zeros(2), jnp.array([0.1, 0.0]), jnp.zeros(2), jnp.zeros(2)),
    target=lambda qpos, action: action * jnp.array([1.0, 0.3]),
    observe=observe,
    reward=lambda obs, action, next_obs: next_obs[1],
    success=lambda obs: obs[1] > 1.0,
    success_anytime=True,
    terminated=lambda obs, action, next_obs: next_obs[1] > 1.0,
    max_speed=5.0,
    view=View((0.0, 0.0, 0.0), 1.0, 90.0, -10.0),
)
ENGINES = ["c", "jax", *(["warp"] if engine_warp.available() else [])]
ACTION = jnp.array([0.5, 0.8])


def worlds(env, *masses):
    pools = [envs.sample_worlds(env, jax.random.key(0), 1, params={"mass": mass}) for mass in masses]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *pools)


@pytest.fixture(scope="module", params=[ENGINES[0], *(pytest.param(x, marks=pytest.mark.slow) for x in ENGINES[1:])])
def played(request):
    """An episode [2] into the wall with a light and a heavy ball."""
    env = make_env(SCENE, request.param)
    pool = worlds(env, 0.6, 1.8)

    @jax.vmap
    def play(world, key):
        one = jax.tree.map(lambda x: x[None], world)
        return envs.play_episode(env, one, lambda carry, obs, key: (ACTION, carry), (), key, gamma=0.9)

    with jax.numpy_rank_promotion("allow"):  # MJX broadcasts matrices against vectors
        return env, jax.jit(play)(pool, jax.random.split(jax.random.key(1), 2))


@pytest.mark.heavy
@pytest.mark.parametrize("i", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_motion_and_sensors_are_those_of_mujoco(played, i):
    """Also where the lifting servo, geared by 2, is at its limit of force."""
    _, episodes = played
    start = SCENE.initial(jnp.zeros(1), jax.random.key(0))
    states = reference.play(SCENE, {"mass": (0.6, 1.8)[i]}, start, jnp.tile(ACTION, (30, 1)))
    n = int(episodes.valid[i].sum())
    wanted = np.array([s.qpos for s in [start, *states]])
    np.testing.assert_allclose(episodes.trace[i, : n + 1], wanted[: n + 1], atol=1e-4)
    assert wanted[n, 1] > 0.01
    sensed = np.array([s.sensordata for s in states[:n]])
    np.testing.assert_allclose(episodes.transitions.next_obs[i, :n, 1:], sensed, rtol=1e-2, atol=1e-3)
    np.testing.assert_allclose(episodes.transitions.obs[i, 0], [0.0, 0.0, 0.1], atol=1e-6)  # sensed at the start, too


@pytest.mark.heavy
def test_the_episode_ends_at_the_wall(played):
    env, episodes = played
    lengths = episodes.valid.sum(1)
    assert 5 < lengths[0] < lengths[1] < 30  # the light ball is there first
    for i, n in enumerate(lengths.tolist()):
        rows = jax.tree.map(lambda x, i=i: x[i], episodes.transitions)
        assert rows.next_obs[n - 1, 1] > 1.0 and (rows.next_obs[: n - 1, 1] <= 1.0).all()
        np.testing.assert_allclose(rows.discount[:n], [0.9] * (n - 1) + [0.0])
        np.testing.assert_allclose(episodes.trace[i, n, 0], WALL - 0.05, atol=0.02)
    assert episodes.success.all() and not episodes.exploded.any() and env.impl in ENGINES


@pytest.mark.heavy
def test_faster_than_the_scene_allows_is_an_explosion():
    env = compiled(make_env(SCENE, "c"))
    world = jax.tree.map(lambda x: x[0], worlds(env, 1.0))
    state = env.reset(world, jax.random.key(0))
    for speed, invalid in ((3.0, False), (6.0, True)):
        fast = state._replace(physics=state.physics._replace(qvel=jnp.array([-speed, 0.0])))
        assert bool(env.step(world, fast, jnp.zeros(2), jax.random.key(0)).invalid) == invalid


@pytest.mark.heavy
def test_what_observations_do_not_tell_the_simulator_measures():
    """The end and the reward as functions of parameters and physics: heavy balls may go further."""

    def measured(params, before, action, after):
        return Measured(reward=after.qpos[0] - before.qpos[0], terminated=after.qpos[0] > 0.02 * params[0])

    scene = SCENE._replace(reward=None, terminated=None, success=None, score="return", measured=measured)
    env = compiled(make_env(scene, "c"))
    assert env.reward is None and env.terminated is None and env.success is None
    pool = worlds(env, 1.0, 2.0)
    states = jax.vmap(env.reset)(pool, jax.random.split(jax.random.key(0), 2))
    ends = []
    for _ in range(12):
        before = states.physics.qpos[:, 0]
        states = jax.vmap(env.step, (0, 0, None, None))(pool, states, ACTION, jax.random.key(1))
        np.testing.assert_allclose(states.reward, states.physics.qpos[:, 0] - before, atol=1e-7)
        ends.append(states.terminated.tolist())
    first, second = (next(i for i, end in enumerate(ends) if end[k]) for k in range(2))
    assert first < second and not states.success.any()
    with pytest.raises(UserError, match="task bump measures 'terminated': then its function of observations must be"):
        double = make_env(SCENE._replace(measured=measured, reward=None), "c")
        double.step(jax.tree.map(lambda x: x[0], pool), jax.tree.map(lambda x: x[0], states), ACTION, jax.random.key(0))


def test_only_joint_servos_are_held():
    assert np.flatnonzero(engine_jax.joint_servos(build({"mass": 1.0}).compile())).tolist() == [1]
    assert np.flatnonzero(
        engine_jax.joint_servos(push.build({p.name: p.nominal for p in push.PARAMETERS}).compile())
    ).tolist() == [*range(7)]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("<motor", '<intvelocity joint="z" actrange="-1 1"/><motor', "actuators with a state of their own"),
        ("<worldbody>", '<worldbody><body mocap="true"/>', "mocap bodies"),
        ("<motor", '<motor delay="0.1" nsample="9"', "delays of actuators or sensors"),
        ("<jointvel", '<jointvel delay="0.1" nsample="9"', "delays of actuators or sensors"),
        ("<jointvel", '<jointvel interval="0.1 0"', "sensors that read the time"),
        ("<jointvel", "<clock/><jointvel", "sensors that read the time"),
        ("<worldbody>", '<size nuserdata="3"/><worldbody>', "user data"),
        ("<default>", '<option><flag sleep="enable"/></option><default>', "bodies that sleep"),
    ],
)
def test_what_no_engine_carries_is_refused(old, new, words):
    mjcf = MJCF.replace(old, new)
    with pytest.raises(UserError, match=f"scene bump has {words}"):
        make_env(SCENE._replace(build=lambda theta: mujoco.MjSpec.from_string(mjcf), parameters=()), "c")


FEATURES = {
    "IMPLICIT": ('integrator="implicitfast"', 'integrator="implicit"'),
    "PGS": ("<option", '<option solver="PGS"'),
    "USER": ("<touch", '<user dim="1"/><touch'),
    "Flex": (
        "<geom name=",
        '<flexcomp name="c" type="grid" count="2 2 1" spacing=".1 .1 .1" mass="1" dim="2" radius=".01" pos="0 3 0">'
        '<edge equality="true"/></flexcomp><geom name=',
    ),
    "BODY": ("<motor", '<adhesion body="held" gain="1" ctrlrange="0 1"/><motor'),
    "surfaces that move": ("<geom name=", '<geom surfacevel="1 0 0 0 0 0" size="1"/><geom name='),
    "geoms that stick": ("<geom name=", '<geom adhesion="1" size="1"/><geom name='),
    "higher order": ('stiffness="9"', 'stiffness="9 2 0"'),
    "around ellipsoids": ('type="sphere"', 'type="sphere" fluidshape="ellipsoid"'),
    "noslip": ("<option", '<option noslip_iterations="3"'),
    "armature of actuators": ("<motor", '<motor armature="1"'),
    "damping or armature": ("<motor", '<motor damping="1"'),
    "disabled groups": ("<option", '<option actuatorgroupdisable="0"'),
    "max_contact_points": ("<actuator>", '<custom><numeric name="max_contact_points" data="1"/></custom><actuator>'),
}


@pytest.mark.heavy
@pytest.mark.filterwarnings("ignore:flex")
@pytest.mark.parametrize("feature", FEATURES)
def test_the_c_engine_steps_what_mjx_does_not(feature, monkeypatch):
    """It never asks MJX; MJX's own code refuses in one line, also what it would leave out without a word."""
    mjcf = MJCF.replace("<body>", '<body name="held">').replace(*FEATURES[feature], 1)
    host = mujoco.MjSpec.from_string(mjcf).compile()
    scene = SCENE._replace(
        build=lambda theta: mujoco.MjSpec.from_string(mjcf),
        parameters=(),
        initial=lambda params, key: PhysicsState(*map(jnp.zeros, (host.nq, host.nv, host.nv, host.nu))),
        target=lambda qpos, action: jnp.resize(action, host.nu),
        observe=lambda params, state: {"x": state.qpos[:1], "touch": state.sensordata[:1], "speed": state.qvel[:1]},
    )
    with monkeypatch.context() as alone:
        alone.setattr(engine_jax, "put", None)
        env = make_env(scene, "c")
    theta = envs.uniform(env).sample((), jax.random.key(0), 1)
    world = jax.tree.map(lambda x: x[0], env.make_worlds(theta))
    after = env.step(world, env.reset(world, jax.random.key(0)), ACTION, jax.random.key(1)).physics
    np.testing.assert_allclose(after.qpos, stepped(host, jnp.resize(ACTION, host.nu)), atol=1e-5)
    with pytest.raises(UserError, match=rf"scene bump: .*{feature}.*--impl c"):
        make_env(scene, "jax")


def stepped(host, ctrl):
    """[nq] where MuJoCo itself is after a control period from rest."""
    data = mujoco.MjData(host)
    data.qpos[:], data.ctrl[:] = 0.0, ctrl
    for _ in range(SCENE.substeps):
        mujoco.mj_step(host, data)
    return data.qpos


def test_the_picture_shows_this_task_and_nothing_else(tmp_path, monkeypatch):
    drawn = render.dressed(SCENE, {"mass": 1.0}).compile()
    plain = build({"mass": 1.0}).compile()
    assert (drawn.ngeom, drawn.nbody) == (plain.ngeom, plain.nbody)
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    if reason := select_renderer():
        pytest.skip(reason)
    assert os.environ["MUJOCO_GL"]
    render.render_episode(SCENE, [1.0], np.zeros((2, 2)), tmp_path / "e.mp4")
    picture = mediapy.read_image(tmp_path / "e.png").astype(int)
    red = (picture[..., 0] > 120) & (picture[..., 1] < 90) & (picture[..., 2] < 90)
    blue = (picture[..., 2] > 80) & (picture[..., 0] < 90)
    assert red.mean() > 0.001 and blue.mean() > 0.05  # the camera is close, and from this side the wall is blue
