"""What rollouts tell of a gap, where the answer is known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tuners

from envs.types import Transition, UserError
from sgft_jax import diagnosis
from sgft_jax.diagnosis import Beliefs, Rollouts
from sgft_jax.examination import Examiner
from sgft_jax.models import distortion, dynamics
from sgft_jax.models.config import network_of
from sgft_jax.models.distortion import Distortion, turned_and_scaled
from sgft_jax.models.networks import make_dynamics

NOTHING, ZERO = distortion.none(1, 1), jnp.zeros(1)


def believing(value, *, wish=0.5, scatter=0.0):
    """A point on a line that moves by the action, worth 1 - (action - 0.5)^2 a step, at gamma 0.5; V* is 2.

    scatter: how far the two models are off, to either side.
    """
    return Beliefs(
        value=lambda obs: jnp.float32(value) + 0.0 * obs[0],
        wish=lambda obs: jnp.full(1, wish),
        models=jnp.array([-scatter, scatter]),
        after=lambda model, obs, action: obs + action + model,
        drift=lambda obs, actions: jnp.arange(1.0, len(actions) + 1.0),
        reward=lambda obs, action, after: 1.0 - (action[0] - 0.5) ** 2,
        terminated=lambda obs, action, after: jnp.bool_(False),
        gamma=0.5,
    )


def best(beliefs, known=NOTHING, horizon=3):
    offsets = diagnosis.draw_offsets(jax.random.key(0), 256, 1)
    return diagnosis.headroom(beliefs, known, ZERO, offsets, horizon)


@pytest.mark.parametrize(
    ("value", "improvable", "improving"),
    [(2.0, 1.0, 0.0), (1.0, 1.0, 1.0), (4.0, 0.0, 0.0)],
    ids=["optimal", "pessimistic", "promises too much"],
)
def test_what_the_best_action_does_for_v_sim(value, improvable, improving):
    """After H steps of reward 1 at gamma 0.5: 2 (1 - 0.5^H) + 0.5^H V - V = (2 - V)(1 - 0.5^H)."""
    found = best(believing(value))
    np.testing.assert_allclose(found, (2.0 - value) * np.array([0.5, 0.75, 0.875]), atol=1e-4)
    shares = diagnosis.guidance(np.asarray(found), margin=0.01)
    assert shares == {"improvable": improvable, "improving": improving}


def test_actions_beside_the_policy_s_are_tried_within_what_the_system_makes_of_commands():
    """V of a policy that does nothing: 2 * (1 - 0.25) = 1.5. One best step gains 0.25, with a quarter of the reach
    0.25 - 0.0625.
    """
    idle = believing(1.5, wish=0.0)
    assert best(idle)[0] == pytest.approx(0.25, abs=0.01)
    assert best(idle, NOTHING._replace(matrix=jnp.full((1, 1), 0.25)))[0] == pytest.approx(0.1875, abs=1e-3)


def test_the_expectation_is_over_the_models():
    """Models 1 to either side of a value of s^2: E[0.5 (+-1 + 0.5)^2] = 0.5 * 1.25 where the action is 0.5."""
    torn = believing(0.0, scatter=1.0)._replace(value=lambda obs: obs[0] ** 2)
    found = diagnosis.headroom(torn, NOTHING, ZERO, jnp.zeros((1, 1)), 1)
    assert found[0] == pytest.approx(1.0 + 0.625)


def test_termination_ends_what_counts():
    over = believing(3.0)._replace(terminated=lambda obs, action, after: jnp.bool_(True))
    np.testing.assert_allclose(best(over), 1.0 - 3.0, atol=1e-4)


def rollouts(obs, action, after, *, reward=0.0, valid=None):
    """[n, T] episodes of these numbers."""
    shape = action.shape[:2]
    rows = Transition(obs, action, jnp.full(shape, reward), jnp.full(shape, 0.5), after)
    return Rollouts(rows, jnp.ones(shape, bool) if valid is None else valid, jnp.ones(shape[0], bool))


def test_promises_are_held_against_what_followed():
    """Reward 1 for ever at gamma 0.5 is worth 2; V_sim says 5, also of what comes after the last step."""
    zeros = jnp.zeros((2, 4, 1))
    values, returns = diagnosis.promises(believing(5.0), rollouts(zeros, zeros, zeros, reward=1.0))
    np.testing.assert_allclose(values, 5.0)
    np.testing.assert_allclose(returns, [2.0 + 3.0 * 0.5 ** np.array([4, 3, 2, 1])] * 2)
    flat, _ = rollouts(zeros, zeros, zeros, reward=1.0).flat()
    np.testing.assert_allclose(diagnosis.surprises(believing(5.0), flat), 1.0 + 2.5 - 5.0)


def test_bias_order_and_shortfall_of_v_sim():
    rng = np.random.default_rng(0)
    values, valid = rng.uniform(0, 10, (4, 6)), np.ones((4, 6), bool)
    valid[0, 3:] = False
    returns = np.where(valid, values - 3.0, 1e6)
    # A simulated rollout falls 1 short on average, with a standard deviation of 2 over rollouts.
    simulated = (np.zeros((2, 6)), np.repeat([[-3.0], [1.0]], 6, axis=1), np.ones((2, 6), bool))
    found = diagnosis.honesty((values, returns, valid), simulated)
    assert found == pytest.approx({"bias": 3.0, "rank_correlation": 1.0, "shortfall": (3.0 - 1.0) / 2.0})
    assert diagnosis.honesty((values, -values, valid), simulated)["rank_correlation"] == pytest.approx(-1.0)
    assert diagnosis.honesty((values, 0 * values, valid), simulated)["rank_correlation"] == 0


@pytest.mark.heavy
def test_model_errors_are_of_windows_within_the_episode():
    zeros = jnp.zeros((1, 20, 1))
    valid = (jnp.arange(20) < 15)[None]
    errors, windows = diagnosis.model_errors(believing(0.0), rollouts(zeros, zeros, zeros, valid=valid))
    np.testing.assert_array_equal(errors, np.tile([1.0, 2.0, 4.0, 8.0], (1, 2, 1)))
    assert windows.tolist() == [[True, False]]
    short = rollouts(*[zeros[:, :3]] * 3)
    np.testing.assert_array_equal(diagnosis.model_errors(believing(0.0), short)[0], [[[1.0, 2.0, 3.0, 3.0]]])


def test_the_numbers_behind_a_distortion():
    known = turned_and_scaled(jnp.float32(0.4), jnp.log(jnp.array([1.5, 0.5])), jnp.array([0.1, 0.0]), jnp.ones(3))
    found = diagnosis.parts(known, turns=True)
    assert found["scale"] == pytest.approx([1.5, 0.5], rel=1e-5) and found["rotation"] == pytest.approx(0.4, rel=1e-5)
    assert found["bias"] == pytest.approx([0.1, 0.0]) and found["sensor_errors"] == [1.0] * 3
    assert diagnosis.parts(distortion.none(1, 1), turns=False)["rotation"] == 0.0


def moved(share, key, *, jitter=0.003, usual=0.0):
    """Episodes of a point that moves by what is commanded, `share` of it one step late."""
    key_action, key_noise = jax.random.split(key)
    action = jax.random.uniform(key_action, (4, 20, 2), minval=-1.0)
    before = jnp.concatenate([jnp.zeros((4, 1, 2)), action[:, :-1]], axis=1)
    moves = action + share * (before - action) + jitter * jax.random.normal(key_noise, action.shape)
    obs = jnp.cumsum(moves, axis=1) - moves
    return rollouts(obs, action, obs + moves)


@jax.jit
def lateness(rollouts, usual=0.0):
    """Where a step changes what is commanded."""
    return diagnosis.lateness(lambda obs, action: action, rollouts, jnp.full(2, 0.01), usual)


@pytest.mark.heavy
@pytest.mark.parametrize("share", [0.0, 0.3, 0.8])
def test_a_delay_is_found_and_its_evidence(share):
    late = lateness(moved(share, jax.random.key(1)))
    assert late.share == pytest.approx(share, abs=0.02)
    assert late.nats > 50 if share else late.nats < 1
    used_to_it = lateness(moved(share, jax.random.key(1)), share)
    assert used_to_it.share == pytest.approx(share, abs=0.02) and used_to_it.nats < 1


def test_a_step_without_a_valid_predecessor_says_nothing_of_delays():
    some = moved(0.5, jax.random.key(1))
    gaps = some._replace(valid=jnp.broadcast_to(jnp.arange(20) % 2 == 0, (4, 20)))
    assert lateness(gaps).nats == 0


def test_noise_is_read_where_little_moves():
    rng = np.random.default_rng(0)
    expected = rng.normal(0, [1.0, 0.0], (4000, 2))
    noisy = rng.normal(0, [0.02, 0.005], (4001, 2))
    wrong = 1.3 * expected  # a model that is off where things move
    np.testing.assert_allclose(diagnosis.noise(expected, wrong + np.diff(noisy, axis=0)), [0.05, 0.005], rtol=0.6)
    np.testing.assert_allclose(diagnosis.noise(expected, expected + np.diff(noisy, axis=0)), [0.02, 0.005], rtol=0.1)


# --- all of it, through a prior ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def examiner():
    card = {**tuners.prior().card, "system": []}
    return Examiner(card, tuners.TASK)


def agreed():
    """Parameters of a prior whose models agree."""
    params = tuners.prior().params
    return params._replace(dynamics=jax.tree.map(lambda x: jnp.stack([x[0], x[0]]), params.dynamics))


def played(key, known, n=4, noise=0.0):
    """Episodes of a system that the prior's models describe exactly, behind a distortion."""
    params = agreed()
    model = make_dynamics(2, 2, network_of(tuners.prior().card))
    member = jax.tree.map(lambda x: x[:1], params.dynamics)
    rows = jax.tree.map(lambda x: x.reshape(n, tuners.T, *x.shape[1:]), tuners.episode(key, n * tuners.T))

    def after(obs, command):
        return dynamics.predict(model, member, params.normalizer, obs, known.meaning(command))[0]

    rows = rows._replace(next_obs=jax.vmap(jax.vmap(after))(rows.obs, rows.action))
    rows = rows._replace(next_obs=rows.next_obs + noise * jax.random.normal(key, rows.next_obs.shape))
    return Rollouts(rows, jnp.ones((n, tuners.T), bool), jnp.arange(n) % 2 == 0)


