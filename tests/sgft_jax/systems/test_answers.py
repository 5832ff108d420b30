"""What environments and drivers return: the same value in many types, and everything else in one line."""

import numpy as np
import pytest

from envs.types import UserError
from sgft_jax.systems import answers
from sgft_jax.systems.robot_client import printable

OBS, LOW, HIGH = np.zeros(2), np.array([-1.0, 0.0]), np.array([1.0, 4.0])


def step(reward=1.0, terminated=False, truncated=False, info=()):
    return answers.step("arm", (OBS, reward, terminated, truncated, info if info is None else dict(info)), LOW, HIGH)


@pytest.mark.parametrize("wrap", [float, np.float32, np.ones(1).__mul__, lambda x: np.array([[x]]), lambda x: [x], int])
def test_a_number_may_come_in_many_types(wrap):
    assert step(reward=wrap(3.0)).reward == 3.0


@pytest.mark.parametrize("yes", [True, 1, 1.0, np.True_, np.ones(1), np.ones((1, 1), bool), [True]])
def test_a_truth_value_may_come_in_many_types(yes):
    answer = step(terminated=yes, truncated=yes, info={"success": yes, "invalid": yes, "late": yes})
    assert answer[2:7] == (True,) * 5 and all(type(x) is bool for x in answer[2:7])


def test_none_is_what_nobody_knows():
    answer = step(reward=None, info={"is_success": None, "invalid": None, "late": None, "sent": None})
    assert np.isnan(answer.reward) and answer[2:] == (False, False, None, False, False, None)
    assert step(info=None) == step() and step(info={"is_success": None, "success": True}).success


def test_invalid_is_what_it_says_and_not_that_it_is_there():
    assert not step(info={"invalid": False}).invalid and step(info={"invalid": np.True_}).invalid


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"reward": "much"}, "reward is 'much', not a number"),
        ({"reward": np.ones(2)}, r"reward is array\(\[1., 1.\]\), not a number"),
        ({"reward": [[1], [2, 3]]}, r"reward is \[\[1\], \[2, 3\]\], not a number"),
        ({"reward": 1j}, "reward is 1j"),
        ({"reward": {"a": 1}}, "reward is {'a': 1}"),
        ({"reward": "x" * 9999}, r"reward is 'x+\.\.\., not a number$"),
        ({"reward": "\x1b[31m\n"}, "reward is '"),
        ({"terminated": None}, "terminated is None, not true or false"),
        ({"terminated": "no"}, "terminated is 'no', not true or false"),
        ({"terminated": np.nan}, "terminated is nan, not true or false"),
        ({"truncated": 2}, "truncated is 2, not true or false"),
        ({"truncated": []}, r"truncated is \[\], not true or false"),
        ({"info": {"is_success": np.ones(2)}}, r"info\['is_success'\] is array"),
        ({"info": {"success": 0.7}}, r"info\['success'\] is 0.7"),
        ({"info": {"success": "yes"}}, r"info\['success'\] is 'yes'"),
        ({"info": {"invalid": "no"}}, r"info\['invalid'\] is 'no'"),
        ({"info": {"sent": np.zeros(3)}}, r"info\['sent'\] has 3 numbers, not 2"),
        ({"info": {"sent": [0.0, np.nan]}}, r"info\['sent'\] is .*beyond the bounds of the action space"),
        ({"info": {"sent": [0.0, -0.1]}}, "beyond the bounds"),
        ({"info": {"sent": [1e30, 0.0]}}, "beyond the bounds"),
        ({"info": {"sent": "left"}}, r"info\['sent'\] is 'left', not numbers alone"),
    ],
    ids=str,
)
def test_what_is_none_of_these_is_one_line(changes, words):
    with pytest.raises(UserError, match=f"^step of arm: .*{words}") as stopped:
        step(**changes)
    assert str(stopped.value).isprintable() and len(str(stopped.value)) < 200


def test_info_must_be_a_mapping():
    with pytest.raises(UserError, match="step of arm: info is 'fine', no mapping"):
        answers.step("arm", (OBS, 0.0, False, False, "fine"), LOW, HIGH)


def test_what_was_sent_is_brought_within_the_bounds_by_rounding_alone():
    np.testing.assert_array_equal(step(info={"sent": [[1.00001], [2.0]]}).sent, [1.0, 2.0])


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (np.zeros(3), "observes 3 numbers, the task measures 2"),
        ("ab", "the observation is 'ab', not numbers alone"),
        (["1", "2"], "not numbers alone"),
        (None, "the observation is None"),
        ([[1.0], [2.0, 3.0]], "not numbers alone"),
        ((np.zeros(2), {}), "not numbers alone"),
        (np.array([1j, 0]), "not numbers alone"),
        (np.array([None, 0]), "not numbers alone"),
    ],
    ids=str,
)
def test_an_observation_is_numbers_alone(values, words):
    with pytest.raises(UserError, match=f"^reset of arm: .*{words}"):
        answers.measured("reset of arm", values, 2, "the task measures 2")


