"""The list of tasks and the description of one."""

import json
import subprocess
import sys

import pytest
import toy_terminating

import envs
from envs import gaps
from envs.franka import insert
from envs.types import UserError
from experiments import tasks


def said(capsys, *given, **options):
    tasks.main(tasks.TasksArgs(*given, **options))
    return capsys.readouterr().out


def test_the_list_names_every_task_and_gap_and_needs_no_jax():
    code = "import sys, envs; from experiments import tasks; tasks.main(tasks.TasksArgs())"
    code += "; print(*envs.TASKS); print([*sys.modules])"  # the tasks of this process may be more: tests register some
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    *lines, names, loaded = done.stdout.splitlines()
    assert "push" in names.split()
    for name in names.split():
        (line,) = [x for x in lines if x.startswith(f"{name} ")]
        assert all(gap in line for gap in gaps.presets(name))
    assert "'jax'" not in loaded and "'mujoco'" not in loaded and "'envs.gaps'" in loaded


def test_one_task_for_people(capsys):
    lines = said(capsys, "insert").splitlines()
    text = {line.split("  ")[0]: line for line in lines if line}
    assert text["observation"].endswith("hand_xyz [3] in m, leg_xyz [3] in m, hole_xyz [3] in m")
    assert text["episode"].endswith("40 steps of 0.2 s = 8 s") and text["judged by"].endswith("success at any step")
    assert text["part_x"].split()[1:] == ["m", "0", "-0.05", "to", "0.05", "-0.15", "to", "0.15"]
    assert "fixed" in text["hole_radius"] and text["part_friction"].endswith("at least 0")
    assert "0.004" in text["obs_noise"] and "s, how long the previous command stays" in text["latency"]
    assert "action_rotation 0.5; latency 0.05" in text["hard"]


def test_one_task_for_programs(capsys):
    found = json.loads(said(capsys, "push-towel", json=True), parse_constant=pytest.fail)
    assert found["gaps"]["weak"]["scene"] == "towel" and found["gaps"]["weak"]["effects"]["action_scale"] == 0.6
    assert {p["name"]: p["maximum"] for p in found["parameters"]}["object_mass"] is None
    assert {e["name"]: e["size"] for e in found["effects"]}["obs_bias"] == 4


def test_joints_have_no_rotation_and_tasks_without_mujoco_are_described(monkeypatch):
    assert "action_rotation" not in [e["name"] for e in tasks.describe("hammer")["effects"]]
    assert "action_rotation" in [e["name"] for e in tasks.describe("insert")["effects"]]
    monkeypatch.setitem(envs.TASKS, "toy_terminating", "toy_terminating")
    found = tasks.describe("toy_terminating")
    assert found["score"] == "return" and found["gaps"] == {} and found["episode_length"] == toy_terminating.LENGTH
    assert "judged by    return, the sum of rewards" in tasks._task_lines(found)
    assert len(tasks.describe("insert")["parameters"]) == len(insert.PARAMETERS)


def test_an_unknown_task_gets_the_closest_match():
    with pytest.raises(UserError, match="there is no 'pusch', did you mean 'push'"):
        tasks.describe("pusch")
