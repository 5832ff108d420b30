"""Fine-tuning by the posterior: every rollout is told, and the policy acts behind what is chosen."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
import untrained

from envs import gaps
from envs.rollout import real_worlds
from sgft_jax.data import replay
from sgft_jax.data.replay import blank
from sgft_jax.files.disk import jsonable
from sgft_jax.io import priors
from sgft_jax.io.priors import load_prior, load_priors, save_prior
from sgft_jax.learners.sac import SACConfig
from sgft_jax.methods import get_method
from sgft_jax.models import distortion
from sgft_jax.models.config import NetworkConfig
from sgft_jax.posterior import estimator, interface
from sgft_jax.posterior.estimator import MOST
from sgft_jax.posterior.interface import entry_of
from sgft_jax.posterior.trust import AS_IS, CORRECTED, FITTED
from sgft_jax.systems.simulated import Simulated
from sgft_jax.train import finetuning
from sgft_jax.train.simulation import SimulatedRows
from sgft_jax.types import Batch, Normalizer, Prior, SimulatedData, UserError

TOY = toy.make()
NET = NetworkConfig(hidden=(8,))


@functools.cache
def small_estimator():
    """One that has learned nothing."""
    entry = entry_of(TOY)
    zeros = estimator.shaped(entry["steps"], entry["measured"], 2, len(entry["unknowns"]))
    keys = iter(jax.random.split(jax.random.key(0), len(jax.tree.leaves(zeros))))
    return jax.tree.map(lambda x: 0.1 * jax.random.normal(next(keys), x.shape), zeros)._replace(
        statistics=estimator.Statistics(jnp.zeros(4), jnp.ones(4), jnp.ones(4))
    )


@functools.cache
def prior(known=True):
    params = untrained.sac_params(SACConfig(4, 2, network=NET, ensemble_size=2), jax.random.key(1))
    still, learned = Normalizer(jnp.zeros(4), jnp.ones(4)), small_estimator() if known else None
    card = {"task": "toy", "obs_dim": 4, "act_dim": 2, "gamma": 0.9, "algorithm": "sac", "network": jsonable(NET)}
    card |= {"estimator": entry_of(TOY)} if known else {}
    return Prior(params._replace(normalizer=still, estimator=learned), card)


def build(known=True, task=TOY, card=None, **options):
    method = get_method("posterior")
    start = prior(known)
    return method.build(method.config(**options), Prior(start.params, card or start.card), task)


def real(**effects):
    gap = gaps.from_dict(TOY, "real", {"effects": effects})
    return Simulated(TOY, real_worlds(TOY, [gap], jax.random.key(0)), jnp.zeros(2, int), gamma=0.9)


@pytest.mark.heavy
def test_every_rollout_is_remembered_and_chooses_anew():
    fine, seeds = build(), jnp.array([0, 1], jnp.uint32)
    start, system = jax.tree.map(lambda x: x[None], prior().params), real(action_scale=0.7)
    episode = replay.add_episode(replay.init(blank(4, 2), 20), rows(jax.random.key(0), 20), jnp.ones(20, bool))
    simulation = SimulatedRows(jax.tree.map(lambda x: x[None], episode), jnp.zeros((1, 1)))
    states = list(finetuning.finetune(fine, system, start, seeds, rollouts=2, simulated=lambda: simulation))
    progress, metrics = states[-1]
    known = progress.agent.agent.interface
    assert known.count.tolist() == [2, 2]
    assert known.rollouts.valid[:, :2].all() and not known.rollouts.valid[:, 2:].any()
    for name in ("as_is", "corrected", "fitted"):
        assert ((metrics[f"posterior/{name}"] >= 0) & (metrics[f"posterior/{name}"] <= 1)).all()
    for which, undo in ((CORRECTED, known.distortion), (FITTED, known.fit.distortion)):
        exported = jax.vmap(lambda state, which=which: fine.export(state._replace(incumbent=jnp.int32(which))))(
            progress.agent
        )
        assert exported.estimator is None and jax.tree.map(jnp.array_equal, exported.distortion, undo)
        np.testing.assert_array_equal(exported.actor["Dense_0"]["kernel"][0], prior().params.actor["Dense_0"]["kernel"])
    exported = jax.vmap(lambda state: fine.export(state._replace(incumbent=jnp.int32(AS_IS))))(progress.agent)
    assert not exported.distortion.bias.any(), "the prior as it is corrects nothing"


def rows(key, n):
    """Of a system that pays for nothing."""
    obs, action = jax.random.normal(key, (n, 4)), jax.random.uniform(key, (n, 2), minval=-1.0)
    return blank(4, 2)._replace(
        obs=obs, action=action, reward=jnp.zeros(n), discount=jnp.full(n, 0.9), next_obs=obs + 0.1
    )


def simulated():
    return SimulatedData(lambda key, n: Batch(*rows(key, n)), jnp.zeros(1))


@pytest.mark.heavy
@pytest.mark.parametrize("fits", [True, False])
def test_what_fits_real_steps_is_tried_where_the_others_fail_and_deployed_once_it_succeeds(fits, monkeypatch):
    """And there is no fit where no correction explains them better than none."""
    monkeypatch.setattr(distortion, "_EVIDENCE", -1e6 if fits else 1e6)
    fine, key = build(), jax.random.key(0)
    state = fine.prepare(fine.init(prior().params, key), simulated())
    begun, state = state, jax.jit(fine.observe)(state, rows(key, 20), jnp.ones(20, bool), jnp.float32(0))
    kinds = [[jax.typeof(x) for x in jax.tree.leaves(y)] for y in (begun, state)]
    assert kinds[0] == kinds[1], "another rollout would compile everything again"
    known = state.agent.interface
    assert jnp.isnan(known.promised[FITTED]) != fits
    lost = state._replace(trust=state.trust._replace(lost=jnp.array([9.0, 9.0, 0.0]), log_odds=jnp.float32(-9)))
    after = jax.jit(fine.observe)(lost, rows(key, 20), jnp.ones(20, bool), jnp.float32(0))
    assert (after.challenger == FITTED) == fits and after.incumbent == AS_IS
    undo = after.agent.interface.fit.distortion
    assert not fits or jax.tree.all(jax.tree.map(jnp.array_equal, fine.trial(after).distortion, undo))
    metrics = fine.learn(after, key, 1, simulated())[1]
    assert metrics["posterior/tried"] == after.challenger and metrics["posterior/deployed"] == AS_IS
    assert metrics["posterior/contradicted"] in (0, 1) and metrics["posterior/changed"] in (0, 1)
    won = jax.jit(fine.observe)(after, rows(key, 20), jnp.ones(20, bool), jnp.float32(1))
    assert won.incumbent == after.challenger


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("starts", "count", "wanted"),
    [
        ([0.5] * 10, 10, range(10)),  # always the same system
        ([0.1, 0.9] * 5, 10, range(10)),  # never the same, but not one after another
        ([0.1] * 6 + [0.9] * 4, 10, range(7, 10)),  # another one since the last four
        ([0.1, 0.1, 0.1, 0.9, 0.9, 0.9, 0, 0, 0, 0], 6, range(3, 6)),
        ([0.9] * 2 + [0.1] * 5 + [0.9] * 3, 12, [7, 8, 9, 0, 1]),  # the eleventh and twelfth replaced the first two
        ([0.1] + [0.9] * 9, 1, [0]),
    ],
)
def test_where_the_system_has_changed_later_rollouts_count(starts, count, wanted, monkeypatch):
    """A posterior whose system is where rollouts start, within .1 of their mean, and none contradicts itself by 2."""

    def mean(rollouts, counts):
        return jnp.sum(rollouts.measured[:, 0, 0] * counts) / jnp.maximum(counts.sum(), 1)

    def nats(known, rollouts, counts, point):
        return -0.5 * ((point - mean(rollouts, counts)) / 0.1) ** 2

    monkeypatch.setattr(estimator, "log_density", nats)
    monkeypatch.setattr(
        estimator, "draw", lambda known, rollouts, counts, d, key, n: jnp.full((n, 1), mean(rollouts, counts))
    )
    rollouts = estimator.blank(MOST, 20, 4, 2)
    rollouts = rollouts._replace(measured=rollouts.measured + jnp.array(starts)[:, None, None])
    known = small_estimator()._replace(usual=jnp.full(MOST, 2.0))
    age = (count - 1 - jnp.arange(MOST)) % MOST
    current = interface._current(known, rollouts, jnp.arange(MOST) < count, age, 1, jax.random.key(0))
    assert jnp.flatnonzero(current).tolist() == sorted(wanted)


def test_a_log_without_success_chooses_nothing():
    fine = build()
    state = fine.init(prior().params, jax.random.key(0))
    after = fine.observe(state, rows(jax.random.key(0), 20), jnp.ones(20, bool), None)
    assert after.agent.interface.count == 0 and jnp.isnan(after.agent.interface.promised).all()
    assert after.trust.log_odds == state.trust.log_odds


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"known": False}, "no estimator; `python -m experiments.estimate"),
        ({"task": TOY._replace(score="return")}, "judged by its return"),
        ({"task": object()}, "no simulator"),
        ({"task": TOY._replace(episode_length=21)}, "knows other systems than toy"),
        ({"task": TOY._replace(parameters=TOY.parameters[:1])}, "knows other systems than toy"),
    ],
)
def test_what_cannot_be_is_one_line(options, words):
    with pytest.raises(UserError, match=words):
        build(**options)


def test_a_prior_keeps_its_estimator_on_disk(tmp_path):
    folder = save_prior(tmp_path / "prior", prior())
    again = load_prior(folder)
    assert again.card["estimator"] == entry_of(TOY)
    half = estimator.at_half_precision(prior().params.estimator)
    assert jax.tree.all(jax.tree.map(jnp.array_equal, again.params.estimator, half))
    assert {x.dtype for x in jax.tree.leaves(again.params)} == {jnp.dtype("float32")}
    (other,) = load_priors([folder], TOY)
    assert other.params.estimator is None


def test_only_an_estimator_is_of_half_precision(tmp_path, monkeypatch):
    """Files in other precisions, as no version writes them."""
    whole = Prior(prior().params._replace(actor=jax.tree.map(jnp.float16, prior().params.actor)), prior().card)
    with pytest.raises(UserError, match=r"actor.* is not float32; take another prior"):
        load_prior(save_prior(tmp_path / "half", whole))
    monkeypatch.setattr(priors, "_ESTIMATOR", "float32")
    folder = save_prior(tmp_path / "whole", prior())
    monkeypatch.undo()
    with pytest.raises(UserError, match=r"estimator.* is not float16; take another prior"):
        load_prior(folder)


def test_an_estimator_that_the_card_does_not_describe_is_refused(tmp_path):
    for card, words in (
        ({"estimator": None}, "of which its card says nothing"),
        ({"estimator": entry_of(TOY) | {"steps": 7}}, "estimator"),
    ):
        folder = save_prior(tmp_path / words[:4], Prior(prior().params, prior().card | card))
        with pytest.raises(UserError, match=words):
            load_prior(folder)
