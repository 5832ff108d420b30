"""Gymnasium environments as real systems: the episodes of `Simulated`, stepped from Python."""

import functools
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy
import toy_terminating
import tuners

from envs.base import Entry
from envs.gaps import Gap
from envs.observations import with_previous_actions
from envs.rollout import real_worlds
from envs.types import Policy, UserError
from sgft_jax import api
from sgft_jax.learners.sac import SACConfig, extract_params, make_sac
from sgft_jax.models.config import NetworkConfig
from sgft_jax.systems.gymnasium import Gymnasium, seed_of
from sgft_jax.systems.simulated import Simulated, System
from sgft_jax.train.finetuning import finetune
from sgft_jax.types import Prior

gymnasium = pytest.importorskip("gymnasium", reason="make setup EXTRAS=dev, or pip install 'sgft-jax[gymnasium]'")

adapters = importlib.import_module("envs.adapters.gymnasium")
spaces, TaskEnv, TaskVectorEnv = gymnasium.spaces, adapters.TaskEnv, adapters.TaskVectorEnv
AutoresetMode, SyncVectorEnv = gymnasium.vector.AutoresetMode, gymnasium.vector.SyncVectorEnv

GAMMA, MEMBERS, EPISODES = 0.9, 2, 2
TURNED = Gap("turned", {"mass": [0.8, 2.0]}, {"action_rotation": 0.4, "obs_noise": 0.02})
ALARM = Gap("alarm", {"risk": 0.15}, {})


def wandering(actions):
    """A policy that depends on all it is given: its state, what it remembers, the observation, its key."""

    def act(state, carry, obs, key, *, explore):
        noise = jnp.where(explore, 0.5, 0.0) * jax.random.normal(key, (actions,))
        return jnp.tanh(state * obs.sum() + 0.1 * carry + noise), carry + 1.0

    return Policy(lambda: jnp.zeros(()), act)


def sync(make, gap, mode):
    return SyncVectorEnv([lambda: TaskEnv(make(), gap)] * MEMBERS, autoreset_mode=mode)


REAL = {
    "each": lambda make, gap: [TaskEnv(make(), gap) for _ in range(MEMBERS)],
    "vector": lambda make, gap: TaskVectorEnv(make(), gap, num_envs=MEMBERS),
    "next step": lambda make, gap: sync(make, gap, AutoresetMode.NEXT_STEP),
    "same step": lambda make, gap: sync(make, gap, AutoresetMode.SAME_STEP),
}


@pytest.mark.heavy
@pytest.mark.parametrize("real", tuners.slow_but({"vector", "same step"}, REAL))
@pytest.mark.parametrize(
    ("make", "gap"), [(toy_terminating.make, ALARM), pytest.param(toy.make, TURNED, marks=pytest.mark.slow)]
)
def test_out_and_in_again_plays_the_episodes_of_the_simulation(make, gap, real):
    """Also where policies see their last two actions, and where episodes end at different steps."""
    env = with_previous_actions(make(), 2)
    policy, states = wandering(env.act_dim), jnp.array([0.3, -0.7])
    keys = jax.random.split(jax.random.key(3), (MEMBERS, EPISODES))
    same = jax.vmap(jax.vmap(lambda key: jax.random.key(seed_of(key))))(keys)
    simulated = Simulated(env, real_worlds(env, [gap], jax.random.key(0)), jnp.zeros(MEMBERS, int), gamma=GAMMA)
    system = Gymnasium(env, REAL[real](make, gap), gamma=GAMMA)
    for explore in (True, False):
        expected = simulated.play(policy, states, same, explore=explore)
        found = system.play(policy, states, keys, explore=explore)
        for name in ("transitions", "valid", "total_reward", "success", "exploded", "score"):
            pair = getattr(found, name), getattr(expected, name)
            jax.tree.map(functools.partial(np.testing.assert_allclose, atol=2e-5), *pair)
        assert jax.tree.map(jnp.shape, found.world) == (MEMBERS, EPISODES)
    system.close()


