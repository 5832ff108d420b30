"""MuJoCo Warp, here on the CPU, against C MuJoCo: one control period from each state of scripted episodes."""

import itertools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from franka_bench import EXACT, SCENES, push_hard, theta_of
from scripted import PROBES

import envs
from envs.franka import arm, ball, push, towel
from envs.franka.arm import at_rest
from envs.mujoco.engines import c as engine_c
from envs.mujoco.engines import warp as engine_warp
from envs.mujoco.scene import make_env

pytest.importorskip("warp")
WORLDS, STEPS = 3, 24
DEFORMABLES = {"towel": towel.REAL["towel"], "ball": ball.REAL["ball"]}


def in_random_worlds(env, scene, rng):
    """[WORLDS], every parameter varied, so that the board of hammer stands elsewhere in each."""
    thetas = [theta_of(scene, rng) for _ in range(WORLDS)]
    pools = [envs.sample_worlds(env, jax.random.key(0), 1, params=theta, effects=EXACT) for theta in thetas]
    return jax.tree.map(lambda *x: jnp.concatenate(x), *pools)


def hammer(env, world, key):
    """Actions [STEPS, 3] of the scripted controller and the states [STEPS + 1] that they lead through."""
    start = env.reset(world, key)

    def step(state, t):
        action = PROBES["hammer"].script(world.theta.params, state.physics, t)
        after = env.step(world, state, action, key)
        return after, (action, after)

    actions, later = jax.lax.scan(step, start, jnp.arange(STEPS))[1]
    return actions, jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, later)


def converging(scene):
    """The scene with a solver that C MuJoCo does not stop after 4 iterations. Warp's goes on, too."""

    def build(theta):
        spec = scene.build(theta)
        spec.option.iterations = spec.option.ls_iterations = 50
        return spec

    return scene._replace(build=build)


@pytest.mark.slow
def test_hammering():
    """0.2 mrad and 0.01 mm after 0.2 s with blows on nail and board and saturated servos; all worlds in one batch."""
    c, warp = (make_env(SCENES["hammer"], impl=impl) for impl in ("c", "warp"))
    worlds = in_random_worlds(c, SCENES["hammer"], np.random.default_rng(3))
    keys = jax.random.split(jax.random.key(1), WORLDS)
    actions, states = jax.jit(jax.vmap(lambda *x: hammer(c, *x)))(worlds, keys)
    before, after = (jax.tree.map(lambda x, s=s: x[:, s], states) for s in (slice(0, -1), slice(1, None)))
    over_time = jax.vmap(warp.step, (None, 0, 0, None))
    seen = jax.jit(jax.vmap(over_time))(worlds, before, actions, keys)
    assert not seen.invalid.any()
    error = np.abs(seen.physics.qpos - after.physics.qpos)
    assert error[..., :7].max() < 2e-4 and error[..., 7].max() < 2e-5
    nail = np.asarray(states.physics.qpos)[..., 7]
    assert (nail[:, 0] - nail[:, -1]).max() > 1e-3  # some blow drove a nail


@pytest.mark.slow
def test_arm_on_the_board():
    """0.1 mrad after 0.2 s under saturated commands that press hammer, wrist and elbow on the board."""
    c, warp = (make_env(SCENES["hammer"], impl=impl) for impl in ("c", "warp"))
    actions = jnp.array(list(itertools.product((-1.0, 1.0), repeat=3)))
    worlds = envs.sample_worlds(c, jax.random.key(3), len(actions), effects=EXACT)
    keys = jax.random.split(jax.random.key(0), len(actions))
    state = jax.vmap(c.reset)(worlds, keys)
    steps = [jax.jit(jax.vmap(env.step)) for env in (c, warp)]
    for _ in range(12):
        after, seen = (step(worlds, state, actions, keys) for step in steps)
        np.testing.assert_allclose(seen.physics.qpos, after.physics.qpos, atol=1e-4)
        state = after


