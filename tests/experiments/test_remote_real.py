"""`--real remote`: a robot's every step is on disk, a kill loses and repeats nothing, another process learns."""

import json
import os
import re
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import numpy as np
import pytest
import toy
from priors_by_hand import save_prior

pytest.importorskip("gymnasium", reason="make setup EXTRAS=dev, or pip install 'sgft-jax[gymnasium]'")

from envs.adapters.gymnasium import TaskEnv
from envs.gaps import Gap
from envs.types import Policy, UserError
from experiments import evaluate, finetune
from experiments.runner import cli, finetune_args, grid, real_systems
from experiments.runner.recorded import RecordedSystem
from sgft_jax.io.real import RealStore
from sgft_jax.systems.gymnasium import Gymnasium
from sgft_jax.systems.robot_client import RefusedError, play

TASK = str(Path(toy.__file__).resolve())
T = 20
OPTIONS = f"""--task {TASK} --method sac --seeds 1 --rollouts 3 --checkpoint-every 2 --options.initial-rollouts 1
    --options.utd 0.2 --options.batch-size 8 --options.critic-warmup 0 --options.replay-capacity 128 --devices 1"""
TURNED = Gap("turned", {}, {"action_rotation": 0.4})


class Driver:
    """A simulated robot; counts the steps that it makes."""

    obs_size, action_size = 4, 2

    def __init__(self):
        self.env, self.starts, self.steps, self.fails = TaskEnv(toy.make(), TURNED), [], 0, 0

    def reset(self, seed):
        self.starts.append(seed)
        return self.env.reset(seed=seed)[0]

    def step(self, action):
        self.steps += 1
        if self.steps <= self.fails:
            raise RuntimeError("not now")
        return self.env.step(action)

    def stop(self):
        pass


class Breaking(TaskEnv):
    """A robot at whose n-th step the process that asks for it dies."""

    def __init__(self, after):
        super().__init__(toy.make(), TURNED)
        self.left = after

    def step(self, action):
        self.left -= 1
        if self.left < 0:
            raise KeyboardInterrupt
        return super().step(action)


def still(actions):
    return Policy(lambda: (), lambda state, carry, obs, key, *, explore: (state * obs[:actions], carry))


# --- steps on disk ----------------------------------------------------------------------------------------------------


def rollouts(folder, after, *, count, done=0):
    """As many rollouts of a robot that breaks after so many steps."""
    env = toy.make()
    robot = RecordedSystem(Gymnasium(env, Breaking(after), gamma=0.9), [RealStore(folder)], done=done, sync_every=1)
    keys = jax.random.split(jax.random.key(0), (1, count))
    return robot.play(still(env.act_dim), np.array([-0.5]), keys, explore=True)


@pytest.mark.heavy
def test_what_a_kill_leaves_of_a_rollout_is_a_rollout_and_its_next_step_is_in_doubt(tmp_path):
    whole = rollouts(tmp_path / "whole", 10**6, count=2)
    with pytest.raises(KeyboardInterrupt):
        rollouts(tmp_path / "cut", T + 7, count=2)
    assert [path.suffix for path in sorted((tmp_path / "cut/real").iterdir())] == [".npz", ".jsonl"]
    cut = rollouts(tmp_path / "cut", 0, count=2)  # nothing is played again
    assert [path.suffix for path in sorted((tmp_path / "cut/real").iterdir())] == [".npz", ".npz"]
    np.testing.assert_array_equal(cut.valid.sum(2), [[T, 7]])
    np.testing.assert_array_equal(cut.exploded, [[False, True]])
    for name in ("obs", "action", "reward", "discount", "next_obs"):
        expected, found = (np.asarray(getattr(x.transitions, name)) for x in (whole, cut))
        np.testing.assert_array_equal(found[0, 0], expected[0, 0])
        np.testing.assert_array_equal(found[0, 1, :7], expected[0, 1, :7])
        assert not found[0, 1, 7:].any()


