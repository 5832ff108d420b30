"""The methods, their options, and what becomes of options that are left open."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tuners
from tuners import METHODS, T

from envs.types import UserError
from sgft_jax import methods, transforms
from sgft_jax.data import sources
from sgft_jax.methods import sgft_relabel, sgft_sac
from sgft_jax.train import options as rules

each_method = pytest.mark.parametrize("name", METHODS)


# --- the list -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_list_of_methods_is_complete():
    assert {name for name, method in METHODS.items() if not method.needs_prior} == {"sac", "rlpd", "iql", "tdmpc2"}
    assert {name for name, method in METHODS.items() if method.prior == "tdmpc2"} == tuners.PLANNERS
    tuned = {name: tuners.build(name) for name in METHODS}
    simulated = {name for name, fine in tuned.items() if fine.simulation}
    assert simulated == {"sac-online", "rlpd", "iql", "sgft-relabel", "sysid", "guarded"}
    assert {name for name, fine in tuned.items() if fine.initial_policy} == {"rlpd", "iql", "sgft-tdmpc2-code"}
    assert all(method.name == name and method.description and method.source for name, method in METHODS.items())


def has_help(kind, field):
    """Whether a string stands below the field in the source of this very class."""
    import inspect

    _, _, rest = inspect.getsource(kind).partition(f"    {field}: ")
    return rest.partition("\n")[2].lstrip().startswith('"""')


@pytest.mark.heavy_after_first
@each_method
def test_every_option_has_its_help_and_a_default(name):
    """Tyro reads the string below a field, of the class or of the nearest one that it derives from."""
    config = METHODS[name].config
    bases = config.__mro__[:-1]
    idle = [f.name for f in dataclasses.fields(config) if not any(has_help(kind, f.name) for kind in bases)]
    assert idle == []
    config()


def test_unknown_method_is_answered_with_the_closest():
    with pytest.raises(UserError, match=r"'sgft-sca'.*did you mean 'sgft-sac'.*pbrs"):
        methods.get_method("sgft-sca")


def test_only_sgft_sac_with_and_without_relabelling_and_planners_have_another_horizon_than_the_papers():
    own = {name: method.config() for name, method in METHODS.items() if method.prior == "sac"}
    longer = {name: config.horizon for name, config in own.items() if getattr(config, "horizon", 1) != 1}
    assert longer == {"sgft-sac": 4, "sgft-relabel": 4}
    assert (own["sgft-sac"].branches, own["sgft-sac"].lr_warmup, own["mbpo"].branches) == (2, 0, 5)


def test_sgft_relabel_is_sgft_sac_with_relabelled_rows_and_an_actor_that_does_not_wait():
    plain, own = sgft_sac.Config(), sgft_relabel.Config()
    differ = {f.name for f in dataclasses.fields(plain) if getattr(plain, f.name) != getattr(own, f.name)}
    assert differ == {"critic_warmup"} and own.critic_warmup == 0


@pytest.mark.parametrize(
    ("name", "options", "words"),
    [
        ("sgft-sac", {"horizon": 0}, "horizon is 0: must be at least 1"),
        ("mbpo", {"branches": 0}, "branches is 0: must be at least 1"),
        ("sac", {"ratio": True}, "ratio is True: must be off where simulated-share is 0"),
        ("rlpd", {"simulated_share": 1.5}, "simulated-share is 1.5: must be from 0 to 1"),
        ("sac", {"lr_warmup": -1}, "lr-warmup is -1: must be 0 or a positive number"),
        ("mbpo", {"dynamics_warmup": -1}, "dynamics-warmup is -1: must be 0 or a positive number"),
        ("sac", {"utd": float("nan")}, "utd is nan: must be a positive number"),
        ("tdmpc2", {"plan_samples": 7}, "plan-samples is 7: must be at least 8"),
    ],
)
def test_impossible_options_are_refused(name, options, words):
    with pytest.raises(UserError, match=words):
        METHODS[name].config(**options)


# --- options left open ----------------------------------------------------------------------------------------------


def hyper(fine, name):
    """The learner's numbers at the start."""
    data = tuners.simulated().of(0) if fine.simulation else None
    params = tuners.prior(METHODS[name].prior).params
    # Quicker than all of the state
    return jax.jit(lambda key: fine.prepare(fine.init(params, key), data).learner.hyper)(jax.random.key(0))


