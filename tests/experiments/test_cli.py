import dataclasses
import errno
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Literal

import jax
import pytest

from envs.types import UserError
from experiments.runner import cli, pictures
from sgft_jax.io import runs


@dataclasses.dataclass(frozen=True)
class Inner:
    learning_rate: float = 1e-3
    """Step size."""


@dataclasses.dataclass(frozen=True)
class Config:
    task: Literal["hammer", "push", "insert"] = "hammer"
    """What to do."""
    steps: int = 3
    devices: int | None = None
    minutes: float | None = None
    eval_at: tuple[int, ...] = ()
    shares: tuple[float, ...] = ()
    level: Literal["low", "high"] | None = None
    named: tuple[tuple[str, int], ...] = ()
    inner: Inner = dataclasses.field(default_factory=Inner)

    def __post_init__(self):
        if self.steps < 1:
            raise UserError(f"steps is {self.steps}: must be at least 1")


@pytest.fixture(autouse=True)
def _own_environment(monkeypatch):
    """`set_up` writes to the environment: give it a copy."""
    monkeypatch.setattr(os, "environ", os.environ.copy())


def run(main, *argv):
    cli.run_main(main, Config, "Train.", argv=argv)


def test_main_gets_the_parsed_configuration():
    seen = []
    run(seen.append, "--task", "push", "--inner.learning-rate", "0.5")
    assert seen == [Config("push", 3, inner=Inner(0.5))]


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--task", "hamer"], "--task: there is no 'hamer', did you mean 'hammer'? Choose from: hammer, insert, push"),
        (["--task", "zzz"], "--task: there is no 'zzz'. Choose from: hammer, insert, push"),
        (["--step", "3"], "there is no option --step; did you mean --steps?"),
        (["--steps=3", "--inner.learning_rat=1"], "--inner.learning-rat; did you mean --inner.learning-rate?"),
        (["--zzz"], "there is no option --zzz; --help lists them all"),
        (["--steps", "many"], "--steps many: must be a whole number"),
        (["--steps=many"], "--steps many: must be a whole number"),
        (["--devices", "x", "--steps", "1"], "--devices x: must be a whole number or None"),
        (["--devices", "1", "--devices", "2.5"], "--devices 2.5: must be a whole number or None"),
        (["--minutes", "x"], "--minutes x: must be a number or None"),
        (["--eval_at", "0", "1.5"], "--eval-at 0 1.5: must be whole numbers"),
        (["--shares", "-1", "y"], "--shares -1 y: must be numbers"),
        (["--level", "top"], "--level: there is no 'top'. Choose from: None, high, low"),
        (["--named", "a", "b"], "--named a b: must be something else (Could not find valid parse"),
        (["--steps"], "--steps: needs a value"),
        (["push"], "unexpected word 'push' on the command line; options begin with --"),
    ],
)
def test_a_bad_command_line_is_one_line_and_code_2(argv, words, capsys):
    with pytest.raises(SystemExit) as stopped:
        run(lambda _: pytest.fail("must not start"), *argv)
    out, err = capsys.readouterr()
    assert stopped.value.code == 2 and out == ""
    assert err.startswith("error: ") and err.count("\n") == 1 and words in err


