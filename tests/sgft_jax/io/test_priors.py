"""Priors on disk, and what is said of those that do not fit."""

import functools
import json
import os
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tuners
import untrained
from test_checkpoint import bits, damage_flip, damage_truncate

from envs.types import UserError
from sgft_jax.files.disk import ASIDE, jsonable
from sgft_jax.io import checkpoint, priors
from sgft_jax.learners import recurrent, sac, tdmpc2, tdmpc2_model
from sgft_jax.models.config import NetworkConfig
from sgft_jax.models.distortion import Distortion
from sgft_jax.policies import ActorParams, make_actor_of
from sgft_jax.types import Normalizer, Prior

KEY = jax.random.key(0)
NETWORK = NetworkConfig(hidden=(3,))
CARD = {
    "task": "hammer",
    "obs_dim": 4,
    "act_dim": 2,
    "gamma": 0.99,
    "network": jsonable(NETWORK),
    "metrics": {"success": float("nan")},
}


def drawn(init):
    """Numbers in the shapes of what `init` makes, which is not compiled."""
    return jax.tree.map(lambda x: jnp.arange(x.size, dtype=x.dtype).reshape(x.shape), jax.eval_shape(init, KEY))


@functools.cache
def of_sac(network):
    config = sac.SACConfig(4, 2, network=network, ensemble_size=2)
    return drawn(lambda key: untrained.sac_params(config, key))


def make_prior(scale=1.0, network=NETWORK, **changes):
    params = jax.tree.map(lambda x: scale * x, of_sac(network))
    statistics = Normalizer(jnp.zeros(4), jnp.ones(4))
    return Prior(params._replace(normalizer=statistics, dynamics=None), CARD | {"network": jsonable(network)} | changes)


def save(folder, *args, **changes):
    return priors.save_prior(folder, make_prior(*args, **changes))


def test_prior_round_trip(tmp_path):
    folder = save(tmp_path / "run" / "prior", 2.0)
    prior = priors.load_prior(folder, task="hammer", obs_dim=4, act_dim=2)
    assert bits(prior.params) == bits(make_prior(2.0).params)
    assert prior.card == {**CARD, "metrics": {"success": "nan"}}
    assert json.loads((folder / "prior.json").read_text())["task"] == "hammer"
    assert bits(priors.load_prior(tmp_path / "run").params) == bits(prior.params)


@pytest.mark.heavy
def test_every_learner_that_leaves_a_prior_names_its_container(tmp_path):
    planner = {"size": tuners.TINY, "plan_samples": 24, "horizon": 2}
    learner = tdmpc2.make_tdmpc2(tdmpc2_model.named_config(4, 2, **planner))
    memory = recurrent.make_recurrent(recurrent.RecurrentConfig(4, 2, NETWORK, 6))
    params = drawn(lambda key: tdmpc2.extract_params(learner.init(key)))
    every = {
        "tdmpc2": (params, {"config": planner}),
        "anchored": (params._replace(anchor=params.policy), {"config": planner, "algorithm": "tdmpc2"}),
        "recurrent": (drawn(lambda key: recurrent.extract_params(memory.init(key))), {"config": {"gru": 6}}),
        "actor": (
            ActorParams(drawn(make_actor_of("affine", 4, 2, NETWORK).init), make_prior().params.normalizer),
            {"head": "affine"},
        ),
    }
    for name, (parameters, says) in every.items():
        folder = priors.save_prior(tmp_path / name, Prior(parameters, CARD | {"algorithm": name} | says))
        assert bits(priors.load_prior(folder).params) == bits(parameters)


def test_what_a_prior_does_not_have_is_none(tmp_path):
    params = make_prior().params._replace(value={})
    folder = priors.save_prior(tmp_path / "prior", Prior(params, CARD))
    loaded = priors.load_prior(folder).params
    assert loaded.value is None and loaded.dynamics is None
    assert bits(loaded) == bits(params._replace(value=None))


def test_a_critic_may_have_networks_of_its_own(tmp_path):
    """As that of `rlpd` has, which its fine-tuned policies keep."""
    wide = NetworkConfig(hidden=(5,), layer_norm=True)
    prior = make_prior(critic_network=jsonable(wide))
    wider = Prior(prior.params._replace(critic=of_sac(wide).critic), prior.card)
    priors.save_prior(tmp_path / "wide", wider)
    jax.tree.map(np.testing.assert_array_equal, priors.load_prior(tmp_path / "wide").params, wider.params)
    priors.save_prior(tmp_path / "lies", Prior(wider.params, CARD))
    with pytest.raises(UserError, match=r"critic.* has shape .*5.*, expected .*3.* for its card"):
        priors.load_prior(tmp_path / "lies")


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


