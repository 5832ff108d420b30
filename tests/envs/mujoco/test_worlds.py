"""A world simulates exactly the model that MuJoCo compiles from the edited scene: every field, every constant."""

import chex
import jax
import numpy as np
import pytest
from franka_bench import SCENES, theta_of
from mujoco import mjx

import envs
from envs.domains import uniform
from envs.mujoco import processes
from envs.mujoco import worlds as physics
from envs.mujoco.engines import mjx as engine_jax
from envs.mujoco.scene import make_env
from envs.types import UserError

# MJX reads none of them: shortcuts of C MuJoCo, statistics, where a light is drawn, a copy only height fields need.
UNUSED = {"body_sameframe", "meanmass", "meansize", "center", "extent", "light_poscom0", "geom_rbound_hfield"}


def differing(left, right, path=""):
    """Names of the leaves, static ones included, that are not bit for bit the same."""
    if isinstance(left, tuple) and isinstance(right, tuple) and len(left) == len(right):
        return [
            name for i, pair in enumerate(zip(left, right, strict=True)) for name in differing(*pair, f"{path}[{i}]")
        ]
    if hasattr(left, "__dataclass_fields__"):
        assert type(left) is type(right), path
        pairs = {k: (getattr(left, k), getattr(right, k)) for k in left.__dataclass_fields__}
        return [name for k, pair in pairs.items() for name in differing(*pair, k)]
    if isinstance(left, (np.ndarray, jax.Array)):
        same = left.dtype == right.dtype and np.array_equal(left, right, equal_nan=left.dtype.kind == "f")
        return [] if same else [path]
    return [] if left == right else [path]


def nominal(scene):
    return {p.name: p.nominal for p in scene.parameters}


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("name", SCENES)
def test_worlds_are_what_mujoco_compiles(name):
    scene, rng = SCENES[name], np.random.default_rng(0)
    thetas = [theta_of(scene, rng) for _ in range(3)]
    env, base = make_env(scene), mjx.put_model(scene.build(nominal(scene)).compile(), impl="jax")
    for theta in thetas:
        fields = envs.sample_worlds(env, jax.random.key(0), 1, params=theta).model
        host = scene.build(theta).compile()
        wanted = mjx.put_model(host, impl="jax")
        world = engine_jax.with_fields(base, {k: v[0] for k, v in fields.items()})
        assert set(differing(world, wanted)) <= UNUSED
        assert world.stat.meaninertia == np.float32(host.stat.meaninertia)


@pytest.mark.parametrize("name", SCENES)
def test_parameters_reach_the_model(name):
    """Each domain parameter that is not part of the start changes some field of the model."""
    scene = SCENES[name]
    host = scene.build(nominal(scene)).compile()
    changed = {k: scene.build(nominal(scene) | {k: 1.1 * v + 0.01}) for k, v in nominal(scene).items()}
    ignored = {k for k, spec in changed.items() if not physics.varying_fields(host, [spec])}
    assert ignored == ({"object_x", "object_y"} if name == "push" else set())


def test_structure_must_not_change():
    scene = SCENES["push"]
    host = scene.build(nominal(scene)).compile()
    spec = scene.build(nominal(scene))
    spec.worldbody.add_geom(size=[0.1, 0, 0])
    with pytest.raises(UserError, match="not its structure"):
        physics.compile_worlds(host, lambda theta: spec, {}, [{}], ("body_mass",))


@pytest.mark.heavy
def test_processes_compile_the_same_worlds(monkeypatch):
    """And a scene whose function no other process can find is compiled here."""
    env = make_env(SCENES["push"], "c")
    theta = uniform(env).sample((), jax.random.key(0), 7)
    here = env.make_worlds(theta)
    calls = []

    def in_parallel(*args, keep):
        calls.append(processes.in_parallel(*args, keep=False))
        return calls[-1]

    monkeypatch.setattr(physics, "WORTH", 3)
    monkeypatch.setattr(physics, "in_parallel", in_parallel)
    monkeypatch.setattr(physics, "cores", lambda: 2)
    chex.assert_trees_all_equal(env.make_worlds(theta), here)
    assert [len(part["body_mass"]) for part in calls[0]] == [3, 4]
    nameless = SCENES["push"]._replace(build=lambda theta: SCENES["push"].build(theta))
    chex.assert_trees_all_equal(make_env(nameless, "c").make_worlds(theta), here)
    assert calls[1] is None


@pytest.mark.heavy
def test_worlds_are_those_of_the_code_that_runs_here(monkeypatch):
    """A process that has imported other code, as from a file that has changed since, is not believed."""
    env = make_env(SCENES["push"], "c")
    theta = uniform(env).sample((), jax.random.key(0), 7)
    here = env.make_worlds(theta)

    def in_parallel(share, tasks, keep):
        first, second = (share(*task) for task in tasks)
        return [first, {name: field + 1 for name, field in second.items()}]

    monkeypatch.setattr(physics, "WORTH", 3)
    monkeypatch.setattr(physics, "cores", lambda: 2)
    monkeypatch.setattr(physics, "in_parallel", in_parallel)
    chex.assert_trees_all_equal(env.make_worlds(theta), here)


def test_what_mujoco_refuses_is_one_line():
    env = make_env(SCENES["push"], "c")
    theta = uniform(env).sample((), jax.random.key(0), 1)
    theta.params[0, 2] = -1.0
    with pytest.raises(
        UserError, match=r"MuJoCo cannot build these domain parameters: .*mass.*; Element name"
    ) as refused:
        env.make_worlds(theta)
    assert "\n" not in str(refused.value)


def test_sampled_worlds_fill_their_ranges():
    env = make_env(SCENES["insert"])
    worlds = envs.sample_worlds(env, jax.random.key(0), 64, params={"hole_radius": 0.0118})
    params = dict(zip([p.name for p in env.parameters], np.asarray(worlds.theta.params).T, strict=True))
    for p in env.parameters:
        low, high = (0.0118, 0.0118) if p.name == "hole_radius" else (p.low, p.high)
        values = params[p.name]
        assert (values >= np.float32(low)).all() and (values <= np.float32(high)).all()
        assert np.ptp(values) >= 0.8 * np.float32(high - low)
    assert worlds.model["pair_friction"].shape == (64, 8, 5)
    np.testing.assert_allclose(worlds.model["pair_friction"][:, 0, 0], params["part_friction"])
