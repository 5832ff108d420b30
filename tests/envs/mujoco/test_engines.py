"""MuJoCo's C engine behind a callback: the same physics, however the worlds are batched, and no silent resets."""

import c_reference
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from compiled import compiled
from franka_bench import EXACT, SCENES, member, theta_of

import envs
from envs.mujoco import worlds as physics
from envs.mujoco.engines import mjx as engine_jax
from envs.mujoco.engines import warp as engine_warp
from envs.mujoco.scene import make_env
from envs.types import UserError

N, STEPS = 3, 5


@pytest.fixture(scope="module", params=[pytest.param(x, marks=[pytest.mark.slow] * (x != "push")) for x in SCENES])
def rig(request):
    """(scene, env, thetas, worlds [N] of these, their starts [N], actions [N, STEPS])."""
    scene, rng = SCENES[request.param], np.random.default_rng(1)
    env = make_env(scene, impl="c")
    thetas = [theta_of(scene, rng) for _ in range(N)]
    pools = [envs.sample_worlds(env, jax.random.key(0), 1, params=theta, effects=EXACT) for theta in thetas]
    worlds = jax.tree.map(lambda *x: jnp.concatenate(x), *pools)
    starts = jax.jit(jax.vmap(env.reset))(worlds, jax.random.split(jax.random.key(1), N))
    return scene, env, thetas, worlds, starts, jax.random.uniform(jax.random.key(2), (N, STEPS, env.act_dim)) - 0.5


def episode(env, world, state, actions):
    """[STEPS] states."""

    def step(state, action):
        after = env.step(world, state, action, jax.random.key(0))
        return after, after

    return jax.lax.scan(step, state, actions)[1]


@pytest.mark.heavy
def test_steps_are_those_of_mujoco_in_each_world(rig):
    scene, env, thetas, worlds, starts, actions = rig
    played = jax.jit(jax.vmap(lambda *x: episode(env, *x)))(worlds, starts, actions)
    for i, theta in enumerate(thetas):
        wanted = c_reference.play(scene, theta, member(starts, i).physics, actions[i])
        np.testing.assert_allclose(played.physics.qpos[i], np.array([s.qpos for s in wanted]), atol=1e-5)
        np.testing.assert_allclose(played.physics.qvel[i], np.array([s.qvel for s in wanted]), atol=1e-3)
    assert np.ptp(played.physics.qpos[:, -1], axis=0).max() > 1e-3  # the worlds are not one


@pytest.mark.heavy
def test_any_batching_gives_the_same(rig):
    """Up to the rounding of what XLA computes between the steps."""
    _, env, _, worlds, starts, actions = rig

    def play(*x):
        return episode(env, *x).physics.qpos

    alone = jnp.stack([jax.jit(play)(member(worlds, i), member(starts, i), actions[i]) for i in range(N)])
    twice = jax.tree.map(lambda x: jnp.stack([x, x[::-1]]), (worlds, starts, actions))
    nested = jax.jit(jax.vmap(jax.vmap(play)))(*twice)
    np.testing.assert_allclose(nested, jnp.stack([alone, alone[::-1]]), atol=1e-5)


@pytest.mark.heavy
def test_an_explosion_is_reported_not_reset(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scene = SCENES["push"]
    env = compiled(make_env(scene, impl="c"))
    worlds = envs.sample_worlds(env, jax.random.key(0), 2, effects=EXACT)
    states = jax.vmap(env.reset)(worlds, jax.random.split(jax.random.key(1), 2))
    broken = states.physics._replace(qvel=states.physics.qvel.at[0].set(1e12))
    after = jax.jit(jax.vmap(env.step))(
        worlds, states._replace(physics=broken), jnp.zeros((2, env.act_dim)), jax.random.split(jax.random.key(2), 2)
    )
    assert after.invalid.tolist() == [True, False]
    assert not list(tmp_path.iterdir())  # MuJoCo would log its warning there


def test_who_steps_the_physics(monkeypatch):
    monkeypatch.setenv(physics.IMPL_VARIABLE, "auto")
    assert physics.choose_impl() == "c"  # the tests run on a CPU
    for backend, installed, chosen in (("gpu", True, "warp"), ("gpu", False, "jax"), ("tpu", True, "jax")):
        monkeypatch.setattr(jax, "default_backend", lambda backend=backend: backend)
        monkeypatch.setattr(engine_warp, "available", lambda installed=installed: installed)
        assert physics.choose_impl() == chosen
    assert physics.choose_impl("jax") == "jax" and make_env(SCENES["hammer"], "c").impl == "c"
    monkeypatch.setenv(physics.IMPL_VARIABLE, "wrap")
    with pytest.raises(UserError, match=r"SGFT_IMPL: .* 'wrap', did you mean 'warp'\? Choose from: auto, c, jax, warp"):
        physics.choose_impl()


def test_scenes_are_put_on_a_device_of_this_process(monkeypatch):
    mine = jax.devices()[-1]
    assert mine != jax.devices()[0]
    monkeypatch.setattr(jax, "local_devices", lambda: [mine])
    scene = SCENES["push"]
    spec = scene.build({p.name: p.nominal for p in scene.parameters})
    placed = [x.devices() for x in jax.tree.leaves(engine_jax.put(spec.compile())) if isinstance(x, jax.Array)]
    assert len(placed) > 50 and all(devices == {mine} for devices in placed)