@pytest.mark.heavy
def test_a_kill_in_the_first_step_of_a_rollout_leaves_it_in_doubt(tmp_path):
    whole = rollouts(tmp_path / "whole", 10**6, count=1)
    with pytest.raises(KeyboardInterrupt):
        rollouts(tmp_path / "cut", T, count=2)
    (asked,) = RealStore(tmp_path / "cut").journal(1).read()
    assert asked["invalid"].all() and asked["over"].all() and not asked["valid"].any()
    np.testing.assert_array_equal(asked["command"], -0.5 * asked["obs"][:, :2])  # what the policy wanted of what it saw
    cut = rollouts(tmp_path / "cut", 0, count=2)  # nothing is played again
    np.testing.assert_array_equal(cut.valid.sum(2), [[T, 0]])
    np.testing.assert_array_equal(cut.exploded, [[False, True]])
    assert not cut.success[0, 1] and not np.asarray(cut.transitions.obs[0, 1]).any()
    np.testing.assert_array_equal(cut.transitions.obs[0, 0], whole.transitions.obs[0, 0])
    assert [path.suffix for path in sorted((tmp_path / "cut/real").iterdir())] == [".npz", ".npz"]


@pytest.mark.heavy
def test_a_rollout_that_was_killed_before_its_first_command_is_begun_again(tmp_path, monkeypatch):
    def die(env, *, seed):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(Breaking, "reset", die)
        with pytest.raises(KeyboardInterrupt):
            rollouts(tmp_path, 10**6, count=1)
    (path,) = (tmp_path / "real").iterdir()
    assert path.name == "rollout-000000.steps.jsonl"
    path.write_text('{"types": {')  # or while the first line was written
    again = rollouts(tmp_path, 10**6, count=1)
    np.testing.assert_array_equal(again.valid.sum(2), [[T]])


def test_the_first_step_is_on_disk_before_the_robot_is_asked_for_it(tmp_path, monkeypatch):
    step, seen = TaskEnv.step, []

    def look(env, action):
        seen.append((tmp_path / "real/rollout-000000.steps.jsonl").read_text().count("\n"))
        return step(env, action)

    monkeypatch.setattr(TaskEnv, "step", look)
    rollouts(tmp_path, 10**6, count=1)
    assert seen == [1 + t for t in range(T)]


@pytest.mark.heavy
def test_a_rollout_that_was_over_when_its_writer_died_is_whole(tmp_path):
    whole = rollouts(tmp_path, 10**6, count=1)
    store = RealStore(tmp_path)
    played = store.load(0)
    steps = Gymnasium(toy.make(), Breaking(10**6), gamma=0.9).steps(
        still(2), np.array([-0.5]), jax.random.split(jax.random.key(0), (1, 1))[:, 0], explore=True
    )
    with store.journal(1) as journal:
        for i, step in enumerate(steps):
            if i == 0:
                journal.begin(step._asdict())
            journal.append(step._asdict())
    again = rollouts(tmp_path, 0, count=1, done=1)
    jax.tree.map(np.testing.assert_array_equal, again.transitions, whole.transitions)
    assert not again.exploded.any() and len(store) == 2
    assert played["command"].shape == (1, T, 2) and played["late"].shape == played["time"].shape == (1, T)
    assert (np.diff(played["time"]) >= 0).all()


def test_a_torn_line_is_left_out_and_a_damaged_one_named(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        rollouts(tmp_path, 5, count=1)
    path = next(tmp_path.glob("real/*.jsonl"))
    text = path.read_text()
    path.write_text(text[:-20])
    assert len(RealStore(tmp_path).journal(0).read()) == 4
    for damaged in (
        text.replace('"reward"', '"reward', 1),
        '{"obs": "float32"}\n',
    ):  # the second is of a version before
        path.write_text(damaged)
        with pytest.raises(UserError, match=r"steps\.jsonl: damaged: .*move it away"):
            rollouts(tmp_path, 5, count=1)


def test_steps_of_another_task_or_version_are_named(tmp_path):
    with pytest.raises(KeyboardInterrupt):
        rollouts(tmp_path, 5, count=1)
    journal = RealStore(tmp_path).journal(0)
    steps = journal.read()
    for change in (
        lambda step: {name: x for name, x in step.items() if name != "late"},
        lambda step: {**step, "more": step["late"]},
        lambda step: {**step, "obs": step["obs"][:, :3]},
        lambda step: {**step, "command": step["command"].repeat(2, axis=0)},
        lambda step: {**step, "reward": step["obs"]},
    ):
        with journal:
            journal.begin(change(steps[0]))
            journal.append(change(steps[0]))
        with pytest.raises(UserError, match=r"steps\.jsonl: holds no steps of toy; move it away to go on without them"):
            rollouts(tmp_path, 5, count=1)


# --- the token --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "mode", "words"),
    [
        (b"abc", 0o600, "holds no token: 16 letters"),
        (b"", 0o600, "holds no token"),
        (b"a token of several words", 0o600, "holds no token"),
        ("schlüsselschlüssel".encode(), 0o600, "holds no token"),
        (b"0123456789abcdef\n0123456789abcdef", 0o600, "holds no token"),
        (b"0123456789abcdef\xff", 0o600, "is no UTF-8 text"),
        (b"0" * 5000, 0o600, "is larger than 1,024 bytes"),
        *(
            (b"0123456789abcdef", mode, "others can read or write it; delete it for a new token")
            for mode in (0o666, 0o640, 0o604, 0o620)
        ),
    ],
)
def test_a_token_that_others_know_or_can_guess_is_refused(tmp_path, content, mode, words):
    path = tmp_path / "robot-token"
    path.write_bytes(content)
    path.chmod(mode)
    with pytest.raises(UserError, match=f"robot-token: {words}") as stopped:
        real_systems.token(tmp_path)
    assert not content or content[:16].decode(errors="replace") not in str(stopped.value)