@dataclasses.dataclass(frozen=True)
class Needy:
    policy: Path
    """Where."""
    to: str
    """What."""


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        ([], "error: --policy and --to are missing; see --help\n"),
        (["--policy", "a"], "error: --to is missing; see --help\n"),
        (["--polcy", "a", "--to", "b"], "error: there is no option --polcy; did you mean --policy?\n"),
        (["--policy", "a", "b"], "error: unexpected word 'b' on the command line; options begin with --\n"),
    ],
)
def test_what_must_be_given_is_asked_for_in_one_line(argv, words, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.run_main(pytest.fail, Needy, "Train.", argv=argv)
    assert stopped.value.code == 2 and capsys.readouterr().err == words


@pytest.mark.parametrize(
    ("argv", "chosen"),
    [
        ([], ("fast", False)),
        (["--preset", "cpu", "--tuned"], ("cpu", True)),
        (["--preset=cpu", "--seed", "1"], ("cpu", False)),
        (["--preset", "cpu", "--preset", "paper"], ("paper", False)),
        (["--presets", "cpu", "push", "--help"], ("fast", False)),
    ],
)
def test_options_that_decide_defaults_are_read_first(argv, chosen):
    found = cli.preview(argv, preset="fast", tuned=False)
    assert (found.preset, found.tuned) == chosen


def test_an_option_read_first_needs_a_value_too():
    with pytest.raises(UserError, match="--preset: needs a value"):
        cli.preview(["--preset"], preset="fast")


def test_a_user_error_is_one_line_and_code_2(capsys):
    def main(config):
        raise UserError(f"runs/x: no prior for {config.task}")

    with pytest.raises(SystemExit) as stopped:
        run(main)
    assert stopped.value.code == 2
    assert capsys.readouterr().err == "error: runs/x: no prior for hammer\n"


def test_what_a_dataclass_refuses_is_one_line_and_code_2(capsys):
    with pytest.raises(SystemExit) as stopped:
        run(pytest.fail, "--steps", "0")
    assert stopped.value.code == 2
    assert capsys.readouterr().err == "error: steps is 0: must be at least 1\n"


def test_a_bug_keeps_its_traceback():
    def main(config):
        raise ZeroDivisionError("bug")

    with pytest.raises(ZeroDivisionError):
        run(main)


def test_want_of_memory_is_one_line_and_code_2(capsys):
    for error, words in (
        (jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: Out of memory allocating 99 bytes.\nmore"), "allocating 99"),
        (MemoryError(), "MemoryError"),
    ):

        def main(config, error=error):
            raise error

        with pytest.raises(SystemExit) as stopped:
            run(main)
        said = capsys.readouterr().err
        assert stopped.value.code == 2 and said.count("\n") == 1
        assert words in said and "lower the batch size" in said


def test_what_is_wrong_with_a_file_is_one_line_and_code_2(tmp_path, capsys):
    (tmp_path / "file").touch()

    def forbidden(config):
        raise PermissionError(errno.EPERM, "Operation not permitted", "there")

    for trouble in (
        forbidden,
        lambda config: (tmp_path / "file").mkdir(),
        lambda config: (tmp_path / "file/x").write_text(""),
        lambda config: tmp_path.write_text(""),
        lambda config: (tmp_path / (300 * "n")).write_text(""),
    ):
        with pytest.raises(SystemExit) as stopped:
            run(trouble)
        said = capsys.readouterr().err
        assert stopped.value.code == 2 and said.count("\n") == 1 and said.startswith("error: ")
        assert str(tmp_path) in said or "there: operation not permitted" in said


@dataclasses.dataclass(frozen=True)
class Long:
    resume: bool = False
    """Continue."""


def test_only_a_command_with_resume_and_a_run_is_told_to_resume(tmp_path, capsys):
    (tmp_path / "run").mkdir()
    (tmp_path / "run/config.json").touch()

    def said(config_type, place):
        def main(config):
            raise PermissionError(errno.EACCES, "Permission denied", str(tmp_path / place))

        with pytest.raises(SystemExit):
            cli.run_main(main, config_type, "Train.", argv=[])
        return capsys.readouterr().err

    going_on, again = "mend that, then the same command with --resume goes on\n", "mend that, then try again\n"
    assert said(Long, "run/real/a.npz").endswith(f"run/real/a.npz: permission denied; {going_on}")
    assert said(Config, "run/real/a.npz").endswith(f"run/real/a.npz: permission denied; {again}")
    assert said(Long, "prior/prior.json").endswith(f"prior/prior.json: permission denied; {again}")


@pytest.mark.parametrize(("config_type", "more"), [(Long, "; as it stands"), (Config, "")])
def test_an_interrupt_says_how_the_run_stands(config_type, more, capsys, monkeypatch):
    def main(config):
        raise KeyboardInterrupt

    monkeypatch.setattr(runs, "outlook", lambda: ["as it stands"])
    with pytest.raises(SystemExit) as stopped:
        cli.run_main(main, config_type, "Train.", argv=[])
    assert stopped.value.code == 130 and capsys.readouterr().err == f"\ninterrupted{more}\n"


PROGRAM = (
    "import dataclasses, errno, os, signal, sys, threading, time\nfrom experiments.runner import cli\n"
    "@dataclasses.dataclass(frozen=True)\nclass Long:\n    resume: bool = False\n"
    "def main(config):\n    {}\n"
    "cli.run_main(main, Long, 'd', argv=[])\n"
)


def without_words(stderr):
    """The same without what a program says that takes seconds to start."""
    return "".join(line for line in stderr.splitlines(keepends=True) if "starting (" not in line)


def what_is_said(main, **more):
    """Exit code and stderr of a command in a process of its own."""
    done = subprocess.run([sys.executable, "-c", PROGRAM.format(main)], capture_output=True, text=True, **more)
    return done.returncode, done.stderr


@pytest.mark.parametrize(
    ("name", "code", "word"), [("SIGTERM", 143, "terminated"), ("SIGHUP", 129, "hung up"), ("SIGINT", 130, "interrupt")]
)
def test_signals_end_a_command_as_ctrl_c_does(name, code, word):
    ended, said = what_is_said(f"os.kill(os.getpid(), signal.{name}); time.sleep(60)")
    assert ended == code and said.startswith(f"\n{word}") and said.count("\n") == 2
    assert "resume" not in said  # no run has begun


@pytest.mark.parametrize(("name", "code", "word"), [("SIGTERM", 143, "terminated"), ("SIGINT", 130, "interrupted")])
def test_a_signal_in_a_function_that_jax_calls_is_no_fault_of_that(name, code, word):
    """JAX makes an error of its own of what such a function raises, without a cause."""
    ended, said = what_is_said(
        f"try: os.kill(os.getpid(), signal.{name}); time.sleep(60)\n"
        "    except KeyboardInterrupt as stopped: error = ValueError(f'INTERNAL: buffer callback: {stopped!r}')\n"
        "    raise error"
    )
    assert (ended, said.split("\n")[1]) == (code, word) and "Traceback" not in said


def in_c(name, times):
    """A program that works in C for minutes, as one that compiles, and gets that signal so many times meanwhile."""
    send = f"lambda: [(time.sleep(0.2), os.kill(os.getpid(), signal.{name})) for _ in range({times})]"
    work = "hashlib.pbkdf2_hmac('sha256', b'', b'', 10**9)"
    return f"import hashlib; threading.Thread(target={send}).start(); {work}"


@pytest.mark.parametrize(("name", "code", "word"), [("SIGINT", 130, "interrupted"), ("SIGTERM", 143, "terminated")])
def test_a_signal_ends_what_python_cannot_interrupt(name, code, word):
    started = time.monotonic()
    ended, said = what_is_said(in_c(name, 1), timeout=60)
    assert (ended, time.monotonic() - started < 30) == (code, True)
    assert said.startswith(f"\n{word}\n") and said.count("\n") == 2


def test_only_a_second_signal_ends_a_robot_in_the_middle():
    ended, said = what_is_said(
        "from experiments.runner.progress import doing; cli.in_order('the robot')\n"
        f"    with doing('compiling the updates'):\n        {in_c('SIGINT', 8)}",
        timeout=60,
    )
    waits = "waiting for the robot until this is done: compiling the updates; a second signal ends the process at once"
    assert (ended, said) == (130, f"compiling the updates\n\ninterrupted: {waits}\n\ninterrupted\n")


def test_a_log_shows_lines_at_once(tmp_path):
    with open(tmp_path / "log", "w") as log:
        program = PROGRAM.format("print('a'); os.kill(os.getpid(), signal.SIGKILL)")
        subprocess.run([sys.executable, "-c", program], stdout=log)
    assert (tmp_path / "log").read_text() == "a\n"


def test_who_ignores_a_signal_keeps_ignoring_it():
    ignore = "trap '' HUP; exec"  # as nohup does
    program = PROGRAM.format("os.kill(os.getpid(), signal.SIGHUP); print('goes on')")
    done = subprocess.run(
        ["sh", "-c", f'{ignore} "$0" -c "$1"', sys.executable, program], capture_output=True, text=True
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, "goes on\n", "")


def test_a_full_disk_is_one_line_whatever_libraries_do_in_their_threads():
    full = "raise OSError(errno.ENOSPC, 'No space left on device', 'x')"
    thread = f"thread = threading.Thread(target=exec, args=[{full!r}, globals()]); thread.start(); thread.join()"
    ended, said = what_is_said(f"{thread}; {full}")
    assert (ended, said) == (2, "error: x: no space left on device; mend that, then try again\n")


def test_what_else_goes_wrong_in_a_thread_is_said():
    thread = "thread = threading.Thread(target=lambda: 1 / 0); thread.start(); thread.join()"
    ended, said = what_is_said(thread)
    assert ended == 0 and "ZeroDivisionError: division by zero" in said


@pytest.mark.slow
def test_a_checkpoint_that_does_not_fit_is_one_line(tmp_path):
    """A limit on the size of files stands for a disk, which cannot be had everywhere."""
    main = (
        "import resource, pathlib, numpy; from sgft_jax.io import checkpoint; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2**16, 2**16)); "
        f"checkpoint.save(pathlib.Path({str(tmp_path)!r}), 0, "
        "{str(i): numpy.random.default_rng(i).random(50_000, 'f4') for i in range(20)}, meta={})"
    )
    ended, said = what_is_said(main)
    assert ended == 2 and without_words(said).count("\n") == 1 and "file too large; mend that" in said


@pytest.mark.heavy_after_first
@pytest.mark.parametrize(
    ("main", "argv", "read", "code", "words"),
    [
        ("print", ["--help"], False, 1, ""),
        ("lambda _: print('word')", [], False, 1, ""),  # stays in Python's buffer until the end
        ("lambda _: [print('line') for _ in range(10_000)]", [], False, 1, ""),
        ("lambda _: print('word', end='') or 1 / 0", [], False, 120, "ZeroDivisionError: division by zero"),
        ("lambda _: os.write(other, b'word')", [], True, 1, "BrokenPipeError: [Errno 32] Broken pipe"),
    ],
)
def test_who_reads_the_output_may_leave(main, argv, read, code, words):
    """No word then; what else goes wrong, another pipe without a reader too, keeps its traceback.

    120 is Python's own code where it cannot print what is left.
    """
    program = (
        "import dataclasses, os; from experiments.runner import cli\n"
        "@dataclasses.dataclass(frozen=True)\nclass C:\n    x: int = 1\n"
        "reader, other = os.pipe(); os.close(reader)\n"
        f"cli.run_main({main}, C, 'd', argv={argv})\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONUNBUFFERED"}
    reader, writer = os.pipe()
    if not read:
        os.close(reader)
    done = subprocess.run(
        [sys.executable, "-c", program], env=environment, stdout=writer, stderr=subprocess.PIPE, text=True
    )
    os.close(writer)
    if read:
        os.close(reader)
    assert done.returncode == code and words in done.stderr and bool(done.stderr) == bool(words)


def test_help_is_complete_and_code_0(capsys):
    with pytest.raises(SystemExit) as stopped:
        run(print, "--help")
    assert stopped.value.code == 0
    shown = capsys.readouterr().out
    assert "Train." in shown and "What to do." in shown and "--inner.learning-rate" in shown


def test_choose():
    options = {"sac": 1, "sgft-sac": 2, "pbrs": 3}
    assert cli.choose("method", "pbrs", options) == 3
    with pytest.raises(UserError) as refused:
        cli.choose("method", "sgft", options)
    assert str(refused.value) == "method: there is no 'sgft', did you mean 'sgft-sac'? Choose from: pbrs, sac, sgft-sac"


# ---------------------------------------------------------------- the environment of a run


def test_set_up_keeps_what_the_user_has_set():
    chosen = "--xla_gpu_triton_gemm_any=false --xla_gpu_command_buffer_scheduling_mode=LHS"
    chosen += " --xla_backend_optimization_level=3"
    os.environ.update(XLA_FLAGS=chosen, JAX_COMPILATION_CACHE_DIR="/mine")
    cli.set_up()
    assert os.environ["XLA_FLAGS"] == chosen
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "/mine"


@pytest.mark.parametrize("gpu", [False, True])
def test_set_up_adds_each_flag_once(monkeypatch, gpu):
    exists = Path.exists
    monkeypatch.setattr(Path, "exists", lambda path: gpu if str(path) == "/dev/nvidiactl" else exists(path))
    os.environ["XLA_FLAGS"] = "--xla_force_host_platform_device_count=2"
    cli.set_up()
    cli.set_up()
    flags = ["--xla_force_host_platform_device_count=2", "--xla_gpu_triton_gemm_any=true"]
    flags += ["--xla_gpu_command_buffer_scheduling_mode=CONCURRENT"]
    assert os.environ["XLA_FLAGS"].split() == flags + ["--xla_backend_optimization_level=1"] * (not gpu)


@pytest.mark.parametrize(
    ("value", "folder"),
    [("", Path.home() / ".cache" / "sgft_jax" / "jax"), ("/tmp/c", Path("/tmp/c")), ("off", None), ("0", None)],
)
def test_cache_folder(value, folder):
    os.environ["SGFT_CACHE_DIR"] = value
    assert cli.cache_folder() == folder


def test_no_cache_when_switched_off():
    os.environ.pop("JAX_COMPILATION_CACHE_DIR", None)
    os.environ["SGFT_CACHE_DIR"] = "off"
    cli.set_up()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


@pytest.mark.slow
def test_a_renderer_that_mujoco_cannot_import_is_one_line():
    words = [sys.executable, "-m", "experiments.evaluate", "--task", "hammer", "--prior", "shipped:hammer/seed-0"]
    environment = {**os.environ, "MUJOCO_GL": "crayon"}
    done = subprocess.run(
        words, env=environment, cwd=Path(__file__).parents[2], capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 2 and without_words(done.stderr).count("\n") == 1
    assert "error: MUJOCO_GL=crayon: MuJoCo cannot use that here (" in done.stderr


def test_the_first_backend_that_renders_is_taken(monkeypatch):
    os.environ.pop("MUJOCO_GL", None)
    monkeypatch.setattr(pictures, "_probe", {"egl": "no driver", "osmesa": None}.get)
    monkeypatch.setattr(pictures.importlib, "reload", lambda module: module)
    assert pictures.select_renderer() is None
    assert os.environ["MUJOCO_GL"] == "osmesa"


def test_no_renderer_is_one_line_with_the_reasons(monkeypatch):
    os.environ.pop("MUJOCO_GL", None)
    monkeypatch.setattr(pictures, "_probe", {"egl": "no driver", "osmesa": "no library"}.get)
    reason = pictures.select_renderer()
    assert "egl: no driver; osmesa: no library" in reason and "\n" not in reason
    assert "MUJOCO_GL" not in os.environ


def test_the_users_backend_is_tried_alone_and_for_real():
    os.environ["MUJOCO_GL"] = "disable"
    assert pictures.select_renderer().startswith("MuJoCo cannot render here (disable: AttributeError")


def test_a_variable_that_jax_cannot_read_is_named_in_one_line():
    code = (
        "from experiments import demo; from experiments.runner import cli; "
        "cli.run_main(lambda args: __import__('jax'), demo.DemoArgs, 'Tries.', argv=[])"
    )
    environ = os.environ | {"JAX_ENABLE_X64": "banana"}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=environ)
    assert done.returncode == 2 and len(done.stderr.splitlines()) == 1
    assert "'banana' for environment 'JAX_ENABLE_X64'; unset it" in done.stderr
