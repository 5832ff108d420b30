import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
from experiments.priors import find_priors

from envs.gaps import Gap
from envs.pools import heldout_worlds, load_gap, real_worlds, training_worlds
from experiments import algorithms, memory, stacking
from experiments.memory import reserve
from experiments.options import seed_list, seeds_name
from sgft_jax.io import checkpoint
from sgft_jax.io.config import config_to_json
from sgft_jax.learners.sac import SACConfig, extract_prior, make_sac
from sgft_jax.models.networks import NetworkConfig
from sgft_jax.types import UserError

NETWORK = NetworkConfig(hidden=(8,))


def save_prior(folder, seed, **changes):
    """An untrained prior of the toy task."""
    config = SACConfig(4, 2, network=NETWORK, ensemble_size=2)
    prior = extract_prior(make_sac(config).init(jax.random.key(seed)))
    card = {"task": "toy", "obs_dim": 4, "act_dim": 2, "network": config_to_json(NETWORK), "gamma": 0.9}
    checkpoint.save_prior(folder, prior, {**card, "ensemble_size": 2, "seed": seed, **changes})
    return prior


def test_names_of_seeds():
    assert seeds_name(seed_list(3, 1)) == "seed-3"
    assert seeds_name(seed_list(3, 4)) == "seeds-3-6"
    for bad in ((0, 0), (-1, 1)):
        with pytest.raises(UserError, match="at least one"):
            seed_list(*bad)


def test_keys_depend_on_seed_and_purpose_alone():
    keys = jax.random.key_data(stacking.seed_keys([0, 1, 2], 5))
    np.testing.assert_array_equal(keys[1:], jax.random.key_data(stacking.seed_keys([1, 2], 5)))
    assert len(np.unique(np.concatenate([keys, jax.random.key_data(stacking.seed_keys([0, 1, 2], 6))]), axis=0)) == 6


@pytest.mark.parametrize("seeds", [1, 3])
def test_over_seeds_is_a_loop_over_seeds(seeds):
    def add(shared, x, y):
        return shared + x, y.sum()

    x, y = jnp.arange(3.0)[:seeds], jnp.arange(6.0).reshape(3, 2)[:seeds]
    total, sums = stacking.over_seeds(add, seeds, shared=1)(jnp.float32(10), x, y)
    assert total.tolist() == [10, 11, 12][:seeds] and sums.tolist() == [1, 5, 9][:seeds]  # 0 + 1, 2 + 3, 4 + 5


def test_one_seed_keeps_its_conditions():
    one, two = (
        str(jax.make_jaxpr(stacking.over_seeds(lambda x: jax.lax.cond(x > 0, jnp.sin, jnp.cos, x), n))(jnp.ones(n)))
        for n in (1, 2)
    )
    assert "cond[" in one and "cond[" not in two


def test_priors_are_found_in_order(tmp_path):
    home = tmp_path / "pretrain/toy/fast"
    expected = {n: save_prior(home / run / "prior" / f"seed-{n}", n) for run, n in (("a", 10), ("a", 9), ("b", 2))}
    find = lambda prior: find_priors(prior, out=tmp_path, env=toy.make(), preset="fast")  # noqa: E731
    found, card = find(None)
    assert card["seed"] == 2 and algorithms.network_of(card) == NETWORK
    for prior, n in zip(found, (2, 9, 10), strict=True):
        jax.tree.map(np.testing.assert_array_equal, prior.actor, expected[n].actor)
    assert [len(find(home / p)[0]) for p in ("", "a", "a/prior", "a/prior/seed-9")] == [3, 2, 2, 1]


def test_what_is_wrong_with_priors_is_said(tmp_path):
    find = lambda prior=None: find_priors(prior, out=tmp_path, env=toy.make(), preset="cpu")  # noqa: E731
    with pytest.raises(UserError, match=r"holds no prior; make one with: .*--task toy --preset cpu"):
        find()
    save_prior(tmp_path / "p/seed-0", 0)
    save_prior(tmp_path / "p/seed-1", 1, gamma=0.8, network=config_to_json(dataclasses.replace(NETWORK, hidden=(9,))))
    with pytest.raises(UserError, match=r"seed-1: differs from .*seed-0 in network, gamma"):
        find(tmp_path / "p")
    save_prior(tmp_path / "q", 0, task="push")
    with pytest.raises(UserError, match="task='push' where task='toy'"):
        find(tmp_path / "q")


def test_exam_worlds_have_exact_sensors_in_simulation_only(tmp_path, key):
    (tmp_path / "g.toml").write_text("[params]\nmass = 2.0\nfriction = [3, 5]\n")
    env = toy.make()
    gap = load_gap(env, str(tmp_path / "g.toml"), ["mass=1.5"])
    assert load_gap(env, "sim", []) is None and load_gap(env, None, []) is None
    assert heldout_worlds(env, None, key, 3).theta.effects.high.obs_noise.tolist() == [0, 0, 0]
    assert training_worlds(env, None, key, 3).theta.effects.high.obs_noise.tolist() == pytest.approx([0.005] * 3)
    real = heldout_worlds(env, gap, key, 3)
    assert real.theta.params[:, 0].tolist() == [1.5] * 3
    assert float(real.theta.effects.high.obs_noise[0]) == pytest.approx(0.005)


def test_pools_of_different_size_are_brought_to_one(key):
    env, fixed = toy.make(), Gap("fixed", {"mass": 2.0, "friction": 4.0}, {"latency": 0.05})
    pools = real_worlds(env, [fixed, Gap("ranges", {"mass": [3.0, 4.0]}, {})], key, 5)
    np.testing.assert_array_equal(pools.theta.params[0], [[2.0, 4.0]] * 5)
    assert pools.theta.params.shape == (2, 5, 2) and len(np.unique(pools.theta.params[1, :, 0])) == 5
    np.testing.assert_allclose(pools.theta.effects.high.latency, [[0.05] * 5, [0.0] * 5])
    assert real_worlds(env, [fixed, fixed], key, 5).theta.params.shape == (2, 1, 2)


def test_a_budget_that_does_not_fit_names_the_largest_part(monkeypatch, capsys):
    parts = {"random_transitions": 2**30, "replay_capacity": 3 * 2**30}
    monkeypatch.setattr(memory, "free_memory", lambda: 5 * 2**30)
    reserve(parts, copies=2, devices=2)  # 4 GiB each
    assert capsys.readouterr().out == (
        "experience: 4.00 GiB of 5.00 GiB free on each device (random_transitions 1.00 GiB, replay_capacity 3.00 GiB)\n"
    )
    with pytest.raises(UserError, match=r"8\.00 GiB of 5\.00 GiB free on each device: lower --config\.replay-capacity"):
        reserve(parts, copies=2)
    monkeypatch.setattr(memory, "free_memory", lambda: None)
    reserve(parts, copies=2)  # nobody knows: the run may try