@pytest.mark.parametrize(
    ("name", "given", "resolved"),
    [
        # 2 rollouts of 12 steps, 0.5 updates a step
        ("sac", {"critic_warmup": None}, {"actor_start": 12, "lr_warmup": 500}),
        ("sac", {"critic_warmup": 7, "lr_warmup": 3}, {"actor_start": 7, "lr_warmup": 3}),
        ("sgft-sac", {"critic_warmup": None, "lr_warmup": 0}, {"actor_start": 12, "lr_warmup": 0}),
        ("sac-reset", {}, {"lr_warmup": 0}),  # a new critic has nothing to lose
        ("pbrs", {"lr_warmup": 9, "reset_critic": True}, {"lr_warmup": 0}),
        ("pbrs", {"lr_warmup": 9, "reset_critic": False}, {"lr_warmup": 9}),
        ("rlpd", {}, {"lr_warmup": 0, "actor_start": 0}),
        pytest.param("tdmpc2", {}, {"lr_warmup": 500}, marks=pytest.mark.slow),
        pytest.param("tdmpc2", {"lr_warmup": 4}, {"lr_warmup": 4}, marks=pytest.mark.slow),
        pytest.param("sgft-tdmpc2-code", {}, {"lr_warmup": 0}, marks=pytest.mark.slow),
    ],
)
def test_numbers_left_open_are_resolved_when_a_method_is_built(name, given, resolved):
    """`build` alone resolves them, so commands and library cannot differ."""
    own = {f.name for f in dataclasses.fields(METHODS[name].config)}
    open_ = {"lr_warmup": None, "dynamics_warmup": None}
    config = {key: value for key, value in open_.items() if key in own} | {"utd": 0.5, "initial_rollouts": 2} | given
    found = hyper(tuners.build(name, **config), name)
    assert {key: float(getattr(found, key)) for key in resolved} == resolved


@pytest.mark.parametrize(("given", "scale"), [(None, T / 200), (0.3, 0.3)])
def test_rewards_of_iql_span_the_length_of_an_episode(given, scale):
    """The simulator's returns are 100 to 300."""
    assert float(hyper(tuners.build("iql", reward_scale=given), "iql").reward_scale) == pytest.approx(scale)


def test_the_actor_moves_once_per_real_transition_if_nothing_else_is_said():
    rlpd, online = METHODS["rlpd"].config, METHODS["sac-online"].config
    assert [rules.policy_delay(rlpd(utd=utd)) for utd in (40.0, 20.0, 0.5)] == [40, 20, 1]
    assert [rules.policy_delay(online(utd=utd)) for utd in (2.0, 5.0)] == [20, 20]


@pytest.mark.parametrize(("name", "utd", "updates"), [("mbpo", 4.0, 4_000), ("sgft-mpc", 8.0, 0)])
def test_rates_of_models_rise_by_themselves(name, utd, updates):
    config = METHODS[name].config(utd=utd)
    assert rules.warmup(config, config.dynamics_warmup) == updates


def test_updates_follow_a_rollout():
    assert tuners.build("sac", utd=8.0).updates_per_rollout == 8 * T
    assert tuners.build("sac", utd=1e-9).updates_per_rollout == 1


# --- no option is idle ----------------------------------------------------------------------------------------------

# Another value for each option, and what must be so for it to matter.
OTHER = (
    {"batch_size": 6, "rows": 5, "replay_capacity": 40, "critics": 4, "target_critics": 2, "policy_delay": 2}
    | {"critic_network": dataclasses.replace(tuners.NET, hidden=(4,)), "fit": "dropo", "anchor": 0.5}
    | {"lr": 1e-2, "lr_actor": 1e-2, "lr_critic": 1e-2, "lr_dynamics": 1e-2, "max_grad_norm": 0.001}
    | {"actor_ramp": 50, "critic_warmup": 50, "lr_warmup": 50, "dynamics_warmup": 50, "offline_updates": 5}
    | {"tau": 0.2, "alpha": 0.3, "expectile": 0.9, "beta": 1.0, "reward_scale": 2.0, "utd": 0.5, "initial_rollouts": 3}
    | {"simulated_transitions": 36, "simulated_anneal": 80, "simulated_ladder": 0.1}
    | {"simulated_share": 0.25, "simulated_share_end": 0.4}
    | {"branches": 3, "branch_noise": 0.1, "clip_shaped": 0.01, "horizon": 3, "plan_samples": 32, "plan_noise": 0.1}
    | {"explore_noise": 0.1}
)
GIVEN = {
    "lr_warmup": {"reset_critic": False},
    "simulated_transitions": {"simulated_share": 0.5},
    "simulated_ladder": {"simulated_share": 0.5},
    "ratio": {"simulated_share": 0.5},
}


def other_value(field, value):
    return not value if isinstance(value, bool) else OTHER[field]