@pytest.mark.parametrize("large", [np.nan, np.inf, 1e300, 3e38, -2e18])
def test_numbers_too_large_for_arithmetic_are_not_sound(large):
    measured = answers.measured("arm", np.array([1.0, large]), 2, "")
    assert measured.dtype == np.float32 and answers.sound(measured).tolist() == [True, False]


def test_answers_of_several_say_what_nobody_knows():
    pair = [step(reward=None, info={"sent": [0.5, 1.0]}), step(reward=1e300, info={"success": True, "late": 1})]
    both = answers.stacked(pair, 2)
    assert both.reward.dtype == np.float32 and np.isnan(both.reward[0]) and np.isinf(both.reward[1])
    assert both.success.dtype == np.int8 and both.success.tolist() == [-1, 1] and both.late.tolist() == [False, True]
    np.testing.assert_array_equal(both.sent, [[0.5, 1.0], [np.nan, np.nan]])


# --- vector environments ----------------------------------------------------------------------------------------------


def vector(
    obs=((0.0,), (1.0,)),
    reward=(1.0, 2.0),
    terminated=(False, True),
    truncated=(False, False),
    infos=None,
    same_step=False,
):
    return answers.vector("arms", (np.array(obs), reward, terminated, truncated, infos), 2, same_step=same_step)


def test_a_vector_environment_answers_for_each_of_its_environments():
    infos = {
        "is_success": np.array([True, False]),
        "_is_success": np.array([True, False]),
        "invalid": np.array([[0], [1]]),
        "final_obs": np.array([None, np.array([7.0])], object),
        "_final_obs": np.array([False, True]),
        "final_info": {"success": np.array([0, 1]), "_success": [False, True]},
        "_final_info": [False, True],
        "clock": 3.0,
        "names": "ab",
    }
    first, second = vector(reward=np.array([[1.0], [2.0]]), infos=infos)
    assert first[0] == 0.0 and second[0] == 7.0 and first[2] is False and second[2] is True
    assert first[4].keys() == {"is_success", "invalid"} and second[4].keys() == {
        "invalid",
        "final_obs",
        "final_info",
        "success",
    }
    pair = [answers.step("arms", one, LOW, HIGH) for one in (first, second)]
    assert [one.reward for one in pair] == [1.0, 2.0] and [one.invalid for one in pair] == [False, True]
    assert [one.success for one in pair] == [True, True]


def test_parts_of_observations_are_split_and_copied():
    obs = {"xy": np.zeros((2, 2)), "puck": {"z": np.ones(2)}}
    first, second = answers.split("arms", "reset", obs, 2)
    obs["xy"] += 5.0
    assert first["xy"].tolist() == [0.0, 0.0] and second["puck"]["z"] == 1.0
    last = {"xy": np.array([[3.0], [4.0]]), "_xy": [True, True]}
    assert vector(infos={"final_obs": last, "_final_obs": [False, True]})[1][0] == {"xy": 4.0}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"reward": 1.0}, "reward is 1.0, not one for each of 2 environments"),
        ({"reward": np.ones(3)}, "reward is .*not one for each of 2"),
        ({"terminated": None}, "terminated is None, not one for each"),
        ({"truncated": True}, "truncated is True, not one for each"),
        ({"obs": np.zeros((3, 1))}, "observation is .*not one for each"),
        ({"infos": [{}, {}]}, r"info is \[{}, {}\], no mapping"),
        ({"infos": {"final_info": ["x", "y"]}}, r"info\['final_info'\] is 'x', no mapping"),
        ({"infos": {"invalid": True}}, r"info\['invalid'\] is True, not one for each"),
        ({"infos": {"invalid": np.ones(2), "_invalid": True}}, r"info\['_invalid'\] is True, not one for each"),
    ],
    ids=str,
)
def test_a_vector_environment_that_answers_for_others_is_one_line(changes, words):
    with pytest.raises(UserError, match=f"^step of arms: {words}"):
        vector(**changes)


@pytest.mark.parametrize("over", ["terminated", "truncated"])
def test_the_start_of_the_next_episode_is_never_taken_for_the_end_of_this_one(over):
    ended = {"terminated": (False, False), over: (False, True), "same_step": True}
    with pytest.raises(UserError, match=r"^step of arms: an episode has ended, but info has no 'final_obs'"):
        vector(**ended, infos={"final_obs": np.array([np.ones(1), None], object), "_final_obs": [True, False]})
    last = {"final_obs": np.array([None, np.full(1, 7.0)], object), "_final_obs": [False, True]}
    assert vector(**ended, infos=last)[1][0] == 7.0 and vector(**ended | {"same_step": False})[1][0] == 1.0


def test_a_line_is_printable_and_short():
    assert printable("a\x1b[31m\nb\u202ec\ud800", 60) == "a [31m b c "
    assert len(printable("x" * 60_000, 40)) == 40