class Spoken(gymnasium.Env):
    """Counts steps in each part of its observation; ends, and says of a step, what it is told to."""

    def __init__(self, observation=None, low=-1.0, high=1.0, ends=None, says=()):
        self.observation_space = observation or spaces.Box(-9, 9, (4,), np.float32)
        self.action_space = spaces.Box(low, high, (2,), np.float32)
        self.ends, self.says, self.actions = ends, dict(says), []

    def seen(self):
        def full(space):
            return np.full(space.shape, float(self.time), space.dtype)

        return full(self.observation_space)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.time = 0
        return self.seen(), {}

    def step(self, action):
        self.time += 1
        self.actions.append(action)
        over = self.time == 3
        told = self.says.get(self.time, {})
        return (
            self.seen(),
            10.0 * self.time,
            over and self.ends == "terminated",
            over and self.ends == "truncated",
            told,
        )


class Parts(Spoken):
    """The same in parts, which stand in another order than the task's."""

    def __init__(self):
        parts = {"velocity": spaces.Box(-9, 9, (2,)), "xy": spaces.Box(-9, 9, (2,))}
        super().__init__(spaces.Dict(parts))

    def seen(self):
        return {"velocity": np.array([1.0, 2.0], np.float32), "xy": np.array([3.0, 4.0], np.float32)}


STILL = Policy(lambda: (), lambda state, carry, obs, key, *, explore: (jnp.array([0.5, -1.0]), carry))


def play(real, env=None, policy=STILL, members=1, **options):
    """One episode of one member."""
    system = Gymnasium(env or toy.make(), real, gamma=GAMMA, **options)
    keys = jax.random.split(jax.random.key(0), (members, 1))
    episode = system.play(policy, jnp.zeros(members), keys, explore=False)
    return jax.tree.map(lambda x: np.asarray(x[0, 0]), episode)


def test_actions_reach_the_bounds_of_the_space():
    """From [-1, 1]: 0.5 is three quarters of the way from 0 to 4, -1 the lower bound."""
    real = Spoken(low=np.array([0, -3], np.float32), high=np.array([4, 3], np.float32))
    episode = play(real)
    np.testing.assert_allclose(real.actions[0], [3.0, -3.0])
    assert real.actions[0].dtype == np.float32
    np.testing.assert_allclose(episode.transitions.action[0], [0.5, -1.0])  # what the policy chose is what is kept


def test_no_action_goes_beyond_the_bounds_of_the_space():
    """Whatever the policy asks for; what was sent is learned from, and remembered."""
    far = Policy(lambda: (), lambda state, carry, obs, key, *, explore: (jnp.array([7.0, -9.0]), carry))
    real = Spoken(low=np.array([0, -3], np.float32), high=np.array([4, 3], np.float32), ends="truncated")
    episode = play(real, policy=far)
    assert real.actions[0].tolist() == [4.0, -3.0]
    assert episode.transitions.action[0].tolist() == [1.0, -1.0] and episode.command[0].tolist() == [7.0, -9.0]


def test_the_command_is_kept_beside_what_was_sent():
    """Both in [-1, 1]: the middle of the bounds is 0."""
    bounds = {"low": np.array([0, -3], np.float32), "high": np.array([4, 3], np.float32)}
    episode = play(Spoken(ends="truncated", says={2: {"sent": np.array([2.0, 0.0])}}, **bounds))
    np.testing.assert_allclose(episode.command[:4], [[0.5, -1.0]] * 3 + [[0.0, 0.0]])
    np.testing.assert_allclose(episode.transitions.action[:3], [[0.5, -1.0], [0.0, 0.0], [0.5, -1.0]])


def test_the_environments_own_reward_is_recorded():
    episode = play(Spoken(ends="truncated"))
    np.testing.assert_allclose(episode.transitions.reward[:4], [10.0, 20.0, 30.0, 0.0])
    assert episode.total_reward == 60.0


@pytest.mark.parametrize(("ends", "discount"), [("terminated", 0.0), ("truncated", GAMMA)])
def test_only_a_termination_zeroes_the_discount(ends, discount):
    episode = play(Spoken(ends=ends))
    assert episode.valid.tolist() == [True] * 3 + [False] * 17
    np.testing.assert_allclose(episode.transitions.discount[:4], [GAMMA, GAMMA, discount, 0.0])
    np.testing.assert_allclose(episode.transitions.next_obs[2], 3.0)  # the true successor
    assert not episode.transitions.obs[3:].any()


