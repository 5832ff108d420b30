"""What a real system makes of commands: by hand, through a model, and on pushing."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import envs
from envs import gaps
from envs.rollout import play_episode
from envs.types import Transition
from sgft_jax.models import distortion
from sgft_jax.models.distortion import Distortion

STEP, WALL = 0.05, 0.3  # m at full action, m


def walled(obs, action):
    """A hand that moves by 5 cm at full action, and stops at walls."""
    return jnp.clip(obs[:2] + STEP * action, -WALL, WALL) - obs[:2]


def turned(angle, scale, bias, offset=(0.0, 0.0)):
    c, s = np.cos(angle), np.sin(angle)
    return Distortion(scale * jnp.array([[c, -s], [s, c]]), jnp.array(bias), jnp.array(offset))


def steps(truth, key, n=40, noise=1e-3):
    """Steps of a real hand whose commands point mostly one way, into a wall."""
    keys = jax.random.split(key, 3)
    obs = jax.random.uniform(keys[0], (n, 2), minval=-WALL, maxval=WALL)
    command = jnp.clip(jnp.array([[0.9, 0.2]]) + 0.4 * jax.random.normal(keys[1], (n, 2)), -1.0, 1.0)
    moved = jax.vmap(walled)(obs, jax.vmap(truth.meaning)(command))
    return Transition(obs, command, jnp.zeros(n), jnp.ones(n), obs + moved + noise * jax.random.normal(keys[2], (n, 2)))


def fit(rows, held=None, **given):
    held = jnp.ones(len(rows.reward), bool) if held is None else held
    given = {"turns": True, "errors": (0.0, 0.0)} | given
    return jax.jit(lambda: distortion.fit(walled, rows, held, jnp.full(2, 1e-3), **given))()


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("angle", "scale", "bias"),
    [pytest.param(0.7, 0.6, [0.0, 0.0], marks=pytest.mark.slow), (-1.2, 1.4, [0.1, -0.2])],
)
def test_one_rollout_tells_rotation_scale_and_bias_walls_or_not(angle, scale, bias, key):
    truth = turned(angle, scale, bias)
    found, evidence = fit(steps(truth, key))
    np.testing.assert_allclose(found.matrix, truth.matrix, atol=0.05)
    np.testing.assert_allclose(found.bias, truth.bias, atol=0.05)
    assert evidence > 100


@pytest.mark.heavy
def test_a_system_that_takes_commands_as_they_are_meant_gives_no_evidence(key):
    found, evidence = fit(steps(turned(0.0, 1.0, [0.0, 0.0]), key))
    np.testing.assert_allclose(found.matrix, np.eye(2), atol=0.05)
    assert evidence < 10


@pytest.mark.slow
def test_walls_tell_that_a_camera_is_off(key):
    """The hand stops where it should not: what is measured is not where it is."""
    truth = turned(0.1, 0.95, [0.0, 0.0], [0.06, 0.0])
    rows = steps(truth._replace(offset=jnp.zeros(2)), key, n=120)
    rows = rows._replace(obs=rows.obs + truth.offset[None], next_obs=rows.next_obs + truth.offset[None])
    found, evidence = fit(rows, errors=(0.05, 0.05))
    np.testing.assert_allclose(found.offset[0], 0.06, atol=0.01)
    np.testing.assert_allclose(found.matrix, truth.matrix, atol=0.05)
    assert evidence > fit(rows)[1] + 20
    assert jnp.abs(fit(rows, errors=(0.01, 0.01))[0].offset).max() <= 0.02  # twice the error at most
    np.testing.assert_array_equal(fit(rows)[0].offset, 0.0)


@pytest.mark.parametrize(
    ("commands", "both", "believed"),
    [
        (0.0, 19.0, False),
        (0.0, 21.0, True),
        (30.0, 49.0, False),
        (30.0, 51.0, True),
        (100.0, 149.0, False),
        (100.0, 151.0, True),
    ],
)
def test_errors_of_sensors_must_earn_their_place(commands, both, believed, monkeypatch):
    """20 nats and half as many again as the commands alone explain; else the fit of the commands stands."""
    plain, wide = turned(0.1, 1.0, [0.0, 0.0]), turned(0.2, 1.0, [0.0, 0.0], [0.06, 0.0])

    def search(*given, errors, turns):
        return (wide, jnp.float32(both)) if any(errors) else (plain, jnp.float32(commands))

    monkeypatch.setattr(distortion, "_fit", search)
    fitted, evidence = distortion.fit(walled, None, None, None, turns=True, errors=(0.05, 0.0))
    assert evidence == (both if believed else commands)
    np.testing.assert_array_equal(fitted.offset, (wide if believed else plain).offset)
    np.testing.assert_array_equal(fitted.matrix, (wide if believed else plain).matrix)
    assert distortion.fit(walled, None, None, None, turns=True, errors=(0.0, 0.0))[1] == commands


@pytest.mark.slow
def test_what_else_is_wrong_with_contacts_is_no_error_of_a_camera(key):
    """A real wall that stands elsewhere: errors of the camera would explain some of it, and are not believed."""
    rows = steps(turned(0.7, 0.6, [0.0, 0.0]), key)
    rows = rows._replace(next_obs=jnp.clip(rows.next_obs, -1.0, jnp.maximum(0.8 * WALL, rows.obs)))
    found, evidence = fit(rows, errors=(0.05, 0.05))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(distortion, "_EARNED", -1e9)
        patch.setattr(distortion, "_TIMES", 0.0)
        believed, more = fit(rows, errors=(0.05, 0.05))
    assert more > evidence and jnp.abs(believed.offset).max() > 0.01
    np.testing.assert_array_equal(found.offset, 0.0)


@pytest.mark.heavy
def test_rows_that_are_not_there_change_nothing(key):
    """Without any row what was believed stays; rows that are not held may hold anything."""
    rows = steps(turned(0.7, 0.6, [0.0, 0.0]), key)
    nothing, evidence = fit(rows, jnp.zeros(40, bool))
    np.testing.assert_allclose(nothing.matrix, np.eye(2), atol=1e-6)
    assert abs(evidence) < 1e-6
    held = jnp.arange(40) < 30
    torn = rows._replace(next_obs=jnp.where(held[:, None], rows.next_obs, 99.0))
    np.testing.assert_array_equal(fit(rows, held)[0].matrix, fit(torn, held)[0].matrix)


@pytest.mark.heavy
def test_without_a_common_frame_nothing_is_turned(key):
    found, _ = fit(steps(turned(0.7, 1.0, [0.0, 0.0]), key), turns=False)
    np.testing.assert_allclose(found.matrix - jnp.diag(jnp.diag(found.matrix)), 0.0, atol=1e-3)


def test_commands_undo_the_distortion_as_far_as_they_can():
    truth = turned(0.7, 0.6, [0.1, 0.0])
    action = jnp.array([0.3, -0.2])
    np.testing.assert_allclose(truth.meaning(truth.command(action)), action, atol=1e-6)
    assert jnp.abs(truth.command(jnp.ones(2))).max() == 1.0  # more cannot be commanded
    np.testing.assert_array_equal(distortion.none(2, 1).command(action), action)
    seen = truth._replace(offset=jnp.array([2.0])).seen(jnp.array([5.0, *truth.command(action), 0.0, 0.0]))
    np.testing.assert_allclose(seen, [3.0, *action, *truth.bias], atol=1e-6)


def test_it_is_what_effects_do_to_actions():
    """The family is that of `envs.effects.distort`."""
    env = envs.make("push", "c")
    values = {"action_rotation": 0.5, "action_scale": [0.6, 1.2], "action_bias": [0.1, -0.1]}
    effects = envs.effects.make_range(env, values).low
    own = distortion.turned_and_scaled(
        effects.action_rotation, jnp.log(effects.action_scale), effects.action_bias, jnp.zeros(4)
    )
    action = jnp.array([0.4, -0.7])
    np.testing.assert_allclose(own.meaning(action), envs.effects.distort(effects, action), rtol=1e-5)


@pytest.mark.slow
def test_one_rollout_of_pushing_tells_how_commands_are_turned_and_scaled():
    """Through a linear model of the free hand; a puck and the end of the workspace are in its way."""
    env = envs.make("push", "c")
    gap = gaps.from_dict(env, "g", {"effects": {"obs_noise": 0.001, "action_rotation": 0.7, "action_scale": 0.6}})
    pool, key = gaps.worlds(env, gap, jax.random.key(0), 1), jax.random.key(1)

    def uniform(carry, obs, key):
        return (jax.random.uniform(key, (2,), minval=-1.0, maxval=1.0), carry)

    played = jax.jit(lambda key: play_episode(env, pool, uniform, (), key, gamma=0.9))(key)

    def free(obs, action):
        return 0.05 * action

    found, evidence = distortion.fit(
        free, played.transitions, played.valid, jnp.full(2, 1e-3), turns=True, errors=(0.0,) * 4
    )
    assert np.linalg.norm(found.matrix - turned(0.7, 0.6, [0.0, 0.0]).matrix) < 0.1 and evidence > 20