def members(*trees):
    """Stacked on an axis of members."""
    return jax.tree.map(lambda *x: jnp.stack(x), *trees)


def twice(tree):
    """The one member two times."""
    return jax.tree.map(lambda x: jnp.concatenate([x, x]), tree)


def found(examined):
    """What was found of each member."""
    return [own.statistics for own in examined]


@pytest.mark.slow
def test_an_examination_names_the_scale_and_counts_the_rollouts_it_is_given(examiner):
    weak = Distortion(jnp.diag(jnp.array([0.6, 1.0])), jnp.zeros(2), jnp.zeros(2))
    turned = Distortion(jnp.array([[0.0, -1.0], [1.0, 0.0]]), jnp.zeros(2), jnp.zeros(2))
    params, simulated = members(agreed()), members(played(jax.random.key(0), distortion.none(2, 2), 8))
    control = examiner.control(params, simulated)
    both = [played(jax.random.key(1), weak), played(jax.random.key(4), turned)]
    first, second = found(examiner.examine(twice(params), twice(control), members(*both), (1, 3)))
    assert second[1]["identified"]["rotation"] == pytest.approx(jnp.pi / 2, abs=0.05)  # each member has its own rows
    one, three = first
    assert (one["rollouts"], one["success"]) == (1, 1.0) and three["success"] == pytest.approx(2 / 3)
    assert one["value"]["bias"] != three["value"]["bias"]
    assert three["identified"]["scale"] == pytest.approx([0.6, 1.0], abs=0.03) and three["identified"]["nats"] > 20
    real, identified, usual = (three["model_error"][name][0] for name in ("real", "identified", "simulated"))
    assert usual < 1e-6 and identified < 0.1 * real
    assert three["identified"]["simulated"]["scale"] == [1.0, 1.0]
    overshoots = played(jax.random.key(3), Distortion(1.4 * jnp.eye(2), jnp.zeros(2), jnp.zeros(2)), 8)
    overshoots = members(overshoots)
    ((used_to_it,),) = found(examiner.examine(params, examiner.control(params, overshoots), overshoots, (8,)))
    assert used_to_it["identified"]["scale"] == used_to_it["identified"]["simulated"]["scale"] != [1.0, 1.0]
    assert used_to_it["delay"]["share"] == 0.0
    ((nothing,),) = found(examiner.examine(params, control, simulated, (8,)))
    assert nothing["identified"]["scale"] == [1.0, 1.0] and nothing["value"]["shortfall"] == pytest.approx(0, abs=1e-4)
    assert nothing["value"]["real"] == nothing["value"]["simulated"]
    trembling = members(played(jax.random.key(2), distortion.none(2, 2), noise=0.1))
    ((noisy,),) = found(examiner.examine(params, control, trembling, (4,)))
    assert min(noisy["noise"]["real"]) > 5 * max(noisy["noise"]["simulated"]) and noisy["noise"]["real"][0] < 0.15


def test_a_task_without_a_reward_function_is_refused():
    with pytest.raises(UserError, match="`reward` and `terminated`"):
        diagnosis.beliefs_of(tuners.prior().params, tuners.prior().card, tuners.TASK._replace(reward=None))
