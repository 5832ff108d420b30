"""Errors of commands that gaps may have: what each does, its memory, and that systems without any are left alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy

import envs
from envs import gaps
from envs.commands import make_commands, warp, with_commands
from envs.observations import with_previous_actions
from envs.rollout import real_env, real_worlds
from envs.types import UserError

TOY = toy.make()._replace(workspace=((-1.0, 1.0), (-0.5, 1.5)))
ERRING = with_commands(TOY)
EXACT = {"params": {"mass": 1.0, "friction": 4.0}, "effects": {"obs_noise": 0.0}}


def gap(**commands):
    return gaps.from_dict(TOY, "erring", {**EXACT, "commands": commands})


def arriving(errors, actions, env=TOY, key=None):
    """[T, act_dim] the commands that the toy's drive got: it keeps the last one. Then the last state."""
    system = real_env(env, [errors])
    world = jax.tree.map(lambda x: x[0], gaps.worlds(system, errors, jax.random.key(0)))

    def step(state, step):
        after = system.step(world, state, *step)
        return after, jax.tree.leaves(after.physics)[2]

    key = jax.random.key(1) if key is None else key
    keys = jax.random.split(key, len(actions))
    state, commands = jax.jit(lambda: jax.lax.scan(step, system.reset(world, key), (jnp.asarray(actions), keys)))()
    return np.asarray(commands), state


def along(*first):
    """Actions of which the first numbers are these."""
    return jnp.stack([jnp.array(first, jnp.float32), jnp.zeros(len(first))], axis=1)


@pytest.mark.parametrize(
    ("commands", "expected"),
    [
        ({"late": 0}, [1.0, 0.5, -0.2, -1.0, 0.1]),
        ({"late": 2}, [0.0, 0.0, 1.0, 0.5, -0.2]),
        ({"dead_band": 0.25}, [0.75, 0.25, 0.0, -0.75, 0.0]),
        # It begins in the middle of its play: 0.2 to the side, then 0.4 back.
        ({"backlash": 0.4}, [0.8, 0.5, 0.0, -0.8, 0.0]),
        ({"lost": 1.0}, [0.0, 0.0, 0.0, 0.0, 0.0]),
        ({"late": 1, "dead_band": 0.25, "backlash": 0.5}, [0.0, 0.5, 0.25, 0.0, -0.25]),
    ],
)
def test_each_error_does_what_it_says(commands, expected):
    sent, _ = arriving(gap(**commands), along(1.0, 0.5, -0.2, -1.0, 0.1))
    np.testing.assert_allclose(sent[:, 0], expected, atol=1e-6)
    np.testing.assert_array_equal(sent[:, 1], 0.0)  # axis by axis


def test_a_lost_command_repeats_the_one_before_it():
    asked = along(*np.linspace(0.1, 1.0, 400))
    sent = arriving(gap(lost=0.3), asked)[0][:, 0]
    new = np.isclose(sent, asked[:, 0])
    assert 0.6 < new.mean() < 0.8
    np.testing.assert_array_equal(sent[1:][~new[1:]], sent[:-1][~new[1:]])


@pytest.mark.parametrize("seed", [0, 1])
def test_a_warp_is_smooth_as_large_as_it_says_and_no_bias(seed):
    commands = make_commands(TOY, {"warp": 0.35, "warp_seed": seed})
    x, y = np.meshgrid(np.linspace(-1, 1, 101), np.linspace(-0.5, 1.5, 101), indexing="ij")
    error = np.asarray(jax.jit(jax.vmap(lambda place: warp(commands, place)))(np.stack([x.ravel(), y.ravel()], axis=1)))
    assert np.linalg.norm(error, axis=1).max() == pytest.approx(0.35, rel=0.05)
    np.testing.assert_allclose(error.mean(axis=0), 0.0, atol=0.02)
    field = error.reshape(101, 101, 2)
    for axis in (0, 1):  # over 1 % of the workspace it changes little, over a third of it much
        assert np.abs(np.diff(field, axis=axis)).max() < 0.03
        apart = np.take(field, range(34, 101), axis) - np.take(field, range(67), axis)
        assert np.linalg.norm(apart, axis=-1).mean() > 0.1


def test_a_warp_is_added_where_the_hand_is_and_its_seed_draws_another(key):
    """The start has the key of the episode; the hand stands where `true_obs` begins, whatever sensors say of it."""
    for seed in (1, 2):
        errors = gap(warp=0.5, warp_seed=seed)
        errors = errors._replace(effects={**errors.effects, "obs_bias": {"xy": [0.3, -0.2]}})
        start = real_env(TOY, [errors]).reset(jax.tree.map(lambda x: x[0], gaps.worlds(ERRING, errors, key)), key)
        expected = jnp.array([1.0, 0.0]) + warp(make_commands(TOY, errors.commands), start.true_obs[:2])
        sent = arriving(errors, along(1.0), key=key)[0]
        np.testing.assert_allclose(sent[0], expected, atol=1e-5)
        assert np.abs(sent[0] - arriving(gap(warp=0.5, warp_seed=3 - seed), along(1.0), key=key)[0]).max() > 0.01