def test_the_task_ends_what_does_not_end_by_itself():
    assert play(Spoken()).valid.sum() == 20


def test_a_dict_is_flattened_in_the_order_of_the_task():
    np.testing.assert_allclose(play(Parts()).transitions.obs[0], [3.0, 4.0, 1.0, 2.0])


def test_a_function_of_ones_own_maps_observations():
    real = Spoken(spaces.Dict({"camera": spaces.Box(0, 255, (8, 8))}))
    real.seen = lambda: {"camera": np.full((8, 8), 2.0)}
    episode = play(real, observe=lambda obs: obs["camera"][0, :4])
    np.testing.assert_allclose(episode.transitions.obs[0], 2.0)


@pytest.mark.parametrize(
    ("says", "success"),
    [
        ({3: {"is_success": True}}, True),
        ({2: {"success": True}, 3: {"success": False}}, False),
        ({3: {"is_success": False, "success": True}}, False),
    ],
)
def test_info_says_what_success_is(says, success):
    """At the last step. Of two words the first counts, and both before the task's own function."""
    episode = play(Spoken(ends="truncated", says=says))
    assert bool(episode.success) == success and episode.score == float(success)


def test_success_at_any_step_where_the_task_says_so():
    env = toy.make()._replace(success_anytime=True)
    assert play(Spoken(ends="truncated", says={2: {"success": True}, 3: {"success": False}}), env).success


def test_the_task_says_what_success_is_where_info_does_not():
    """A point that ends at (3, 3) is not at the origin; one that ends at (0, 0) is."""
    here = Spoken(ends="truncated")
    here.seen = lambda: np.zeros(4, np.float32)
    assert not play(Spoken(ends="truncated")).success and play(here).success


@pytest.mark.parametrize("bad", ["info", "nan"])
def test_an_invalid_step_ends_the_episode_and_is_not_kept(bad):
    real = Spoken(says={2: {"invalid": bad == "info"}})
    real.seen = lambda: np.full(4, np.nan if bad == "nan" and real.time == 2 else 1.0, np.float32)
    episode = play(real)
    assert episode.valid.tolist() == [True] + [False] * 19 and episode.exploded and not episode.success
    assert all(np.isfinite(x).all() for x in episode.transitions) and len(real.actions) == 2


def test_an_episode_that_was_broken_off_scores_less_than_any_whole_one():
    """Where the task is judged by its return, which may be less the longer an episode lasts."""
    env = toy.make()._replace(score="return")
    broken, whole = (play(Spoken(says={2: {"invalid": True}} if own else {}), env) for own in (True, False))
    assert np.isneginf(broken.score) and broken.exploded and np.isfinite(broken.total_reward)
    assert whole.score == whole.total_reward and not whole.exploded


@pytest.mark.slow
def test_it_is_a_system_that_setup_takes():
    """Two seeds learn on two environments; their policies part from the prior's."""
    env = toy.make()
    network = NetworkConfig(hidden=(8,))
    params = extract_params(make_sac(SACConfig(4, 2, network=network, ensemble_size=2)).init(jax.random.key(0)))
    card = {"task": "toy", "obs_dim": 4, "act_dim": 2, "gamma": GAMMA, "ensemble_size": 2}
    prior = Prior(params, {**card, "network": {"hidden": [8]}})
    system = Gymnasium(env, [Spoken(), Spoken()], gamma=GAMMA)
    assert isinstance(system, System)
    options = {"initial_rollouts": 1, "utd": 0.1, "batch_size": 8, "critic_warmup": 0, "replay_capacity": 64}
    setup = api.setup(env, system, prior, method="sac", seeds=2, **options)
    assert setup.system is system and setup.seeds.tolist() == [0, 1]
    for state, metrics in finetune(*setup, rollouts=2):
        given = metrics.get("real/return", np.full(2, 2100.0))  # none before the first rollout
        assert given.tolist() == [2100.0, 2100.0] and int(state.rollouts) <= 2  # 10 + 20 + ... + 200
    played = api.evaluate_prior(prior, env, Gymnasium(env, Spoken(), gamma=GAMMA), episodes=2)
    assert played.total_reward.tolist() == [2100.0, 2100.0]
    tuned = api.finetuned_priors(setup, state, prior, best=False)[1]
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), tuned.params.actor, params.actor)
    assert any(jax.tree.leaves(changed))


