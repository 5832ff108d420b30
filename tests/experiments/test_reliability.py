"""The trouble that `experiments.studies.reliability` makes, and how it counts what became of it."""

import errno

import numpy as np
import pytest

from envs.types import UserError
from experiments.runner import cli
from experiments.studies import reliability
from experiments.studies.reliable import quick_task, trial
from experiments.studies.reliable.robot import Rail
from experiments.studies.reliable.trial import Made, audit
from sgft_jax.io.real import RealStore


def steps(*numbers):
    return [Made(bytes([n]), bytes([n, n]), float(n)) for n in numbers]


@pytest.mark.parametrize(
    ("stored", "missing", "alien"),
    [
        ((1, 2, 3, 4), 0, 0),
        ((1, 2, 4), 1, 0),
        ((), 4, 0),
        ((1, 2, 2, 3, 4), 0, 1),  # a step that is stored twice
        ((1, 3, 2, 4), 1, 1),  # in another order
        ((1, 2, 9, 3, 4), 0, 1),  # nobody made it
    ],
    ids=str,
)
def test_an_audit_by_hand(stored, missing, alien):
    assert audit(steps(1, 2, 3, 4), steps(*stored)) == (4, len(stored), missing, alien, 0)


def test_a_step_with_another_command_is_alien():
    other = Made(b"other", steps(2)[0].obs, 2.0)
    assert audit(steps(1, 2), [steps(1)[0], other])[2:] == (1, 1, 0)


def test_the_ledger_is_what_the_robot_did(tmp_path):
    """Two commands, one of them held for a second period, and one whose outcome is not known."""
    robot = Rail(tmp_path / "ledger", (4, 2))
    robot.reset(0)
    seen = []
    for action in ([0.5, 0.0], None, [-0.25, 1.0]):
        if action is not None:
            robot.send(np.array(action, np.float32))
        seen.append(robot.read())
    robot.send(np.zeros(2, np.float32))
    made, unread = trial.read_ledger(tmp_path / "ledger")
    assert unread == 1 and [step.obs for step in made] == [obs.tobytes() for obs in seen]
    commands = [np.frombuffer(step.action, np.float32).tolist() for step in made]
    assert commands == [[0.5, 0.0], [0.5, 0.0], [-0.25, 1.0]]
    assert seen[0][0] > -0.15 and robot.obs_size == 4


def test_the_quick_task_has_the_period_of_its_robot():
    """Otherwise the learner refuses the robot."""
    assert quick_task.make().control_dt == trial.QUICK_PERIOD


def test_only_valid_steps_are_stored_ones(tmp_path):
    RealStore(tmp_path).append(
        {
            "valid": np.array([[True, True, False]]),
            "action": np.ones((1, 3, 1), np.float32),
            "next_obs": np.arange(6, dtype=np.float32).reshape(1, 3, 2),
            "time": np.zeros((1, 3)),
        }
    )
    (one, two) = trial.stored_steps(tmp_path)
    assert one.obs == np.array([0, 1], np.float32).tobytes() and two.action == np.ones(1, np.float32).tobytes()


def test_jitter_is_counted_within_episodes(tmp_path):
    import msgpack

    entries = [(1, 0, 10.0, False), (1, 1, 10.2, False), (1, 2, 10.5, True), (2, 0, 20.0, False), (2, 1, 20.2, False)]
    with open(tmp_path / "log", "wb") as file:
        for episode, step, clock, late in entries:
            file.write(msgpack.packb({"episode": episode, "step": step, "clock": clock, "late": late}) or b"")
    np.testing.assert_allclose(trial.periods(tmp_path / "log"), [0.2, 0.3, 0.2])
    assert trial.late_share(tmp_path / "log") == 0.2


def test_a_disk_that_is_full_is_said_in_one_line(capsys):
    def main(args):
        raise OSError(errno.ENOSPC, "No space left on device", "runs/real/rollout-000003.half")

    with pytest.raises(SystemExit) as ended:
        cli.run_main(main, reliability.ReliabilityArgs, "", argv=[])
    said = capsys.readouterr().err
    assert ended.value.code == 2 and said.count("\n") == 1
    assert "rollout-000003.half: no space left on device; mend that, then try again" in said  # it has no --resume


def test_nothing_to_try_is_refused(tmp_path):
    with pytest.raises(UserError, match="--kills is 0"):
        reliability.main(reliability.ReliabilityArgs(kills=0, out=tmp_path))


@pytest.mark.slow
def test_kills_lose_and_repeat_nothing(tmp_path):
    """Five of them. At most one step in doubt for each, and one that the robot's process did not see the end of."""
    args = reliability.ReliabilityArgs(parts=("kills",), runs=1, kills=5, out=tmp_path)
    (found,) = reliability.main(args)["kills"]
    killed = found["player"] + found["learner"] + found["robot"]
    assert killed == 5 and found["stored"] > 200
    assert found["alien"] == 0 and found["missing"] + found["unread"] <= killed
