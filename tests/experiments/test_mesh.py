"""Programs on two devices (of the host, see conftest) compute what they compute on one."""

import collections
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
from jax.sharding import PartitionSpec

import envs
from envs import mesh
from envs.mujoco.engines import c as engine_c
from envs.mujoco.worlds import PhysicsState
from envs.types import UserError
from experiments import pretrain
from experiments.runner import cli
from sgft_jax.data import replay
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.presets import PretrainConfig
from sgft_jax.train.fleet import make_programs, over_members, spread, spread_replay
from sgft_jax.train.pretraining import domain_of, domains, make_trainer, random_experience, training_pools

LOOP = {"n_envs": 16, "worlds": 8, "chunk_steps": 24, "random_transitions": 64, "random_ladder": 0.5}
LEARNING = {"replay_capacity": 128, "batch_size": 32, "updates_per_step": 2, "gamma": 0.9}
CONFIG = PretrainConfig(**LOOP, **LEARNING, network=NetworkConfig(hidden=(16, 16)), ensemble_size=2)
CUT = PartitionSpec(None, mesh.DATA)  # [seeds, ...]


@functools.cache
def begun(devices):
    """Random data and the start of a run."""
    with mesh.use(devices):
        collect = over_members(functools.partial(random_experience, toy.make(), CONFIG), 1)
        random = jax.jit(collect)(pools(), jax.random.split(jax.random.key(1), 1))
        return random, program().init(pools(), random, jax.random.split(jax.random.key(2), 1))


@functools.cache
def program():
    return make_programs(make_trainer(toy.make(), CONFIG), 1, shared=False)


def pools():
    env = toy.make()
    return training_pools(CONFIG, [0], domain := domain_of(env, CONFIG), env.make_worlds)(0, domains(domain, 1))


def agree(one, two, **tolerance):
    for (path, a), b in zip(jax.tree_util.tree_leaves_with_path(one), jax.tree.leaves(two), strict=True):
        a, b = (jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x for x in (a, b))
        np.testing.assert_allclose(a, b, err_msg=jax.tree_util.keystr(path), **tolerance)


@pytest.mark.slow
def test_a_run_begins_alike_on_any_number_of_devices():
    """The random-action data are 4 steps of all environments, so their physics is compared, too."""
    agree(begun(1), begun(2), rtol=1e-5, atol=1e-5)


@pytest.mark.heavy
def test_environments_and_experience_are_cut_and_the_agent_is_whole():
    random, state = begun(2)
    for tree in (random.data, state.replay.data, state.fleet):
        assert {x.sharding.spec for x in jax.tree.leaves(tree)} == {CUT}
    assert all(x.sharding.is_fully_replicated for x in jax.tree.leaves(state.learner))


@pytest.mark.slow
def test_training_is_the_same_on_any_number_of_devices():
    """One chunk, in which episodes end; test_hosts.py has the same on two hosts."""

    def trained(devices):
        random, state = begun(devices)
        with mesh.use(devices):
            return program().chunk(pools(), random, jax.tree.map(jnp.copy, state))

    one, two = trained(1), trained(2)
    agree(one, two, rtol=2e-2, atol=2e-3)  # 48 updates amplify the rounding of sums
    run, metrics = two
    for tree in (run.replay.data, run.fleet):
        assert {x.sharding.spec for x in jax.tree.leaves(tree)} == {CUT}
    assert all(x.sharding.is_fully_replicated for x in jax.tree.leaves((run.learner, metrics)))