@pytest.mark.parametrize("target", ["elsewhere", "nowhere", "robot-token"])
def test_a_token_behind_a_link_is_refused(tmp_path, target):
    (tmp_path / "elsewhere").write_text("0123456789abcdef")
    (tmp_path / "robot-token").symlink_to(tmp_path / target)
    with pytest.raises(UserError, match="robot-token: is a link; delete it"):
        real_systems.token(tmp_path)


def test_a_token_that_is_no_file_is_refused(tmp_path):
    os.mkfifo(tmp_path / "robot-token", 0o600)
    with pytest.raises(UserError, match="robot-token: is no plain file"):
        real_systems.token(tmp_path)


def test_a_token_of_ones_own_is_taken(tmp_path):
    (tmp_path / "robot-token").write_text("\ufeff0123456789abcdef\r\n")
    (tmp_path / "robot-token").chmod(0o600)
    assert real_systems.token(tmp_path) == "0123456789abcdef"


# --- where to listen --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("real", "address"),
    [
        ("remote", ("127.0.0.1", 8765)),
        ("remote:", ("127.0.0.1", 8765)),
        ("remote::99", ("127.0.0.1", 99)),
        ("remote:lab", ("lab", 8765)),
        ("remote:10.0.0.7:99", ("10.0.0.7", 99)),
        ("remote:::1", ("::1", 8765)),
        ("remote:[::1]", ("::1", 8765)),
        ("remote:[::1]:99", ("::1", 99)),
        ("remote:[fe80::1%eth0]:9", ("fe80::1%eth0", 9)),
    ],
)
def test_an_address_may_be_of_either_kind(real, address):
    assert real_systems.address(real) == address


@pytest.mark.parametrize(
    "real",
    [
        "remote:lab:0",
        "remote:lab:80000",
        "remote:lab:http",
        "remote:lab: 99",
        "remote:lab:٣",
        "remote:a b:99",
        "remote:256.1.1.1:99",
        "remote:[::1",
        "remote:[::1]99",
        "remote:[zz:1]:99",
        "remote:[10.0.0.7]:99",
        "remote:here:there",
        "remote:1:2:3",
        "remote:lab:99\n",
        "remote:\x1b[31m",
        "remote:" + "x" * 300,
        "remote:a/b",
    ],
    ids=lambda real: repr(real[:30]),
)
def test_what_is_no_address_is_refused_in_one_line(real):
    with pytest.raises(
        UserError, match=r"write remote, remote:HOST or remote:HOST:PORT, .* an IPv6 address as \[::1\]"
    ):
        real_systems.check("push", [real])


def test_a_place_where_one_cannot_listen_is_found_before_anything_is_made(tmp_path):
    """Nothing of the run is there then: neither a folder, nor a token."""
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        taken = f"remote::{other.getsockname()[1]}"
        for real in (taken, "remote:203.0.113.7:9999"):
            given = [
                "--task",
                "push",
                "--real",
                real,
                "--seeds",
                "1",
                "--prior",
                "none",
                "--out",
                str(tmp_path / "runs"),
            ]
            with pytest.raises(SystemExit) as stopped:
                finetune.main([*given, "--method", "sac"])
            assert stopped.value.code == 2 and not (tmp_path / "runs").exists()


# --- what fits --------------------------------------------------------------------------------------------------------


