"""Priors on disk, and what is said of those that do not fit."""

import json
import os
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pytest
from test_checkpoint import bits, damage_truncate

from sgft_jax.io import checkpoint, priors
from sgft_jax.learners.sac import SACParams
from sgft_jax.learners.tdmpc2_model import TDMPC2Params
from sgft_jax.types import Normalizer, Prior, UserError

CARD = {"task": "hammer", "obs_dim": 4, "act_dim": 2, "gamma": 0.99, "metrics": {"success": float("nan")}}


def make_prior(scale=1.0, **changes):
    dense = {"Dense_0": {"kernel": scale * jnp.arange(12.0).reshape(4, 3), "bias": jnp.zeros(3)}}
    params = SACParams(
        actor=dense,
        critic=jax.tree.map(lambda x: jnp.stack([x, x]), dense),
        value=dense,
        dynamics=None,
        normalizer=Normalizer(jnp.zeros(4), jnp.ones(4)),
    )
    return Prior(params, CARD | changes)


def save(folder, *args, **changes):
    return priors.save_prior(folder, make_prior(*args, **changes))


def test_prior_round_trip(tmp_path):
    folder = save(tmp_path / "run" / "prior", 2.0)
    prior = priors.load_prior(folder, task="hammer", obs_dim=4, act_dim=2)
    assert bits(prior.params) == bits(make_prior(2.0).params)
    assert prior.card == {**CARD, "metrics": {"success": "nan"}}
    assert json.loads((folder / "prior.json").read_text())["task"] == "hammer"
    assert bits(priors.load_prior(tmp_path / "run").params) == bits(prior.params)


def test_every_learner_that_leaves_a_prior_names_its_container(tmp_path):
    fields: dict = {name: {"kernel": jnp.ones(2) * i} for i, name in enumerate(TDMPC2Params._fields)}
    params = TDMPC2Params(**fields | {"normalizer": Normalizer(jnp.zeros(4), jnp.ones(4)), "scale": jnp.float32(3)})
    folder = priors.save_prior(tmp_path / "prior", Prior(params, CARD | {"algorithm": "tdmpc2"}))
    assert bits(priors.load_prior(folder).params) == bits(params)


def test_what_a_prior_does_not_have_is_none(tmp_path):
    params = make_prior().params._replace(value={})
    folder = priors.save_prior(tmp_path / "prior", Prior(params, CARD))
    loaded = priors.load_prior(folder).params
    assert loaded.value is None and loaded.dynamics is None
    assert bits(loaded) == bits(params._replace(value=None))


def test_saving_a_prior_again_replaces_it(tmp_path):
    save(tmp_path / "prior", 1.0)
    save(tmp_path / "prior", 3.0)
    assert bits(priors.load_prior(tmp_path / "prior").params) == bits(make_prior(3.0).params)
    assert os.listdir(tmp_path) == ["prior"]


def test_a_digest_tells_priors_apart(tmp_path):
    prior = make_prior()
    loaded = priors.load_prior(save(tmp_path / "prior"))
    assert priors.digest(loaded) == priors.digest(prior) and len(priors.digest(prior)) == 12
    params = prior.params
    nudged = params.normalizer._replace(mean=params.normalizer.mean.at[0].add(1e-6))
    changed = [params._replace(normalizer=nudged), params._replace(value={"renamed": params.value})]
    others = [*(Prior(each, CARD) for each in changed), make_prior(3.0)]
    assert len({priors.digest(each) for each in [prior, *others]}) == 4


def test_a_foreign_prior_is_refused(tmp_path):
    folder = save(tmp_path / "prior")
    with pytest.raises(UserError, match=r"prior: does not fit: .*task='hammer' where task='push' is needed"):
        priors.load_prior(folder, task="push")
    with pytest.raises(UserError, match="obs_dim=4 where obs_dim=5 is needed"):
        priors.load_prior(folder, obs_dim=5)


@pytest.mark.parametrize("algorithm", ["ppo", "../x"])
def test_a_prior_of_an_unknown_algorithm_is_refused(tmp_path, algorithm):
    folder = save(tmp_path / "prior", algorithm=algorithm)
    with pytest.raises(UserError, match=f"prior.json says algorithm='{algorithm}', which this version does not know"):
        priors.load_prior(folder)


def test_a_prior_of_another_version_is_refused_in_one_line(tmp_path):
    folder = save(tmp_path / "prior")
    manifest = json.loads((folder / "manifest.json").read_text())
    leaves = [[path.replace("value/", "baseline/"), *rest] for path, *rest in manifest["leaves"]]
    (folder / "manifest.json").write_text(json.dumps(manifest | {"leaves": leaves}))
    with pytest.raises(UserError, match=r"prior: holds baseline, which this version does not know; pretrain again$"):
        priors.load_prior(folder)


def test_a_prior_whose_card_lies_is_refused(tmp_path):
    with pytest.raises(UserError, match="says obs_dim=3, the statistics have 4"):
        priors.load_prior(save(tmp_path / "prior", obs_dim=3))


def test_a_torn_prior_is_refused(tmp_path):
    folder = save(tmp_path / "prior")
    damage_truncate(folder)
    with pytest.raises(UserError, match="torn"):
        priors.load_prior(folder)
    with pytest.raises(UserError, match="no such folder"):
        priors.load_prior(tmp_path / "elsewhere")


def test_a_checkpoint_is_not_a_prior(tmp_path):
    checkpoint.save(tmp_path, 20, make_prior().params, meta={})
    with pytest.raises(UserError, match=r"prior.json: no such file"):
        priors.load_prior(tmp_path / "checkpoints" / "20")


def test_a_prior_needs_its_card_and_plain_dicts(tmp_path):
    with pytest.raises(ValueError, match="act_dim"):
        priors.save_prior(tmp_path / "prior", Prior(make_prior().params, {"task": "hammer", "obs_dim": 4}))
    with pytest.raises(ValueError, match="gamma"):
        priors.save_prior(tmp_path / "prior", Prior(make_prior().params, {k: CARD[k] for k in CARD if k != "gamma"}))
    with pytest.raises(TypeError, match="dicts of arrays"):
        priors.save_prior(tmp_path / "prior", Prior(make_prior().params._replace(dynamics=(jnp.ones(2),)), CARD))
    assert not list(tmp_path.iterdir())


def test_priors_that_are_used_together_have_one_structure(tmp_path):
    env = SimpleNamespace(name="hammer", obs_dim=4, act_dim=2)
    folders = [save(tmp_path / f"seed-{i}", float(i)) for i in range(2)]
    loaded = priors.load_priors(folders, env)
    assert [bits(prior.params) for prior in loaded] == [bits(make_prior(float(i)).params) for i in range(2)]
    odd = save(tmp_path / "seed-2", gamma=0.5, network={"hidden": [9]}, plan={"horizon": 2}, gap={"name": "ice"})
    with pytest.raises(UserError, match=r"seed-2: differs from .*seed-0 in gamma, gap, network, plan; choose one"):
        priors.load_priors([*folders, odd], env)
    with pytest.raises(UserError, match="act_dim=2 where act_dim=3 is needed"):
        priors.load_priors(folders, SimpleNamespace(name="hammer", obs_dim=4, act_dim=3))