@pytest.mark.slow
def test_little_travels_between_devices():
    """A step of all environments: what they saw once to all, drawn rows summed, two sums of gradients an update."""
    random, state = begun(2)
    with mesh.use(2):
        text = program().chunk.lower(pools(), random, state).compile().as_text()
    kinds = "all-reduce|all-gather|all-to-all|collective-permute"
    found = collections.Counter(re.findall(rf" ({kinds})(?:-start)?\(", text))
    assert found["all-to-all"] == found["collective-permute"] == 0
    assert found["all-reduce"] <= 6  # two of gradients, drawn rows, has an episode ended, two of metrics
    leaves = len(jax.tree.leaves(replay.blank(1, 1)))
    assert found["all-gather"] <= leaves + 2  # the rows, which of them are valid, and the ladder, once a chunk


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("capacity", [8, 9])
def test_each_device_writes_the_rows_of_its_own_piece(capacity):
    """Round the corner, an invalid row among them; 9 rows cannot be cut."""
    empty = replay.init(replay.blank(2, 1), capacity)
    rows = jax.tree.map(lambda x: jnp.broadcast_to(x, (6, *x.shape)), replay.blank(2, 1))
    rows = rows._replace(reward=jnp.arange(1.0, 7.0))
    valid = jnp.array([True, True, False, True, True, True])

    def fill(state):
        return replay.add_batch(replay.add_batch(state, rows, valid), rows, valid)

    one = jax.jit(fill)(empty)
    with mesh.use(2):
        two = jax.jit(fill)(jax.jit(spread_replay)(empty) if capacity == 8 else empty)
    agree(one, two, rtol=0)
    assert one.data.reward.tolist() == {8: [5, 6, 4, 5, 6, 1, 2, 4], 9: [6, 2, 4, 5, 6, 1, 2, 4, 5]}[capacity]


def test_rows_are_counted_whole():
    mask = jnp.arange(16) % 3 > 0
    with mesh.use(2):
        program = jax.jit(lambda mask: mesh.running_count(mesh.split(mask))).lower(mask).compile()
        counted = program(mask)
    assert counted.tolist() == np.cumsum(mask).tolist()
    assert counted.sharding.is_fully_replicated and "all-gather" in program.as_text()


@pytest.mark.slow
def test_what_one_device_left_two_continue():
    """A checkpoint holds whole arrays; `spread` lays them out."""
    random, state = begun(1)
    with mesh.use(2):
        laid_out = jax.jit(over_members(spread, 1), donate_argnums=0)(jax.tree.map(jnp.copy, state))
        data = jax.jit(over_members(spread_replay, 1))(random).data
    agree(state, laid_out)
    assert laid_out.replay.data.reward.sharding.spec == data.reward.sharding.spec == CUT


def test_physics_that_xla_cannot_look_into_steps_in_pieces():
    """C MuJoCo behind a callback: each device calls it for its own worlds."""
    scene = envs.scene("hammer")
    host = scene.build({p.name: p.nominal for p in scene.parameters}).compile()
    engine = engine_c.make_engine(host, ())
    step = mesh.split_vmap(lambda state, controls: engine.advance({}, state, controls))
    rest = jnp.asarray(host.qpos0, jnp.float32)
    start = PhysicsState(rest, jnp.zeros(host.nv), jnp.zeros(host.nv), rest[: host.nu])
    states = jax.tree.map(lambda x: jnp.repeat(x[None], 4, axis=0), start)
    controls = 0.1 * jax.random.normal(jax.random.key(0), (4, 8, host.nu))

    one = jax.jit(step)(states, controls)
    with mesh.use(2):
        two = jax.jit(step)(states, controls)
    agree(one, two, rtol=0)
    assert two.qpos.sharding.spec == PartitionSpec(mesh.DATA)
    assert np.abs(two.qvel).max() > 0.1 and len(np.unique(two.qpos[:, 0])) == 4


def test_numbers_of_devices_that_do_not_fit(monkeypatch, capsys):
    assert mesh.devices(0, {"a": 6}) == jax.device_count() == 2
    with pytest.raises(UserError, match="--devices 3: JAX sees 2 cpu device"):
        mesh.devices(3, {})
    with pytest.raises(UserError, match="--seeds is 5: not a multiple of the 2 devices"):
        mesh.devices(2, {"--seeds": 5})
    monkeypatch.setitem(envs.TASKS, "toy", "toy")
    monkeypatch.setattr(cli, "set_up", lambda: None)
    with pytest.raises(SystemExit) as stopped:
        pretrain.main(["--task", "toy", "--preset", "cpu", "--config.n-envs", "33", "--devices", "2"])
    assert stopped.value.code == 2
    assert capsys.readouterr().err.startswith("error: --config.n-envs is 33: not a multiple of the 2 devices")