def test_memory_ends_with_the_episode_and_systems_share_a_program(key):
    """One program steps a system without errors, one that is late and one with play; a reset forgets."""
    listed = [gaps.from_dict(TOY, "exact", EXACT), gap(late=3), gap(backlash=2.0)]
    system = real_env(TOY, listed)
    pools = jax.tree.map(lambda x: x[:, 0], real_worlds(system, listed, key))
    states = jax.vmap(system.reset, (0, None))(pools, key)
    fresh = jax.tree.map(np.asarray, states.physics[1])
    for leaf in jax.tree.leaves(fresh):
        np.testing.assert_array_equal(leaf, 0.0)
    step = jax.jit(jax.vmap(system.step, (0, 0, None, None)))
    plain_world = jax.tree.map(lambda x: x[0], gaps.worlds(TOY, listed[0], key))
    plain = TOY.reset(plain_world, key)
    for number, drives in enumerate(([1, 0, 0], [1, 0, 1], [1, 0, 1], [1, 1, 1])):
        noise = jax.random.fold_in(key, number)
        states, plain = step(pools, states, jnp.ones(2), noise), TOY.step(plain_world, plain, jnp.ones(2), noise)
        np.testing.assert_array_equal(states.physics[0].ctrl[:, 0], drives)
        np.testing.assert_allclose(states.obs[0], plain.obs, atol=1e-6)
    again = jax.vmap(system.reset, (0, None))(pools, key)
    jax.tree.map(np.testing.assert_array_equal, again.physics[1], fresh)


def test_observations_tell_what_was_commanded_not_what_arrived(key):
    seeing = with_previous_actions(TOY, 2)
    errors = gap(late=3, warp=0.5)
    _, state = arriving(errors, along(0.1, 0.2, 0.3), env=seeing)
    np.testing.assert_allclose(state.obs[4:], [0.3, 0.0, 0.2, 0.0], atol=1e-6)
    system = real_env(seeing, [errors])
    world = jax.tree.map(lambda x: x[0], gaps.worlds(system, errors, key))
    assert system.restore is not None
    restored = system.restore(world, state.obs, key)
    np.testing.assert_allclose(restored.obs, state.obs, atol=1e-6)
    np.testing.assert_allclose(restored.physics[1].asked[:, 0], [0.3, 0.2, 0.0, 0.0], atol=1e-6)
    np.testing.assert_array_equal(system.trace(state.physics), seeing.trace(state.physics[0]))


def test_where_no_gap_names_any_the_task_is_the_same_object(key):
    plain = gaps.from_dict(TOY, "heavy", {"params": {"mass": 1.3}})
    assert real_env(TOY, [plain]) is TOY and gaps.worlds(TOY, plain, key).commands == ()
    wrapped = with_commands(TOY)
    assert real_env(wrapped, [gap(late=1), plain]) is wrapped  # never twice
    with pytest.raises(UserError, match="commands err only in a real system"):
        gaps.worlds(TOY, gap(late=1), key)


def test_a_file_of_them_is_read_back_and_overrides_reach_them(tmp_path):
    errors, plain = gap(warp=0.35, warp_seed=1, late=2), gaps.from_dict(TOY, "plain", {"params": {"mass": 1.0}})
    file = tmp_path / "some.toml"
    file.write_text(gaps.to_toml([errors, plain]))
    assert "commands = { warp = 0.35, warp_seed = 1, late = 2 }" in file.read_text()
    assert gaps.read_file(file) == {"erring": errors, "plain": plain}
    assert gaps.load(TOY, f"{file}:erring", ["late=1"]).commands == {**errors.commands, "late": 1}
    assert gaps.load(TOY, f"{file}:plain", ["dead_band=0.3"]).commands == {"dead_band": 0.3}
    assert "commands" not in plain.table and errors.table["commands"] == errors.commands


@pytest.mark.parametrize(
    ("commands", "words"),
    [
        ("{ lat = 1 }", "error of 'commands': there is no 'lat', did you mean 'late'"),
        ("{ action_scale = 1 }", "there is no 'action_scale'. Choose from: backlash, dead_band"),
        ("{ late = 4 }", "'late' must be a whole number from 0 to 3, got 4"),
        ("{ late = 1.5 }", "'late' must be a whole number from 0 to 3, got 1.5"),
        ("{ lost = 1.1 }", "'lost' must be one number from 0 to 1, got 1.1"),
        ("{ backlash = 1e9 }", "'backlash' must be one number from 0 to 10, got 1000000000.0"),
        ("{ dead_band = -0.1 }", "'dead_band' must be one number from 0 to 1, got -0.1"),
        ("{ dead_band = [0.1, 0.2] }", r"'dead_band' must be one number from 0 to 1, got \[0.1, 0.2\]"),
        ("{ lost = 'often' }", "'lost' must be a number or a list of numbers, got 'often'"),
        ("{ warp_seed = -1 }", "'warp_seed' must be a whole number from 0 to 4294967295, got -1"),
        ("3", "'commands' must be a table of names and numbers, got 3"),
    ],
)
def test_bad_commands_are_one_line_that_names_file_gap_and_key(tmp_path, commands, words):
    file = tmp_path / "some.toml"
    file.write_text(f"[odd]\ncommands = {commands}\n")
    with pytest.raises(UserError, match=rf"some.toml \[odd\]: .*{words}") as refused:
        gaps.read_file(file)
    assert "\n" not in str(refused.value)


def test_bad_overrides_and_places_are_one_line():
    for overrides, words in (
        (["late=7"], r"gap 'sim\+late=7': 'late' must be a whole number from 0 to 3, got 7"),
        (["warp=0.1"], "'warp' of 'commands' needs a task that declares its workspace, which toy does not"),
    ):
        with pytest.raises(UserError, match=words):
            gaps.load(toy.make(), "sim", overrides)
    for section in ("params", "effects"):
        with pytest.raises(UserError, match="'late' belongs in the 'commands' of a gap"):
            gaps.from_dict(TOY, "g", {section: {"late": 1}})


@pytest.mark.parametrize("task", ["push", "hammer", "insert"])
def test_the_tasks_of_the_paper_declare_where_their_hands_move(task):
    scene = envs.scene(task)
    low, high = np.array(scene.workspace).T
    assert len(low) == scene.observation[0].size and (low <= high).all() and (low < high).sum() >= 2