@pytest.mark.slow
@pytest.mark.parametrize("name", DEFORMABLES)
def test_pushing_what_deforms(name):
    """After 0.2 s in which a hard push moves it Warp is about as far from C MuJoCo as that is from itself if it begins
    a micrometre elsewhere: what is observed, m, and any coordinate, m and rad, in half of the periods and in all.

    Contacts that deform amplify rounding, which differs between processors and compilers: one of ten periods may end
    1 mm elsewhere, or none. What the same periods make of a micrometre is a bound that goes along.
    """
    c, warp = make_env(converging(DEFORMABLES[name]), impl="c"), make_env(DEFORMABLES[name], impl="warp")
    worlds, key = in_random_worlds(c, DEFORMABLES[name], np.random.default_rng(3)), jax.random.key(1)
    states = [jax.jit(jax.vmap(c.reset))(worlds, jax.random.split(key, WORLDS))]
    step, acted = jax.jit(jax.vmap(c.step, (0, 0, 0, None))), []
    for _ in range(STEPS):
        acted.append(jax.vmap(push_hard)(states[-1].true_obs))
        states.append(step(worlds, states[-1], acted[-1], key))
    episodes = jax.tree.map(lambda *x: jnp.stack(x), *states)
    place = np.asarray(episodes.true_obs)[..., 2:]
    moving = np.argwhere(np.abs(np.diff(place, axis=0)).max(-1) > 1e-3)
    t, i = np.random.default_rng(0).permutation(moving)[:10].T
    assert len(t) == 10 and set(i) == set(range(WORLDS))
    before, after = (jax.tree.map(lambda x, s=s: x[s, i], episodes) for s in (t, t + 1))
    own = jax.tree.map(lambda x: x[i], worlds)
    c_step, warp_step = (jax.jit(jax.vmap(env.step, (0, 0, 0, None))) for env in (c, warp))

    def apart(state):
        """[2, 10] how far what is observed, and any coordinate, is from where C MuJoCo has it."""
        pairs = ((state.true_obs, after.true_obs), (state.physics.qpos, after.physics.qpos))
        return np.array([np.abs(one - other).max(1) for one, other in pairs])

    def elsewhere(seed):
        moved = before.physics.qpos + 1e-6 * jax.random.normal(jax.random.key(seed), before.physics.qpos.shape)
        return before._replace(physics=before.physics._replace(qpos=moved))

    actions = jnp.stack(acted)[t, i]
    seen = warp_step(own, before, actions, key)
    assert not seen.invalid.any()
    ours = apart(seen)
    bound = np.concatenate([apart(c_step(own, elsewhere(seed), actions, key)) for seed in range(4)], axis=1)
    assert (np.median(ours, axis=1) < 3 * np.median(bound, axis=1)).all()
    assert (ours.max(1) < 3 * bound.max(1)).all()
    assert (np.median(bound, axis=1) < (1e-4, 3e-3)).all()  # what is wrong by more than rounding would not hide there


@pytest.mark.slow
@pytest.mark.parametrize(("name", "contacts"), [("towel", 72), ("ball", 87)])
def test_more_contacts_than_pushes_ever_make(name, contacts):
    """All of the towel bundled up at a fingertip, or all pads drawn in at one and pressed on the table: 5 ms."""
    scene = converging(DEFORMABLES[name])
    host = scene.build({p.name: p.nominal for p in scene.parameters}).compile()
    start, data = scene.initial(jnp.array([0.25, 0.0]), jax.random.key(0)), mujoco.MjData(host)
    n = arm.N_JOINTS
    data.qpos[:n] = start.qpos[:n]
    mujoco.mj_kinematics(host, data)
    left, right = (data.geom(finger).xpos[:2] for finger in push.FINGERS.values())
    near = 0.7 * left + 0.3 * right
    if name == "towel":
        points = np.append(near, 0.006) + 0.05 * towel.POINTS * [1, 1, 0]
        data.qpos[n:] = (points - towel.POINTS).ravel()
    else:
        data.qpos[n:] = [*near, 0.008, 1, 0, 0, 0, *np.full(len(ball.DIRECTIONS), ball.PAD - ball.RADIUS)]
    mujoco.mj_forward(host, data)
    assert data.ncon == contacts and data.nefc == (2 * (data.contact.dim - 1)).sum()
    assert engine_warp.budget(host) == (host.npair, (2 * (host.pair_dim - 1)).sum())  # spheres touch a thing once
    state = at_rest(start.qpos[:n], jnp.asarray(data.qpos[n:], jnp.float32), host.nv)
    controls = jnp.broadcast_to(state.ctrl, (1, *state.ctrl.shape))
    engines = engine_c.make_engine(host, ()), engine_warp.make_engine(host)
    wanted, seen = (jax.jit(engine.advance)({}, state, controls) for engine in engines)
    assert np.abs(wanted.qvel).max() > 0.8  # m/s
    np.testing.assert_allclose(seen.qvel, wanted.qvel, atol=1e-3)


@pytest.mark.slow
def test_lost_contacts_are_explosions(monkeypatch):
    """With room for fewer constraint rows than a blow needs, the state is not finite instead of silently wrong."""
    monkeypatch.setattr(engine_warp, "budget", lambda host: (2, 1))
    env = make_env(SCENES["hammer"], impl="warp")
    worlds = in_random_worlds(env, SCENES["hammer"], np.random.default_rng(3))
    world = jax.tree.map(lambda x: x[0], worlds)
    _, states = jax.jit(lambda key: hammer(env, world, key))(jax.random.key(1))
    assert states.invalid.any() and not states.invalid[0]


def test_kernels_compile_in_processes_until_they_are_in_the_cache(monkeypatch, tmp_path):
    warp_worlds, answers = pytest.importorskip("envs.mujoco.engines.warp_worlds"), iter([None, [None], [None]])
    monkeypatch.setattr(warp_worlds.wp, "is_cuda_available", lambda: True)
    monkeypatch.setattr(warp_worlds.wp, "get_device", lambda _: SimpleNamespace(arch=90))
    monkeypatch.setattr(warp_worlds.wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(warp_worlds, "in_parallel", lambda *_, **__: next(answers))
    host = mujoco.MjModel.from_xml_string("<mujoco/>")
    for rows, notes in ((1, 0), (1, 1), (1, 1), (2, 2)):  # failed; compiled; nothing to do; another size
        warp_worlds.compile_kernels(host, ["qpos"], rows=rows)
        assert len(list(tmp_path.iterdir())) == notes
