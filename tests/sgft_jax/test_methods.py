"""The table of methods, and the settings that make one."""

import dataclasses

import pytest
import toy

from sgft_jax import methods
from sgft_jax.finetune import make_finetuner
from sgft_jax.types import UserError


@pytest.mark.parametrize(
    ("name", "value", "dynamics", "reset", "finite"),
    [
        ("sac", False, False, False, False),
        ("sac-reset", False, False, True, False),
        ("pbrs", True, False, True, False),
        ("mbpo", False, True, False, False),
        ("pbrs-branch", True, True, True, False),
        ("sgft", True, False, False, True),
        ("sgft-sac", True, True, False, True),
        ("sgft-relabel", True, True, False, True),
        ("frozen-critic", False, False, False, False),
        ("sac-online", False, False, False, False),
        ("rlpd", False, False, False, False),
        ("iql", False, False, False, False),
        ("tdmpc2", False, False, False, False),
        ("sgft-tdmpc2", False, False, False, False),
        ("sgft-tdmpc2-code", True, False, False, False),
        ("sgft-mpc", False, False, False, False),
    ],
)
def test_method_table(name, value, dynamics, reset, finite):
    m = methods.get_method(name)
    assert (m.uses_value, m.uses_dynamics, m.reset_critic, m.finite_horizon) == (value, dynamics, reset, finite)
    assert m.description and m.source


def test_the_table_is_complete():
    """The rows above are all there are."""
    (tested,) = (mark.args[1] for mark in test_method_table.pytestmark)
    assert {row[0] for row in tested} == set(methods.METHODS)
    own = {m.name: methods.finetune_config(m) for m in methods.METHODS.values()}
    assert {name for name, config in own.items() if config.needs_simulation} == {
        "sac-online", "rlpd", "iql", "sgft-relabel",
    }  # fmt: skip
    assert {m.name for m in methods.METHODS.values() if m.fresh} == {"rlpd", "iql", "sgft-tdmpc2-code"}
    assert {m.name for m in methods.METHODS.values() if m.prior == "tdmpc2"} == {
        "tdmpc2", "sgft-tdmpc2", "sgft-tdmpc2-code",
    }  # fmt: skip
    assert all(m.pilot.prior == m.prior and not m.pilot.fresh for m in methods.METHODS.values())


def test_a_methods_own_options_and_changes_to_them():
    rlpd = methods.finetune_config(methods.METHODS["rlpd"], target_critics=1)
    assert (rlpd.critics, rlpd.target_critics, rlpd.policy_delay, rlpd.simulated_share) == (10, 1, None, 0.5)
    assert methods.METHODS["rlpd"].utd == 20


def test_the_actor_moves_once_per_real_transition_if_nothing_else_is_said():
    rlpd, online = (methods.finetune_config(methods.METHODS[name]) for name in ("rlpd", "sac-online"))
    assert [methods.policy_delay(rlpd, utd) for utd in (40.0, 20.0, 0.5)] == [40, 20, 1]
    assert [methods.policy_delay(online, utd) for utd in (2.0, 5.0)] == [20, 20]


@pytest.mark.parametrize(
    ("name", "utd", "updates"),
    [("sac", 8.0, 8_000), ("mbpo", 4.0, 4_000), ("tdmpc2", 1.0, 1_000), ("sgft-sac", 8.0, 0)],
)
def test_rates_rise_over_the_first_thousand_real_transitions(name, utd, updates):
    assert methods.lr_warmup(methods.finetune_config(methods.get_method(name)), utd) == updates
    assert methods.lr_warmup(methods.FinetuneConfig(lr_warmup=7), utd) == 7


@pytest.mark.parametrize(("name", "updates"), [("mbpo", 4_000), ("sgft-sac", 4_000), ("sgft-mpc", 0)])
def test_rates_of_models_rise_by_themselves(name, updates):
    assert methods.dynamics_warmup(methods.finetune_config(methods.get_method(name)), 4.0) == updates
    assert methods.dynamics_warmup(methods.FinetuneConfig(lr_warmup=7, dynamics_warmup=3), 4.0) == 3


def test_only_sgft_sac_with_and_without_relabelling_and_planners_have_another_horizon_than_the_papers():
    own = {m.name: methods.finetune_config(m) for m in methods.METHODS.values() if m.agent != "tdmpc2"}
    longer = {name: config.horizon for name, config in own.items() if config.horizon != 1}
    assert longer == {"sgft-sac": 4, "sgft-relabel": 4}
    assert (own["sgft-sac"].branches, own["sgft-sac"].lr_warmup, own["mbpo"].branches) == (2, 0, 5)


def test_sgft_relabel_is_sgft_sac_with_relabelled_rows_and_an_actor_that_does_not_wait():
    plain, own = (methods.finetune_config(methods.METHODS[name]) for name in ("sgft-sac", "sgft-relabel"))
    assert dataclasses.replace(plain, relabel_simulated=True, critic_warmup=0) == own


@pytest.mark.parametrize("method", methods.METHODS.values(), ids=lambda method: method.name)
def test_what_tuning_chooses_from(method):
    """Spaces are of one size and hold the default, and with every value of theirs there is a learner."""
    default = methods.default_settings(method)
    assert len(method.space) == 5 and all(len(set(values)) == 3 for values in method.space.values())
    assert all(default[name] in values for name, values in method.space.items())
    assert all(utd > 0 for utd in method.space["utd"])
    for name, value in [(name, value) for name, values in method.space.items() if name != "utd" for value in values]:
        config = methods.finetune_config(method, **{name: value})
        make_finetuner(method, config, obs_dim=4, act_dim=2, reward=toy.reward, terminated=toy.success)


def test_unknown_method_is_answered_with_the_closest():
    with pytest.raises(UserError, match=r"'sgft-sca'.*did you mean 'sgft-sac'.*pbrs"):
        methods.get_method("sgft-sca")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"horizon": 0}, "horizon is 0: must be at least 1"),
        ({"simulated_share": 1.5}, "simulated_share is 1.5: must be a share from 0 to 1"),
        ({"lr_warmup": -1}, "lr_warmup is -1: must not be negative"),
        ({"dynamics_warmup": -1}, "dynamics_warmup is -1: must not be negative"),
        ({"offline_updates": 10}, "offline_updates needs the simulator's transitions"),
    ],
)
def test_impossible_options_are_refused(options, words):
    with pytest.raises(UserError, match=words):
        methods.FinetuneConfig(**options)