# --- what an environment returns --------------------------------------------------------------------------------------


def answering(reward=10.0, terminated=False, truncated=False, info=()):
    """An environment whose every step is this; it ends with the third."""
    real = Spoken()

    def step(action):
        real.time += 1
        real.actions.append(action)
        return real.seen(), reward, terminated, truncated or real.time == 3, info if info is None else dict(info)

    real.step = step
    return real


@pytest.mark.parametrize(
    "answer",
    [
        {"reward": np.full(1, 10.0)},
        {"terminated": np.zeros(1, bool)},
        {"truncated": np.int64(0)},
        {"info": None},
        {"info": {"is_success": np.ones(1)}},
        {"reward": np.float64(10.0), "info": {"invalid": False, "late": None}},
    ],
    ids=str,
)
def test_answers_in_other_types_are_the_same(answer):
    episode = play(answering(**answer))
    assert episode.valid.sum() == 3 and episode.total_reward == 30.0 and not episode.exploded


@pytest.mark.parametrize("answer", [{"reward": "much"}, {"terminated": None}, {"info": {"sent": [9.0, 0.0]}}], ids=str)
def test_an_environment_is_stopped_where_its_answer_cannot_be_used(answer):
    real, rests = answering(**answer), []
    real.rest = lambda: rests.append(real.time)
    with pytest.raises(UserError, match=r"^step of .*Spoken.*: .* (is|beyond) "):
        play(real)
    assert rests == [1]


def test_all_environments_rest_where_one_of_them_cannot():
    several, rests = [Spoken(), Spoken()], []
    several[0].rest = fails
    several[1].rest = lambda: rests.append(1)
    with pytest.raises(UserError, match=r"^rest of .*ValueError: no motor$"):
        play(several, members=2)
    assert rests == [1]


@pytest.mark.parametrize("invalid", [{}, {"invalid": False}, {"invalid": np.zeros(1)}], ids=str)
def test_an_unknown_reward_is_the_tasks_also_where_info_says_that_nothing_is_invalid(invalid):
    env = toy.make()._replace(reward=lambda obs, action, following: following[0])
    episode = play(answering(reward=np.nan, info=invalid), env)
    assert episode.valid.sum() == 3 and not episode.exploded and episode.total_reward == 6.0