@pytest.mark.parametrize("algorithm", ["ppo", "../x", "losses", "os"])
def test_a_prior_of_an_unknown_algorithm_is_refused(tmp_path, algorithm):
    folder = save(tmp_path / "prior", algorithm=algorithm)
    with pytest.raises(UserError, match=f"prior.json says algorithm='{algorithm}', which this version does not know"):
        priors.load_prior(folder)


def test_a_prior_of_another_format_is_refused_in_one_line(tmp_path):
    folder = save(tmp_path / "prior")
    path, number = folder / "manifest.json", checkpoint.FORMAT - 1
    path.write_text(json.dumps(json.loads(path.read_text()) | {"format": number}))
    with pytest.raises(UserError) as refused:
        priors.load_prior(folder)
    assert str(refused.value) == (
        f"{folder}: written in format {number}, this version reads format {checkpoint.FORMAT} alone; begin again, or "
        "use the version that wrote it"
    )


def test_a_prior_of_another_version_is_refused_in_one_line(tmp_path):
    folder = save(tmp_path / "prior")
    manifest = json.loads((folder / "manifest.json").read_text())
    leaves = [[path.replace("value/", "baseline/"), *rest] for path, *rest in manifest["leaves"]]
    (folder / "manifest.json").write_text(json.dumps(manifest | {"leaves": leaves}))
    with pytest.raises(UserError, match=r"prior: holds baseline, which this version does not know; pretrain again$"):
        priors.load_prior(folder)


def test_a_prior_whose_card_lies_is_refused(tmp_path):
    with pytest.raises(UserError, match=r"prior: its card says obs_dim=3, the statistics have 4"):
        priors.load_prior(save(tmp_path / "prior", obs_dim=3))


BODY = {"hidden": [3]}
LIES = {
    "algorithm null": {"algorithm": None},
    "algorithm a number": {"algorithm": 3},
    "another algorithm": {"algorithm": "tdmpc2", "config": {"size": tuners.TINY, "plan_samples": 24, "horizon": 2}},
    "no head": {"algorithm": "actor"},
    "head": {"algorithm": "actor", "head": "hydra"},
    "no memory": {"algorithm": "recurrent"},
    "memory null": {"algorithm": "recurrent", "config": {"gru": None}},
    "memory without units": {"algorithm": "recurrent", "config": {"gru": 0}},
    "no planner": {"algorithm": "tdmpc2", "config": {}},
    "size": {"algorithm": "tdmpc2", "config": {"size": "6M", "plan_samples": 24, "horizon": 2}},
    "task null": {"task": None},
    "task a number": {"task": 3},
    "network null": {"network": None},
    "network a list": {"network": [3]},
    "no widths": {"network": {}},
    "widths empty": {"network": {"hidden": []}},
    "width 0": {"network": {"hidden": [0]}},
    "width a float": {"network": {"hidden": [2.5]}},
    "width a text": {"network": {"hidden": ["3"]}},
    "widths a number": {"network": {"hidden": 3}},
    "another width": {"network": {"hidden": [4]}},
    "critic of another width": {"critic_network": {"hidden": [4]}},
    "another depth": {"network": {"hidden": [3, 3]}},
    "layer norm": {"network": BODY | {"layer_norm": True}},
    "layer norm a text": {"network": BODY | {"layer_norm": "yes"}},
    "activation": {"network": BODY | {"activation": "gelu"}},
    "unknown key": {"network": BODY | {"dropout": 0.1}},
    "obs_dim null": {"obs_dim": None},
    "obs_dim negative": {"obs_dim": -4},
    "obs_dim true": {"obs_dim": True},
    "act_dim 0": {"act_dim": 0},
    "act_dim another": {"act_dim": 3},
    "act_dim huge": {"act_dim": 10**15},
    "gamma 1": {"gamma": 1.0},
    "gamma negative": {"gamma": -0.1},
    "gamma nan": {"gamma": "nan"},
    "gamma null": {"gamma": None},
    "previous_actions null": {"previous_actions": None},
    "previous_actions negative": {"previous_actions": -1},
    "previous_actions too many": {"previous_actions": 2},
    "previous_actions very many": {"previous_actions": 10**9},
    "system null": {"system": None},
    "system a text": {"system": "mass"},
    "system of nothing": {"system": [{}]},
    "system of more": {"system": [{"name": "mass", "index": 0, "low": 0, "high": 1, "unit": "kg"}]},
    "system upside down": {"system": [{"name": "mass", "index": 0, "low": 1, "high": 0}]},
    "system too long": {"system": 4 * [{"name": "mass", "index": 0, "low": 0, "high": 1}]},
    "gap a text": {"gap": "ice"},
    "gap without a name": {"gap": {"params": {}, "effects": {}, "scene": ""}},
    "gap with a scene that is none": {"gap": {"name": "ice", "params": {}, "effects": {}, "scene": None}},
    "gap with a list of params": {"gap": {"name": "ice", "params": [], "effects": {}, "scene": ""}},
    "plan a number": {"plan": 3},
    "plan of more": {"plan": {"horizon": 2, "gamma": 0.5}},
    "plan without end": {"plan": {"horizon": 10**12}},
    "ensemble_size 0": {"ensemble_size": 0},
}


