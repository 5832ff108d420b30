"""A learner that works while the robot plays: the same results if the robot waits, and what it does if not."""

import functools
import os
import signal

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import test_train
from test_train import FINE, PRIORS, SEEDS, make, run, simulated
from tuners import bits

from envs.types import UserError
from sgft_jax.train.finetuning import Updates, prior_of
from sgft_jax.train.learner_process import LearnerProcess, cores

pytestmark = pytest.mark.heavy  # all of them compile

WHICH = prior_of(PRIORS, SEEDS)


class Inline:
    """Learns at once, in this process; `result` is ready when a test says so."""

    def __init__(self, finetuner, *, ready=True):
        self.updates, self.is_ready, self.parts = Updates(finetuner, SEEDS, WHICH, None), ready, []

    def submit(self, agent, parts, updates, phase):
        self.parts.append(list(parts))
        self.learned = self.updates(jax.tree.map(jnp.copy, agent), parts, updates, phase)

    def ready(self):
        return self.is_ready

    def result(self):
        return self.learned


class Stepped:
    """The simulation as a system that asks for the agent; keeps what it was given."""

    def __init__(self):
        self.asked = []

    def play(self, policy, states, keys, *, explore):
        states = states() if callable(states) else states
        self.asked.append(np.asarray(states.agent.learner if hasattr(states, "agent") else states.learner))
        return simulated().play(policy, states, keys, explore=explore)


_SLOWER = [{"initial_rollouts": 3}, {"guard": True}]


@pytest.mark.parametrize("changes", [{}, *(pytest.param(own, marks=pytest.mark.slow) for own in _SLOWER)], ids=str)
def test_a_robot_that_waits_for_its_policy_gives_the_same_bits(changes):
    finetuner = make(**changes) if changes else FINE
    learner = Inline(finetuner, ready=False)
    expected = run(finetuner, rollouts=5) if changes else test_train.whole()[1][:6]
    found = run(finetuner, Stepped(), rollouts=5, learner=learner)
    assert len(found) == len(expected)
    for own, other in zip(found, expected, strict=True):
        assert bits(own) == bits(other)
    first = changes.get("initial_rollouts", 1)
    assert learner.parts == [list(range(first)), *[[i] for i in range(first, 5)]]


def test_a_run_with_another_learner_goes_on_with_the_same_bits():
    whole = test_train.whole()[1][:5]
    rest = run(rollouts=4, system=Stepped(), learner=Inline(FINE), progress=jax.tree.map(jnp.asarray, whole[2][0]))
    assert [int(p.rollouts) for p, _ in rest] == [3, 4] and bits(rest[-1]) == bits(whole[-1])


def test_a_robot_that_does_not_wait_plays_with_what_there_is():
    """An update counts one: the first two rollouts are the fresh agent's, then it is one behind."""
    system = Stepped()
    found = run(system=system, rollouts=4, learner=Inline(FINE, ready=False), waits=False)
    made = np.round([p.agent.learner[1] for p, _ in found])
    assert (np.diff(made) > 0).all()
    np.testing.assert_allclose([x[1] for x in system.asked], [0, *made[:3]], atol=0.1)
    ready = Stepped()
    found = run(system=ready, rollouts=4, learner=Inline(FINE), waits=False)
    np.testing.assert_allclose([x[1] for x in ready.asked], [p.agent.learner[1] for p, _ in found[:4]], atol=0.1)


class Handed(Stepped):
    """Episodes of three steps, each of which asks for the agent. Until step `late` there is the old one."""

    def __init__(self, learner, late, scores):
        super().__init__()
        self.learner, self.late, self.system = learner, late, test_train.Scripted(scores)

    def play(self, policy, states, keys, *, explore):
        for t in range(3):
            self.learner.is_ready = t >= self.late
            states()
        return self.system.play(policy, states, keys, explore=explore)


@pytest.mark.parametrize(("late", "behind"), [(9, 1), (2, 1), (1, 0), (0, 0)])
def test_what_was_played_speaks_for_who_made_most_of_the_steps(late, behind):
    """Of three steps: all, two, one or none by the agent that has not learned from the rollout before."""
    learner = Inline(FINE)
    scores = np.repeat(np.arange(6)[:, None], 2, 1)
    found = run(system=Handed(learner, late, scores), rollouts=6, learner=learner, waits=False)
    best, agents = found[-1][0].best, [progress.agent.learner for progress, _ in found]
    np.testing.assert_array_equal(best.params, agents[5 - behind])
    assert best.age.tolist() == [5 - behind] * 2 and best.score.tolist() == [3, 3]


def test_a_rollout_that_asked_nobody_speaks_for_nobody():
    """As those that a resumed run reads from disk."""
    system = test_train.Scripted(np.ones((3, 2)))
    best = run(system=system, rollouts=3, learner=Inline(FINE), waits=False)[-1][0].best
    assert best.count.tolist() == [3, 3] and np.isneginf(best.score).all() and best.params.tolist() == [0.5, 0.0]


def test_a_guard_needs_rollouts_by_one_policy():
    fine = make(guard=True)
    with pytest.raises(UserError, match="waits=False: a guard judges rollouts by one policy"):
        run(fine, Stepped(), rollouts=1, learner=Inline(fine), waits=False)


# --- the process ------------------------------------------------------------------------------------------------------


@pytest.fixture
def process(monkeypatch):
    """A learner in a process of its own, for the agent of these tests."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([os.path.dirname(test_train.__file__), *_paths()]))
    before, made = cores(), LearnerProcess(make, SEEDS, WHICH, None)
    yield made
    made.close()
    assert cores() == before


def _paths():
    return [os.path.dirname(os.path.dirname(test_train.__file__))]


@pytest.mark.slow
def test_a_process_learns_the_same(process):
    expected, found = run(rollouts=3), run(system=Stepped(), rollouts=3, learner=process)
    for own, other in zip(found, expected, strict=True):
        jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6), own, other)
    assert len(cores()) == 1  # the others are for the learner


def mistaken():
    raise UserError("--options.horizon: must be at least 1")


@pytest.mark.slow
def test_what_is_the_users_in_a_process_is_one_line_and_no_traceback(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([os.path.dirname(__file__), *_paths()]))
    made = LearnerProcess(mistaken, SEEDS, WHICH, None)
    with pytest.raises(UserError, match=r"^--options.horizon: must be at least 1$"):
        made.wait()
    made.close()


@pytest.mark.slow
def test_a_process_that_dies_is_said_in_one_line(process):
    os.kill(process._process.pid, signal.SIGKILL)
    with pytest.raises(UserError, match=r"process is gone \(exit code -9\); nothing that the robot did is lost"):
        run(system=Stepped(), rollouts=3, learner=process)