def test_a_robot_with_another_period_than_the_task_is_refused(port, tmp_path):
    env = toy.make()
    system = real_systems.connect(env, [f"remote::{port}"], (), members=1, gamma=0.9, home=tmp_path)
    driver, given = Driver(), {"token": real_systems.token(tmp_path), "say": lambda line: None}
    with pytest.raises(RefusedError, match="seconds of a step: the robot has"):
        play(driver, f"ws://127.0.0.1:{port}", period=2 * env.control_dt, **given)
    assert not driver.starts
    system.close()


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def robot(monkeypatch, tmp_path):
    """A robot that waits for a learner under tmp_path / runs, from now on."""
    monkeypatch.setattr(cli, "set_up", lambda: None)
    monkeypatch.setattr(os, "environ", os.environ.copy())
    home, threads = tmp_path / "runs", []
    token = real_systems.token(home)
    assert stat.S_IMODE((home / "robot-token").stat().st_mode) == 0o600 and real_systems.token(home) == token

    def start(port, **options):
        driver = Driver()
        given = {"token": token, "retry": 0.05, "say": lambda line: None, **options}
        thread = threading.Thread(target=play, args=(driver, f"ws://127.0.0.1:{port}"), kwargs=given, daemon=True)
        thread.start()
        threads.append(thread)
        return driver

    yield start
    for thread in threads:
        thread.join(timeout=10)


@pytest.fixture
def port():
    """A free one."""
    with socket.socket() as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def run(tmp_path, port, *more):
    home = tmp_path / "runs"
    if not (home / "prior/seed-0").exists():
        save_prior(home / "prior/seed-0", 0)
    given = ["--real", f"remote::{port}", "--prior", str(home / "prior"), "--out", str(home), *more]
    finetune.main([*OPTIONS.split(), *given])
    return home / "finetune/toy/remote/sac/seed-0"


@pytest.mark.slow
def test_runs_that_begin_together_agree_on_a_token(tmp_path):
    start = threading.Barrier(8)

    def ask(home):
        start.wait()
        return real_systems.token(home)

    for home in (tmp_path / str(i) for i in range(20)):
        with ThreadPoolExecutor(8) as pool:
            assert len(set(pool.map(ask, [home] * 8))) == 1
        assert [file.name for file in home.iterdir()] == ["robot-token"]


@pytest.mark.slow
def test_a_robot_is_fine_tuned_and_costs_no_evaluation(robot, port, tmp_path, capsys):
    driver = robot(port)
    folder = run(tmp_path, port)
    *_, succeeded, results, following = capsys.readouterr().out.splitlines()
    assert re.fullmatch(r"remote: \d of 3 training rollouts have succeeded", succeeded)
    assert results == f"results: {folder}  (policy/, best/, real/, summary.json)"
    wanted = f"--run {folder} --best --task {TASK} --real remote::{port} --episodes 10 --out {tmp_path / 'runs'}"
    assert following == f"next: python -m experiments.evaluate {wanted}"
    assert driver.steps == 3 * T and len(driver.starts) == len(set(driver.starts)) == 3
    names = sorted(path.name for path in (folder / "real").iterdir())
    assert names == [f"rollout-00000{i}.npz" for i in range(3)]
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["final"]["rollouts"] == 3 and summary["real_steps"] == [3 * T]
    assert (folder / "best/seed-0/prior.json").exists() and not (folder / "evaluation").exists()
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [line["rollouts"] for line in lines] == [1, 2, 3]
    assert len(os.sched_getaffinity(0)) == len(os.sched_getaffinity(os.getppid()))  # nobody is pinned any longer


@pytest.mark.slow
def test_a_robot_that_fails_in_its_first_steps_costs_these_rollouts(robot, port, tmp_path):
    driver = robot(port)
    driver.fails = 2  # among them the only one before learning begins
    folder = run(tmp_path, port)
    store = RealStore(folder)
    assert [int(store.load(i)["valid"].sum()) for i in range(3)] == [0, 0, T] and driver.steps == T + 2


