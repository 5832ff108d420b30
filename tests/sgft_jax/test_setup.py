"""The short way in from Python."""

import pytest

import envs
import sgft_jax
from envs.types import UserError

SHIPPED = "shipped:hammer/seed-0"


def test_a_prior_says_how_its_task_is_made():
    """The policy of this prior also reads its last two commands, of three numbers each."""
    prior = sgft_jax.load_prior(SHIPPED)
    env = sgft_jax.make_env(prior)
    assert (env.obs_dim, env.measured_dim, env.previous_actions) == (18, 12, 2)
    assert env.name == "hammer"


def test_a_task_that_is_observed_in_another_way_is_said_in_one_line():
    env = envs.make("hammer")
    gap = envs.gaps.load(env, "default")
    expected = r"observes 18 numbers, the task as it was made 12; make it with sgft_jax.make_env\(prior\)"
    with pytest.raises(UserError, match=expected):
        sgft_jax.setup(env, gap, sgft_jax.load_prior(SHIPPED))