@pytest.mark.heavy_after_first
@pytest.mark.parametrize("lie", LIES)
def test_a_card_that_lies_is_refused_in_one_line(shared, lie):
    (shared / "prior.json").write_text(json.dumps(jsonable(CARD | LIES[lie])))
    with pytest.raises(UserError, match="prior") as refused:
        priors.load_prior(shared)
    assert "\n" not in str(refused.value) and str(shared) in str(refused.value)


@pytest.mark.parametrize("content", ["", "[" * 100_000, "null", "3", '{"task": "push", "task": "hammer"}', "\xff"])
def test_a_card_that_is_no_object_is_refused_in_one_line(shared, content):
    (shared / "prior.json").write_text(content, encoding="latin1")
    with pytest.raises(UserError, match=r"prior\.json: ") as refused:
        priors.load_prior(shared)
    assert "\n" not in str(refused.value)


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    """A whole prior, whose card the tests write."""
    return save(tmp_path_factory.mktemp("shared") / "prior")


ZEROS = np.zeros(4, np.float32)
ODD = {
    "no actor": ({"actor": None}, "prior actor.* has shape None, expected"),
    "actor of one array": ({"actor": ZEROS}, "prior actor.* has shape"),
    "critic of one number": ({"critic": {"Dense_0": np.zeros((), np.float32)}}, "prior critic"),
    "half a value": ({"value": {"Dense_0": {"kernel": np.zeros((4, 3), np.float32)}}}, "prior value"),
    "no statistics": ({"normalizer": None}, "not a prior: it has no observation statistics"),
    "half of them": ({"normalizer": {"mean": ZEROS}}, "its normalizer is not of mean, std"),
    "std of 3": ({"normalizer": Normalizer(ZEROS, ZEROS[:3])}, "normalizer has the shapes"),
    "std nan": (
        {"normalizer": Normalizer(ZEROS, ZEROS + np.float32("nan"))},
        "normalizer/std holds numbers that are not",
    ),
    "std whole": ({"normalizer": Normalizer(ZEROS, np.ones(4, np.int32))}, "normalizer.std is not float32"),
    "distortion of one array": ({"distortion": ZEROS}, "its distortion is not of matrix, bias, offset"),
    "distortion of 3": (
        {"distortion": Distortion(np.eye(3, dtype="f4"), ZEROS[:3], ZEROS)},
        "distortion has the shapes",
    ),
    "offsets of 3": (
        {"distortion": Distortion(np.eye(2, dtype="f4"), ZEROS[:2], ZEROS[:3])},
        "distortion has the shapes",
    ),
    "mean of two parts": ({"normalizer": Normalizer({"x": ZEROS}, ZEROS)}, "the statistics have"),
    "system that nobody tells": ({"system": ZEROS}, "system has the shapes"),
}


@pytest.mark.parametrize("odd", ODD)
def test_numbers_that_are_not_those_of_the_card_are_refused(tmp_path, odd):
    changes, words = ODD[odd]
    changes = jax.tree.map(jnp.asarray, changes)
    folder = priors.save_prior(tmp_path / "prior", Prior(make_prior().params._replace(**changes), CARD))
    with pytest.raises(UserError, match=f"prior: .*{words}"):
        priors.load_prior(folder)


def test_no_memory_is_taken_for_what_few_bytes_claim(tmp_path, monkeypatch):
    """A card and a manifest that agree on networks of a gigabyte, with some kB behind them."""
    folder, network = save(tmp_path / "prior"), NetworkConfig(hidden=(2**12, 2**14))
    wide = jax.eval_shape(lambda: make_prior(network=network).params)
    leaves = [checkpoint.describe(path, x) for path, x in jax.tree_util.tree_leaves_with_path(wide)]
    manifest = json.loads((folder / "manifest.json").read_text())
    (folder / "manifest.json").write_text(json.dumps(manifest | {"leaves": [list(leaf) for leaf in leaves]}))
    (folder / "prior.json").write_text(json.dumps(jsonable(CARD | {"network": jsonable(network)})))
    monkeypatch.setattr(checkpoint.ocp, "load", lambda path: pytest.fail("numbers were read"))
    with pytest.raises(UserError, match=r"prior: [\d,]+ bytes claim to hold 1,\d{3},\d{3},\d{3}; no real data pack so"):
        priors.load_prior(folder)


