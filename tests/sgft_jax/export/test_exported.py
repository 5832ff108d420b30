"""Exported policies do what the policies do: every kind of them, in every format that can hold it."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
import tuners
import untrained

import envs
from envs.base import Varying
from envs.files import read_json
from envs.observations import concealed, with_previous_actions, with_system
from envs.rollout import play_episode
from envs.types import UserError
from sgft_jax import api
from sgft_jax.export import exported, player
from sgft_jax.export.exported import Graph, Node, Slot, save_exported
from sgft_jax.files.disk import jsonable
from sgft_jax.learners import recurrent, sac, tdmpc2, tdmpc2_model
from sgft_jax.models import distortion
from sgft_jax.models.config import NetworkConfig
from sgft_jax.models.networks import make_actor, make_affine_actor, make_deterministic_actor
from sgft_jax.policies import ActorParams
from sgft_jax.types import Normalizer, Prior

EPISODES, STEPS = 50, 20
TOLD = (Varying("mass", 0, 0.8, 1.2), Varying("action_scale", 1, 0.5, 1.5))
NETWORK = NetworkConfig(hidden=(16, 8))
ACTORS = {
    "affine": functools.partial(make_affine_actor, output_gain=1.0),
    "gaussian": make_actor,
    "deterministic": make_deterministic_actor,
}


def drawn(init):
    """Random numbers in the shapes of what `init` makes, which is not compiled."""
    rng, shapes = np.random.default_rng(0), jax.eval_shape(init, jax.random.key(0))
    return jax.tree.map(lambda x: jnp.asarray(0.4 * rng.normal(size=x.shape), x.dtype), shapes)


def of_sac(env, network=NETWORK, *, plan=None, **changes):
    config = sac.SACConfig(env.obs_dim, env.act_dim, network=network, ensemble_size=2)
    params = drawn(lambda key: untrained.sac_params(config, key))
    return params._replace(**changes), {"network": jsonable(network), **({"plan": plan} if plan else {})}


def of_recurrent(env):
    config = recurrent.RecurrentConfig(env.obs_dim, env.act_dim, NETWORK, 6)
    params = drawn(lambda key: recurrent.extract_params(recurrent.make_recurrent(config).init(key)))
    return params, {"algorithm": "recurrent", "network": jsonable(NETWORK), "config": {"gru": 6}}


def of_actor(env, head):
    actor = drawn(ACTORS[head](env.obs_dim, env.act_dim, NETWORK).init)
    return ActorParams(actor, None), {"algorithm": "actor", "network": jsonable(NETWORK), "head": head}


def of_tdmpc2(env):
    own = {"size": tuners.TINY, "plan_samples": 24, "horizon": 2}
    learner = tdmpc2.make_tdmpc2(tdmpc2_model.named_config(env.obs_dim, env.act_dim, **own))
    params = drawn(lambda key: tdmpc2.extract_params(learner.init(key)))
    return params, {"algorithm": "tdmpc2", "config": own}


IDENTIFIED = distortion.turned_and_scaled(
    jnp.float32(0.4), jnp.array([0.3, -0.2]), jnp.array([0.1, -0.05]), jnp.array([0.02, -0.03, 0.0, 0.1])
)
OPEN, REMEMBERING = toy.make(), with_previous_actions(toy.make(), 3)
SEEING = with_system(REMEMBERING, TOLD)
network = functools.partial(dataclasses.replace, NETWORK)
CASES = {
    "plain": (OPEN, of_sac),
    "identified": (REMEMBERING, lambda env: of_sac(env, network(activation="silu"), distortion=IDENTIFIED)),
    "not-told": (SEEING, lambda env: of_sac(env, network(activation="tanh"))),
    "told": (SEEING, lambda env: of_sac(env, network(actor_layer_norm=True), system=jnp.array([0.5, -0.9]))),
    "recurrent": (REMEMBERING, of_recurrent),
    "affine": (OPEN, lambda env: of_actor(env, "affine")),
    "gaussian": (OPEN, lambda env: of_actor(env, "gaussian")),
    "deterministic": (REMEMBERING, lambda env: of_actor(env, "deterministic")),
    "elu": (OPEN, lambda env: of_sac(env, network(activation="elu", actor_layer_norm=True))),
}
FEW = ("identified", "recurrent", "affine")  # together they have everything but activations and what is told
PLANNING = {
    "sgft-mpc": (REMEMBERING, lambda env: of_sac(env, plan={"horizon": 2, "samples": 16, "noise": 0.3})),
    "tdmpc2": (OPEN, of_tdmpc2),
}


@functools.cache
def case(name):
    """The task of a policy and its prior: every number drawn, statistics far from 0 and 1."""
    env, make = {**CASES, **PLANNING}[name]
    params, card = make(env)
    statistics = Normalizer(jnp.linspace(-0.2, 0.3, env.obs_dim), jnp.linspace(0.4, 1.5, env.obs_dim))
    card = {"task": "toy", "obs_dim": env.obs_dim, "act_dim": env.act_dim, "gamma": 0.9, **card}
    return env, Prior(params._replace(normalizer=statistics), card)


@functools.cache
def recorded(name):
    """50 episodes of the policy in its task: what sensors reported [50, 20, 4] and what it did [50, 20, 2].

    The task itself puts previous actions into observations, and tells nothing of the system.
    """
    env, prior = case(name)
    policy, real = api.make_policy(prior.card, env), concealed(env)
    worlds = envs.sample_worlds(real, jax.random.key(1), EPISODES)
    act = functools.partial(policy.act, prior.params, explore=False)

    def play(key):
        return play_episode(real, worlds, act, policy.init_carry(), key, gamma=0.9).transitions

    rows = jax.jit(jax.vmap(play))(jax.random.split(jax.random.key(2), EPISODES))
    return np.asarray(rows.obs[..., : env.measured_dim]), np.asarray(rows.action)


def played(policy, episodes):
    """The actions of something with `reset` and `act`."""
    actions = []
    for episode in episodes:
        policy.reset()
        actions.append([policy.act(measured) for measured in episode])
    return np.array(actions)


def needs(to):
    for library in exported._NEEDS[to]:
        pytest.importorskip(library, reason="make setup EXTRAS=dev,export")


@pytest.mark.heavy
@pytest.mark.parametrize("to", ["numpy", "onnx"])
@pytest.mark.parametrize(
    "name", [case if case in FEW else pytest.param(case, marks=pytest.mark.slow) for case in CASES]
)
def test_an_exported_policy_acts_as_the_policy_does(name, to, tmp_path):
    """On 1,000 recorded observations, through the files, with what it remembers of an episode."""
    needs(to)
    env, prior = case(name)
    worst = save_exported(tmp_path / "out", prior, env, to)
    measured, wanted = recorded(name)
    assert wanted.shape == (EPISODES, STEPS, 2) and wanted.std() > 0.1
    np.testing.assert_allclose(played(player.Policy(tmp_path / "out"), measured), wanted, atol=1e-5)
    checked = read_json(tmp_path / "out/contract.json")["checked"]
    assert checked == {"observations": 1000, "largest_difference": worst, "limit": 1e-5}


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["identified", "recurrent"])
def test_so_does_one_for_jax(name, tmp_path):
    needs("jax")
    env, prior = case(name)
    save_exported(tmp_path / "out", prior, env, "jax")
    measured, wanted = recorded(name)
    np.testing.assert_allclose(played(player.Policy(tmp_path / "out"), measured), wanted, atol=1e-5)


@pytest.mark.parametrize("name", ["told", *(pytest.param(name, marks=pytest.mark.slow) for name in PLANNING)])
def test_a_step_of_the_function_for_jax_is_a_step_of_the_policy(name):
    """Also where flatbuffers is not installed. Plans draw; they are given the numbers that the contract promises."""
    env, prior = case(name)
    step, slots = jax.jit(exported.stepping(prior, env)), exported.slots_of(prior, env)
    state = {slot.name: jnp.zeros(slot.shape, slot.dtype) for slot in slots}
    acting, keys = api.ActingPolicy(prior, env), iter(range(5))
    own = acting._act
    assert all((leaf == 0).all() for leaf in jax.tree.leaves(acting._carry))
    acting._act = lambda params, carry, obs, key, explore: own(
        params, carry, obs, jax.random.fold_in(jax.random.key(0), next(keys)), explore=explore
    )
    for measured in np.random.default_rng(0).normal(size=(5, 4)).astype(np.float32):
        found = step({"measured": jnp.asarray(measured), **state})
        state = {slot.name: found[f"next_{slot.name}"] for slot in slots}
        np.testing.assert_allclose(found["action"], acting.act(measured), atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", PLANNING)
def test_a_policy_that_plans_goes_to_jax(name, tmp_path):
    env, prior = case(name)
    needs("jax")
    assert save_exported(tmp_path / "out", prior, env, "jax") <= 1e-5
    policy = player.Policy(tmp_path / "out")
    first, again = played(policy, np.zeros((2, 4, 4)))
    np.testing.assert_array_equal(first, again)
    assert read_json(tmp_path / "out/contract.json")["action_is"].startswith("a plan at every step")


@pytest.mark.parametrize("name", PLANNING)
def test_a_policy_that_plans_does_not_go_elsewhere(name, tmp_path):
    env, make = PLANNING[name]
    with pytest.raises(UserError, match="plans at every step, which only --to jax can export"):
        save_exported(tmp_path / "out", Prior(None, make(env)[1]), env, "numpy")
    assert not list(tmp_path.iterdir())


def test_the_contract_says_what_goes_in_and_out():
    env, prior = case("identified")
    found = jsonable(exported.contract(prior, env, "numpy"))
    entry = {"first": 0, "size": 2}
    assert found["observation"] == [
        {"name": "xy", "unit": "m", **entry},
        {"name": "velocity", "unit": "m/s", **entry, "first": 2},
    ]
    assert found["action"] == [{"name": "force", "unit": "4 N", **entry, "low": -1.0, "high": 1.0}]
    assert (found["control_period_s"], found["episode_steps"], found["to"]) == (0.1, 20, "numpy")
    assert found["action_is"].startswith("the mean action")
    assert found["state"] == [{"name": "previous_actions", "shape": [6], "dtype": "float32"}]
    assert found["inside"]["previous_actions"] == 3 and found["inside"]["system"] == []
    assert found["inside"]["normalisation"]["mean"][0] == pytest.approx(-0.2)
    np.testing.assert_allclose(found["inside"]["identified"]["matrix"], IDENTIFIED.matrix, rtol=1e-6)
    told = exported.contract(*reversed(case("told")), "numpy")["inside"]["system"]
    assert [(one["name"], one["index"], one["value"]) for one in told] == [
        ("mass", 0, pytest.approx(0.5)),
        ("action_scale", 1, pytest.approx(-0.9)),
    ]


BAD = [
    ([0.0, 0.0, 0.0], "reads 4 measured numbers, got shape \\(3,\\)"),
    ([[0.0] * 4], "reads 4 measured numbers, got shape \\(1, 4\\)"),
    ([[0.0, 0.0], [0.0]], "reads 4 measured numbers, got shape \\(\\)"),
    (None, "reads 4 measured numbers, got shape \\(\\)"),
    ("1234", "reads 4 measured numbers, got shape \\(\\)"),
    ({"xy": 0.0}, "reads 4 measured numbers, got shape \\(\\)"),
    (["a", 0, 0, 0], "reads 4 measured numbers, got str"),
    (["1", "2", "3", "4"], "reads 4 measured numbers, got str"),
    ([None, 0.0, 0.0, 0.0], "reads 4 measured numbers, got object"),
    ([1j, 0.0, 0.0, 0.0], "reads 4 measured numbers, got complex128"),
    ([0.0, 0.0, 0.0, np.nan], r"velocity\[1\] is not a finite number"),
    ([0.0, -np.inf, 0.0, 0.0], r"xy\[1\] is not a finite number"),
    ([0.0, 0.0, 1e300, 0.0], r"velocity\[0\] is 1e\+300: too large, at most 1e\+12"),
    ([0.0, 0.0, -1e38, 0.0], r"velocity\[0\] is -1e\+38: too large"),  # its square is not finite
    ([10**30, 0, 0, 0], "reads 4 measured numbers, got object"),
]


@pytest.mark.heavy
@pytest.mark.parametrize("explore", [False, True])
def test_bad_measurements_are_refused_and_not_remembered(tmp_path, explore):
    env, prior = case("recurrent")
    save_exported(tmp_path / "out", prior, env, "numpy")
    policy, measured = player.Policy(tmp_path / "out"), recorded("recurrent")[0]
    acting, untroubled = (api.ActingPolicy(prior, env) for _ in range(2))
    wanted = [untroubled.act(row, explore=explore) for row in measured[0, :2]]
    exact = [policy.act(row) for row in measured[0, :2]]
    policy.reset()
    np.testing.assert_array_equal(acting.act(measured[0, 0], explore=explore), wanted[0])
    policy.act(measured[0, 0])
    for bad, words in BAD:
        with pytest.raises(ValueError, match=words):
            policy.act(bad)
        with pytest.raises(UserError, match=words):
            acting.act(bad, explore=explore)
    np.testing.assert_array_equal(acting.act(measured[0, 1], explore=explore), wanted[1])
    np.testing.assert_array_equal(policy.act(measured[0, 1]), exact[1])


@pytest.mark.heavy
@pytest.mark.parametrize("sent", [[np.nan, 0.0], [0.0, 1e30], [0.0, -1.5], ["a", 0.0], [0.0, 0.0, 0.0], [None, 0.0]])
def test_what_cannot_have_been_sent_is_refused_and_not_remembered(tmp_path, sent):
    env, prior = case("identified")
    save_exported(tmp_path / "out", prior, env, "numpy")
    policy, other = player.Policy(tmp_path / "out"), player.Policy(tmp_path / "out")
    first, second = recorded("identified")[0][0, :2]
    policy.act(first), other.act(first)
    with pytest.raises(ValueError, match=r"force\[\d\] is|an action has 2 numbers"):
        policy.act(second, sent=sent)
    np.testing.assert_array_equal(policy.act(second, sent=[1.0, -1.0]), other.act(second, sent=[1.0, -1.0]))


def test_an_answer_that_is_not_finite_is_given_by_nobody(tmp_path):
    """A policy whose numbers were damaged, on a good measurement."""
    env, prior = case("identified")
    save_exported(tmp_path / "out", prior, env, "numpy")
    policy = player.Policy(tmp_path / "out")
    policy._step = lambda inputs: {"action": np.full(2, np.nan), "next_previous_actions": np.zeros(6)}
    broken = jax.tree.map(lambda x: x * jnp.nan, prior.params.actor)
    acting = api.ActingPolicy(Prior(prior.params._replace(actor=broken), prior.card), env)
    for one, kind in ((policy, ValueError), (acting, UserError)):
        with pytest.raises(kind, match="the policy has no finite answer to these measurements"):
            one.act(np.zeros(4))
    assert not acting._actions.any() and not policy._state["previous_actions"].any()


@pytest.mark.parametrize(
    "content",
    ["", "[" * 100_000, "null", "[]", "{}", '{"to": "wasm"}', "\xff", "WHOLE without state", "WHOLE to pickle"],
)
def test_a_contract_that_is_none_is_one_line(tmp_path, content):
    contract = jsonable(exported.contract(*reversed(case("plain")), "numpy"))
    if content.startswith("WHOLE"):
        changed = (
            {name: x for name, x in contract.items() if name != "state"}
            if "state" in content
            else contract | {"to": "pickle"}
        )
        content = json.dumps(changed)
    (tmp_path / "contract.json").write_text(content, encoding="latin1")
    with pytest.raises(ValueError, match=r"contract.json: is no contract of an exported policy") as refused:
        player.Policy(tmp_path)
    assert "\n" not in str(refused.value)


@pytest.mark.heavy
@pytest.mark.parametrize("name", ["identified", "recurrent", "affine"])
def test_what_was_really_sent_is_what_is_remembered(name, tmp_path):
    """As if the policy had given that action itself; a policy without memory acts as before."""
    env, prior = case(name)
    save_exported(tmp_path / "out", prior, env, "numpy")
    policy, other = player.Policy(tmp_path / "out"), player.Policy(tmp_path / "out")
    first, second = recorded(name)[0][0, :2]
    own = policy.act(first)
    other.act(first)
    sent = 0.5 * own
    for remembered in policy.contract["last_action"]:
        policy._state[remembered][: len(sent)] = sent
    expected, plain = policy.act(second), player.Policy(tmp_path / "out")
    np.testing.assert_array_equal(other.act(second, sent=sent), expected)
    plain.act(first)
    assert (np.abs(plain.act(second) - expected).max() > 1e-4) == (name != "affine")
    with pytest.raises(ValueError, match=r"an action has 2 numbers, got shape \(1,\)"):
        other.act(second, sent=[0.0])


def test_an_export_that_acts_differently_is_not_kept(tmp_path, monkeypatch):
    env, prior = case("affine")
    monkeypatch.setitem(player._OPERATORS, "Relu", lambda x: x)
    with pytest.raises(UserError, match=r"exported actions differ by .* from the policy's"):
        save_exported(tmp_path / "out", prior, env, "numpy")
    assert not list(tmp_path.iterdir())


def test_a_missing_library_is_named_before_anything_is_written(tmp_path, monkeypatch):
    env, prior = case("plain")
    monkeypatch.setattr(exported.importlib.util, "find_spec", lambda name: None)
    for to, missing in (("onnx", "onnx and onnxruntime"), ("jax", "flatbuffers")):
        with pytest.raises(UserError, match=f"--to {to} needs {missing}: make setup EXTRAS=dev,export"):
            save_exported(tmp_path / "out", prior, env, to)
    assert not list(tmp_path.iterdir())


def test_operators_of_numpy_are_those_of_onnx():
    """Each on a vector with both signs and a large number, by itself."""
    onnxruntime = pytest.importorskip("onnxruntime", reason="make setup EXTRAS=dev,export")
    pytest.importorskip("onnx", reason="make setup EXTRAS=dev,export")
    x = np.float32([-30.0, -0.5, 0.0, 2.0])
    more = {
        **{name: [np.float32([1, -2, 3, 4])] for name in ("Add", "Sub", "Mul", "Div")},
        "MatMul": [np.arange(12, dtype=np.float32).reshape(4, 3)],
        "LayerNormalization": [np.float32([1, 2, 3, 4]), np.float32([0, 1, 0, 1])],
        "Clip": [np.float32(-1), np.float32(1)],
        "Concat": [np.float32([7])],
        "Gather": [np.array([3, 0])],
    }
    for name, operator in player._OPERATORS.items():
        others = more.get(name, [])
        expected = operator(x, *others)
        constants = {f"c{i}": value for i, value in enumerate(others)}
        nodes = (Node(name, ("x", *constants), "y"),)
        graph = Graph((Slot("x", x.shape, "float32"),), constants, nodes, (Slot("y", expected.shape, "float32"),))
        session = onnxruntime.InferenceSession(exported.onnx_model(graph), providers=["CPUExecutionProvider"])
        np.testing.assert_allclose(session.run(["y"], {"x": x})[0], expected, rtol=1e-5, atol=1e-6, err_msg=name)