def test_observations_of_another_size_in_a_later_episode_are_one_line():
    real = Spoken()
    real.seen = lambda: np.zeros(4 + len(real.actions) // 3, np.float32)
    system, keys = Gymnasium(toy.make(), real, gamma=GAMMA), jax.random.split(jax.random.key(0), (1, 2))
    with pytest.raises(UserError, match=r"^step of .*Spoken.*: observes 5 numbers, the task toy measures 4: xy \[2\]"):
        system.play(STILL, jnp.zeros(1), keys, explore=False)


@pytest.mark.parametrize(
    ("seen", "words"),
    [
        ({"xy": np.zeros(2)}, "velocity of .*: the observation is None, not numbers alone"),
        ({"xy": np.zeros(1), "velocity": np.zeros(3)}, "xy of .*: observes 1 numbers, its space has 2"),
        (np.zeros(4), "observes a ndarray, not a mapping with xy, velocity"),
    ],
)
def test_a_dict_with_other_parts_than_its_space_is_one_line(seen, words):
    real = Parts()
    real.seen = lambda: seen
    with pytest.raises(UserError, match=words):
        play(real)


WANTING = Policy(lambda: (), lambda state, carry, obs, key, *, explore: (jnp.tanh(obs[2:]), carry))  # what it sees


@pytest.mark.parametrize("large", [np.nan, np.inf, 3e38])
def test_no_command_follows_a_start_that_is_not_finite(large, monkeypatch):
    """It is asked for again; the policy sees the first one that is."""
    monkeypatch.setattr("sgft_jax.systems.gymnasium._PAUSE", 0.0)
    real, starts = Spoken(ends="truncated"), []
    reset, blind = real.reset, 3

    def late(*, seed=None):
        starts.append(seed)
        obs, info = reset(seed=seed)
        return np.where(len(starts) <= blind, np.float32(large), obs), info

    real.reset = late
    episode = play(real, policy=WANTING)
    assert len(starts) == 4 and len(set(starts)) == 1 and np.isfinite(real.actions).all() and episode.valid.sum() == 3
    blind, starts[:], real.actions[:], rests = 10, [], [], []
    real.rest = lambda: rests.append(1)
    with pytest.raises(UserError, match=r"^reset of .*: measured number 0 is .* after 4 tries; no episode can begin"):
        play(real, policy=WANTING)
    assert len(starts) == 4 and not real.actions and rests == [1]


@pytest.mark.parametrize("together", [False, True])
def test_an_action_that_is_not_finite_is_not_sent_and_ends_that_members_episode(together):
    policy = Policy(lambda: (), lambda state, carry, obs, key, *, explore: (jnp.full(2, state), carry))
    several = [Spoken(ends="truncated") for _ in range(2)]
    make = [lambda own=own: own for own in several]
    real = SyncVectorEnv(make, autoreset_mode=AutoresetMode.NEXT_STEP) if together else several
    keys = jax.random.split(jax.random.key(0), (2, 1))
    episode = Gymnasium(toy.make(), real, gamma=GAMMA).play(policy, jnp.array([0.5, jnp.nan]), keys, explore=False)
    assert episode.valid.sum(2).tolist() == [[3], [0]] and episode.exploded.tolist() == [[False], [True]]
    assert all(np.isfinite(own.actions).all() for own in several) and len(several[1].actions) == (3 if together else 0)


def test_a_measurement_too_large_for_arithmetic_ends_the_episode():
    real = Spoken()
    real.seen = lambda: np.full(4, 3e38 if real.time == 2 else 1.0, np.float32)
    episode = play(real)
    assert episode.valid.tolist() == [True] + [False] * 19 and episode.exploded


# --- action spaces ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("space", "sent", "kept"),
    [
        (spaces.Box(-10, 10, (2,), np.int64), [5, -10], [0.5, -1.0]),
        (spaces.Box(-7, 7, (2,), np.int16), [4, -7], [4 / 7, -1.0]),  # 3.5: to the even one, as NumPy rounds
        (spaces.Box(0, 1, (2,), np.int8), [1, 0], [1.0, -1.0]),
        (spaces.Box(0, 255, (2,), np.uint8), [191, 0], [127 / 255, -1.0]),
        (spaces.Box(-1, 1, (2, 1), np.float32), [[0.5], [-1.0]], [0.5, -1.0]),
        (spaces.Box(-1, 1, (1, 2), np.float64), [[0.5, -1.0]], [0.5, -1.0]),
        (spaces.Box(0, 4, (2, 1), np.int32), [[3], [0]], [0.5, -1.0]),
    ],
    ids=str,
)
def test_what_was_sent_is_what_is_kept_in_the_shape_of_the_space(space, sent, kept):
    own = acting(space)
    own.ends = "truncated"
    together = space.shape == (2, 1)
    episode = play(SyncVectorEnv([lambda: own], autoreset_mode=AutoresetMode.NEXT_STEP) if together else own)
    assert own.actions[0].dtype == space.dtype and own.actions[0].tolist() == sent
    np.testing.assert_allclose(episode.transitions.action[0], kept, rtol=1e-6)
    np.testing.assert_array_equal(episode.command[0], [0.5, -1.0])


# --- what does not fit ------------------------------------------------------------------------------------------------


class Buttons(Spoken):
    def __init__(self):
        super().__init__()
        self.action_space = spaces.Discrete(3)


def acting(space):
    real = Spoken()
    real.action_space = space
    return real


def box(*shape):
    return Spoken(spaces.Box(-1, 1, shape))