def outcome(case, state):
    """What some updates make of the networks, and how the agent then explores."""
    state = case.fine.observe(state, tuners.episode(jax.random.key(0)), jnp.ones(T, bool), jnp.float32(0))
    state, _ = case.fine.learn(state, jax.random.key(1), 2)
    act = case.fine.act(state, case.fine.init_carry(), jnp.array([0.3, -0.8]), jax.random.key(2), explore=True)
    return case.fine.export(state), act


def program(case, state):
    """What is compiled, as text: constants included."""
    data = case.data
    learn = jax.make_jaxpr(lambda state, key: case.plain.learn(state, key, 2, data))
    act = jax.make_jaxpr(lambda *x: case.plain.act(*x, explore=True))
    args = state, jax.random.key(0)
    rollout = tuners.episode(jax.random.key(0)), jnp.ones(T, bool), jnp.float32(0)
    seen = jax.make_jaxpr(case.plain.observe)(state, *rollout)
    return f"{seen} {learn(*args)} {act(state, case.plain.init_carry(), jnp.zeros(2), args[1])}"


@pytest.mark.slow
def test_without_the_ratio_sgft_relabel_is_what_it_was():
    """The same program, to the letter, as one of the transforms that it had before the option."""
    from sgft_jax.train.finetuner import sac_finetuner

    case = tuners.tuner("sgft-relabel")
    options, source = tuners.configure("sgft-relabel"), sources.mixture(8, 8)
    parts = (transforms.relabel(8), transforms.branch(2, 2, noise=0.5), transforms.shape, transforms.clip(2.0))
    rows = {"transforms": (*parts, transforms.shorten(2)), "source": lambda state: source}
    critic = {"horizon_dim": 2, "value_baseline": True}
    before = sac_finetuner(options, tuners.prior(), tuners.TASK, **rows, **critic, simulation=case.plain.simulation)
    start = case.plain.prepare(case.plain.init(case.params, jax.random.key(0)), case.data)
    assert program(case, start) == program(case._replace(plain=before), start)
    on = case._replace(plain=tuners.build("sgft-relabel", ratio=True))
    assert program(case, start) != program(
        on, on.plain.prepare(on.plain.init(case.params, jax.random.key(0)), case.data)
    )


@pytest.mark.heavy
@pytest.mark.parametrize("name", tuners.slow_but({*METHODS} - {"sgft-tdmpc2", "sgft-tdmpc2-code"}, METHODS))
def test_what_is_exported_acts_as_the_agent_does(name):
    """So evaluations play what is saved, in one program."""
    case = tuners.tuner(name)
    state, _ = case.fine.learn(tuners.started(case), jax.random.key(3))
    params, carries = case.fine.export(state), [case.fine.init_carry(), case.plain.policy.init_carry()]
    for i, obs in enumerate(jnp.array([[0.3, -0.8], [0.1, 0.5], [-0.7, 0.2]])):
        key = jax.random.key(i)
        action, carries[0] = case.fine.act(state, carries[0], obs, key, explore=False)
        exported, carries[1] = case.plain.policy.act(params, carries[1], obs, key, explore=False)
        np.testing.assert_allclose(action, exported, atol=1e-6)


def facts(fine):
    """What training loops and files read."""
    simulation = fine.simulation
    return fine.updates_per_rollout, fine.initial_rollouts, simulation, dict(fine.card)


@pytest.mark.heavy
@pytest.mark.parametrize("name", tuners.slow_but({"frozen-critic"}, METHODS))
def test_every_option_changes_something(name):
    """Either a fact that training loops read, the size of the state, the compiled program, or what is learned."""
    own = {f.name for f in dataclasses.fields(METHODS[name].config)}
    idle = []
    for field in dataclasses.fields(METHODS[name].config):
        if field.name == "through":  # needs a simulator that can be set to a state: tests/sgft_jax/test_sysid.py
            continue
        given = {key: value for key, value in GIVEN.get(field.name, {}).items() if key in own}
        base = tuners.tuner(name, **given)
        other = other_value(field.name, getattr(tuners.configure(name, **given), field.name))
        plain = tuners.build(name, **given | {field.name: other})
        idle += [] if differs(base, plain) else [field.name]
    assert not idle


def differs(base, plain):
    if facts(base.plain) != facts(plain):
        return True
    params = base.params

    def start(fine):
        return fine.prepare(fine.init(params, jax.random.key(0)), base.data)

    shapes = [jax.tree.map(jnp.shape, jax.eval_shape(lambda f=f: start(f))) for f in (base.plain, plain)]
    if shapes[0] != shapes[1]:
        return True
    before, after = start(base.plain), start(plain)
    if not tuners.equal(outcome(base, before), outcome(base, after)):
        return True  # a number in the state
    return program(base, before) != program(base._replace(plain=plain), before)