def test_a_folder_of_something_else_is_not_replaced(tmp_path):
    save(tmp_path / "run/seed-0")
    (tmp_path / "run/notes.txt").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(UserError, match="run: holds something else than a prior; choose another folder"):
        save(tmp_path / "run")
    assert sorted(tmp_path.rglob("*")) == before
    (tmp_path / "file").write_text("mine")
    with pytest.raises(UserError, match="file: is no folder"):
        save(tmp_path / "file")
    (tmp_path / "empty").mkdir()
    assert priors.load_prior(save(tmp_path / "empty")).card["task"] == "hammer"


def test_a_prior_that_a_killed_writer_has_put_aside_is_read(tmp_path):
    for folder in (tmp_path / "seed-0", tmp_path / "run" / "prior"):
        save(folder, 2.0)
        folder.rename(folder.with_name(f"{ASIDE}{folder.name}"))
    for folder in (tmp_path / "seed-0", tmp_path / "run"):
        assert bits(priors.load_prior(folder).params) == bits(make_prior(2.0).params)
        assert priors.variant_of([folder]) == {"previous_actions": 0, "system": (), "sparse": False}
    save(tmp_path / "seed-0", 3.0)
    assert sorted(os.listdir(tmp_path)) == ["run", "seed-0"]


def test_a_torn_prior_is_refused(tmp_path):
    folder = save(tmp_path / "prior")
    damage_truncate(folder)
    with pytest.raises(UserError, match="torn"):
        priors.load_prior(folder)
    damage_flip(save(folder))
    with pytest.raises(UserError, match=r"prior: damaged: .* \(checksum differs\)$"):
        priors.load_prior(folder)
    with pytest.raises(UserError, match="no such folder"):
        priors.load_prior(tmp_path / "elsewhere")


def test_a_checkpoint_is_not_a_prior(tmp_path):
    checkpoint.save(tmp_path, 20, make_prior().params, meta={})
    with pytest.raises(UserError, match=r"prior.json: no such file"):
        priors.load_prior(tmp_path / "checkpoints" / "20")


def test_where_no_prior_is_or_several_are_is_said(tmp_path):
    with pytest.raises(UserError, match=r"shipped:push: holds priors, name one of them, such as shipped:push/seed-0$"):
        priors.load_prior("shipped:push")
    save(tmp_path / "run/prior/seed-3")
    for folder, rest in ((tmp_path / "run", "prior/seed-3"), (tmp_path / "run/prior", "seed-3")):
        with pytest.raises(UserError, match=f"{folder}: holds priors, name one of them, such as {folder}/{rest}$"):
            priors.load_prior(folder)
    with pytest.raises(UserError, match=r"gone: no such folder$"):
        priors.load_prior(tmp_path / "gone")


def test_a_prior_needs_its_card_and_plain_dicts(tmp_path):
    with pytest.raises(ValueError, match="act_dim"):
        priors.save_prior(tmp_path / "prior", Prior(make_prior().params, {"task": "hammer", "obs_dim": 4}))
    with pytest.raises(ValueError, match="gamma"):
        priors.save_prior(tmp_path / "prior", Prior(make_prior().params, {k: CARD[k] for k in CARD if k != "gamma"}))
    with pytest.raises(TypeError, match="dicts of arrays"):
        priors.save_prior(tmp_path / "prior", Prior(make_prior().params._replace(dynamics=(jnp.ones(2),)), CARD))
    assert not list(tmp_path.iterdir())


@pytest.mark.heavy
def test_priors_that_are_used_together_have_one_structure(tmp_path):
    env = SimpleNamespace(name="hammer", obs_dim=4, act_dim=2)
    folders = [save(tmp_path / f"seed-{i}", float(i)) for i in range(2)]
    loaded = priors.load_priors(folders, env)
    assert [bits(prior.params) for prior in loaded] == [bits(make_prior(float(i)).params) for i in range(2)]
    ice = {"name": "ice", "params": {}, "effects": {}, "scene": ""}
    odd = save(tmp_path / "seed-2", network=NetworkConfig(hidden=(9,)), gamma=0.5, plan={"horizon": 2}, gap=ice)
    with pytest.raises(UserError, match=r"seed-2: differs from .*seed-0 in gamma, gap, network, plan; choose one"):
        priors.load_priors([*folders, odd], env)
    with pytest.raises(UserError, match="act_dim=2 where act_dim=3 is needed"):
        priors.load_priors(folders, SimpleNamespace(name="hammer", obs_dim=4, act_dim=3))