@pytest.mark.parametrize(
    ("real", "words"),
    [
        (Buttons, "its actions are Discrete(3); only a Box can be commanded"),
        (lambda: Spoken(low=-np.inf), "its actions have no bounds"),
        (lambda: Spoken(low=np.finfo(np.float32).min, high=np.finfo(np.float32).max), "no bounds below 1e+09"),
        (lambda: acting(spaces.Box(np.iinfo(np.int64).min, 0, (2,), np.int64)), "no bounds below 1e+09"),
        (lambda: acting(spaces.MultiBinary(2)), "its actions are MultiBinary(2); only a Box can be commanded"),
        (lambda: acting(spaces.Box(0, np.float32([1, 0]))), "number 1 of its action can only be 0; leave it out"),
        (lambda: [], "no environment is given"),
        (lambda: [Spoken(), Spoken(high=2.0)], "the spaces of its 2 environments differ; make them alike"),
        (lambda: Spoken, "is no Gymnasium environment"),
        (lambda: box(3), "observes 3 numbers, the task measures 4: {'xy': 2, 'velocity': 2}; pass observe="),
        (lambda: Spoken(spaces.Discrete(4)), "observes Discrete(4), neither a Box nor a Dict"),
        (
            lambda: Spoken(spaces.Dict({"xy": spaces.Box(0, 1, (2,))})),
            "observes {'xy': 2}, the task measures {'xy': 2, 'velocity': 2}; pass observe=",
        ),
        (lambda: [box(4)] * 2, "the same environment is given twice; make one for each seed"),
        (lambda: [box(4), box(4)], "2 for 1 members; give one environment for each seed"),
        (lambda: sync(toy.make, TURNED, AutoresetMode.DISABLED), "its autoreset mode is AutoresetMode.DISABLED"),
    ],
)
def test_what_does_not_fit_is_one_line(real, words):
    with pytest.raises(UserError) as stopped:
        play(real())
    assert words in str(stopped.value) and "\n" not in str(stopped.value)


class Failing(Spoken):
    """Raises or returns in `reset` or `step` what it is given."""

    def __init__(self, method, does):
        super().__init__()
        setattr(self, method, does)


def fails(*given, **named):
    raise ValueError("no motor\nno battery")


@pytest.mark.parametrize(
    ("method", "does", "words"),
    [
        ("reset", fails, r"^reset of .*Failing.*: .*test_gymnasium_systems.py, line \d+: ValueError: no motor$"),
        ("step", fails, r"^step of .*Failing.*: .*test_gymnasium_systems.py, line \d+: ValueError: no motor$"),
        ("reset", lambda seed: np.zeros(4), r"^reset of .*: returns a ndarray, not observation, info$"),
        (
            "step",
            lambda action: (np.zeros(4), 0.0, False, {}),
            r"^step of .*: returns 4 values, not observation, reward, terminated, truncated, info$",
        ),
    ],
)
def test_an_environment_that_fails_is_one_line(method, does, words):
    with pytest.raises(UserError, match=words):
        play(Failing(method, does))


def test_so_does_a_vector_environment():
    with pytest.raises(UserError, match=r"step of .*: ValueError: no motor$"):
        real = SyncVectorEnv([lambda: Failing("step", fails)], autoreset_mode=AutoresetMode.NEXT_STEP)
        play(real)


def test_the_number_of_actions_must_be_the_tasks():
    env = toy.make()._replace(action=(Entry("force", "N", 3),))
    with pytest.raises(UserError, match="takes 2 numbers as action, the task toy has 3"):
        play(Spoken(), env)


def test_a_function_that_maps_wrongly_is_one_line():
    with pytest.raises(UserError, match=r"reset of .*: observes 1 numbers, the task toy measures 4: xy \[2\]"):
        play(Spoken(), observe=lambda obs: obs[:1])


def test_a_task_judged_by_success_must_be_told_of_it():
    with pytest.raises(UserError, match="nothing tells success, by which toy is judged"):
        play(Spoken(ends="truncated"), toy.make()._replace(success=None))


def test_an_episode_whose_first_step_is_in_doubt_is_no_success_though_nothing_tells():
    """The robot may tell of other episodes."""
    episode = play(Spoken(says={1: {"invalid": True}}), toy.make()._replace(success=None))
    assert episode.exploded and not episode.success and not episode.valid.any()