@pytest.mark.slow
def test_a_killed_learner_goes_on_with_what_the_robot_has_done(port, tmp_path):
    """Kill -9 in the second rollout: its steps are kept, none is made twice, and the run has all three rollouts."""
    home = tmp_path / "runs"
    save_prior(home / "prior/seed-0", 0)
    log = tmp_path / "commands.log"
    code = (
        "import sys; sys.path[:0] = [sys.argv[3], sys.argv[4]]; from test_remote_real import Driver; "
        "from sgft_jax.systems.robot_client import play; import time\n"
        "class Slow(Driver):\n"
        "    def step(self, action):\n"
        "        time.sleep(0.05); return super().step(action)\n"
        "print(play(Slow(), sys.argv[1], token=sys.argv[2], retry=0.05, log=sys.argv[5]))"
    )
    tests = Path(__file__).parent
    token, url = real_systems.token(home), f"ws://127.0.0.1:{port}"
    client = subprocess.Popen([sys.executable, "-c", code, url, token, str(tests), str(tests.parent), str(log)])
    command = [
        sys.executable,
        "-m",
        "experiments.finetune",
        *OPTIONS.split(),
        "--real",
        f"remote::{port}",
        "--prior",
        str(home / "prior"),
        "--out",
        str(home),
    ]
    first = subprocess.Popen(command)
    folder = home / "finetune/toy/remote/sac/seed-0"
    journal = folder / "real/rollout-000001.steps.jsonl"
    while first.poll() is None and (not journal.exists() or journal.read_text().count("\n") < 8):
        time.sleep(0.01)
    first.send_signal(signal.SIGKILL)
    assert first.wait() == -signal.SIGKILL
    kept = journal.read_text().count("\n") - 1
    subprocess.run([*command, "--resume"], check=True)
    assert client.wait(timeout=30) == 0
    store = RealStore(folder)
    assert len(store) == 3 and [int(store.load(i)["valid"].sum()) for i in range(3)] == [T, kept, T]
    import msgpack

    with open(log, "rb") as file:
        commanded = list(msgpack.Unpacker(file))
    assert len(commanded) - (2 * T + kept) in (0, 1)  # at most one that the robot made and nobody learned from


@pytest.mark.slow
def test_a_policy_may_change_between_steps(robot, port, tmp_path):
    robot(port)
    folder = run(tmp_path, port, "--hand-over", "steps", "--eval-episodes", "1", "--eval-every", "2")
    assert len(RealStore(folder)) == 3
    assert sorted(path.name for path in (folder / "evaluation").iterdir()) == [
        f"rollouts-00000{i}" for i in (0, 1, 2, 3)
    ]


@pytest.mark.slow
def test_what_an_evaluation_makes_a_robot_do_is_kept(robot, port, tmp_path):
    robot(port)
    save_prior(tmp_path / "prior", 0)
    args = evaluate.EvaluateArgs(
        task=TASK, prior=tmp_path / "prior", real=(f"remote::{port}",), episodes=2, out=tmp_path / "runs"
    )
    (system,) = evaluate.evaluate(args)["systems"]
    assert system["real_steps"] == 2 * T
    assert len(RealStore(tmp_path / "runs/evaluate/toy/remote")) == 2


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"seeds": 2}, "--seeds 2: one robot plays one seed"),
        ({"real": ("remote", "default")}, "cannot be played together"),
        ({"real": ("remote", "gymnasium:A-v0")}, "cannot be played together"),
        ({"real": ("remote", "remote::1")}, "one robot at a time"),
        ({"real": ("remote:here:there",)}, "write remote, remote:HOST or remote:HOST:PORT"),
        ({"real": ("remote:127.0.0.1:99999",)}, "remote:HOST or remote:HOST:PORT, a port from 1 to 65535"),
        ({"set": ("mass=2",)}, "nothing here can change a robot"),
        ({"hand_over": "steps", "method": "guarded"}, "a guard judges rollouts by one policy"),
        ({"hand_over": "steps", "real": ("sim",)}, "only a robot plays while something learns"),
        ({"eval_at": (0, 1, 2)}, "--eval-at 0 1 2: evaluations have no episodes; say how many with --eval-episodes"),
        ({"sync_every": 0}, "--sync-every is 0"),
    ],
    ids=str,
)
def test_what_a_robot_cannot_do_is_refused_in_one_line(changes, said, tmp_path):
    given = {"task": "push", "method": "sac", "real": ("remote",), "seeds": 1, "out": tmp_path} | changes
    with pytest.raises(UserError, match=said):
        finetune_args.check(finetune_args.arguments(given.pop("method"), **given))


@pytest.mark.parametrize(("real", "given", "episodes"), [("default", None, 50), ("remote", None, 0), ("remote", 5, 5)])
def test_evaluations_cost_a_robot_nothing_unless_asked_for(real, given, episodes):
    args = finetune_args.arguments("sac", real=(real,), seeds=1, eval_episodes=given)
    assert finetune_args.resolved(args).eval_episodes == episodes
    assert (
        grid.FINETUNING.config(args)["eval_episodes"] == episodes
    )  # as the run's folder has it: a grid skips that run
