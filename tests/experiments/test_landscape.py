"""The map of V_sim on the point mass: where the object is, the branches, and what cannot be drawn."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
from priors_by_hand import save_prior
from sgft_jax.players import Player

import envs
from envs.base import Entry
from experiments import cli, landscape
from sgft_jax.types import UserError

ENV = toy.make()


@pytest.fixture(autouse=True)
def _toy(monkeypatch):
    monkeypatch.setitem(envs.TASKS, "toy", "toy")
    monkeypatch.setattr(cli, "set_up", lambda: None)


def call(*argv):
    cli.run_main(landscape.main, landscape.LandscapeArgs, "Draw.", argv=[str(a) for a in argv])


def test_the_place_of_the_object_is_the_last_entry_with_two_numbers_or_the_one_named():
    assert landscape.find_entry(ENV, None) == (2, ENV.observation[1])
    assert landscape.find_entry(ENV, "xy") == (0, ENV.observation[0])
    with pytest.raises(UserError, match="did you mean 'xy'"):
        landscape.find_entry(ENV, "xyz")
    with pytest.raises(UserError, match="no entry of its observation has two numbers"):
        landscape.find_entry(ENV._replace(observation=(Entry("angle", "rad", 1),)), None)


def test_branches_follow_policy_and_model():
    """A policy that always says (0.1, 0) and a model that adds the action to the place."""
    player = Player(
        init_carry=lambda: (),
        act=lambda prior, carry, obs, key, *, explore: (jnp.array([0.1, 0.0]), carry),
        value=lambda prior, obs: jnp.float32(0),
        predict=lambda prior, obs, action, key: obs.at[:2].add(action),
        model_error=None,
    )
    obs = jnp.arange(12.0).reshape(3, 4)
    sizes = {"horizon": 2, "branches": 5, "gamma": 0.9}
    sure = landscape.imagine(ENV, player, None, obs, jax.random.key(0), noise=0.0, **sizes)
    steps = np.outer(np.arange(3), [0.1, 0, 0, 0])
    wanted = np.broadcast_to(np.asarray(obs)[:, None, None] + steps, (3, 5, 3, 4))
    np.testing.assert_allclose(sure, wanted, rtol=1e-5)
    noisy = landscape.imagine(ENV, player, None, obs, jax.random.key(0), noise=0.5, **sizes)
    assert len(np.unique(noisy[:, :, 1, 1])) == 15  # no branch is another's


def test_what_has_a_place_of_the_same_kind_moves_along():
    entries = (Entry("hand", "m", 2), Entry("angle", "rad", 1), Entry("object", "m", 2))
    moved = landscape._moved(ENV._replace(observation=entries), 3)
    there = moved(jnp.array([1.0, 2.0, 7.0, 3.0, 5.0]), jnp.array([4.0, 4.0]))
    assert there.tolist() == [2.0, 1.0, 7.0, 4.0, 4.0]


def test_a_figure_of_a_prior(tmp_path, capsys):
    save_prior(tmp_path / "prior/seed-0", 0)
    (tmp_path / "slow.toml").write_text("[params]\nmass = 9.0\nfriction = 4.0\n")
    call("--task", "toy", "--prior", tmp_path, "--real", tmp_path / "slow.toml", "--entry", "xy", "--out", tmp_path)
    path = tmp_path / "figures/landscape-toy-slow.png"
    assert path.stat().st_size > 10_000 and str(path) in capsys.readouterr().out


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--horizon", "0"], "--horizon is 0: must be at least 1"),
        (["--index", "3"], "--index 3: there are 1 priors, counted from 0"),
        (["--task", "toi"], "did you mean 'toy'?"),
    ],
)
def test_a_bad_command_is_one_line_and_code_2(argv, words, tmp_path, capsys):
    save_prior(tmp_path / "prior/seed-0", 0)
    with pytest.raises(SystemExit) as stopped:
        call("--task", "toy", "--prior", tmp_path, "--out", tmp_path, *argv)
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and words in error and error.count("\n") == 1
