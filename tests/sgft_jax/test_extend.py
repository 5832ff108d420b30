"""What is wrong with a task or module of one's own is said in one line that names file, line and error."""

import re

import jax
import jax.numpy as jnp
import pytest

import envs
from envs import extend
from envs.types import UserError

OWN = "import envs\n\ndef make(impl):\n    return envs.make('push', impl)\n"
TOY = """import jax.numpy as jnp
import toy
def make(impl):
    return toy.make()._replace(name="mine", {name}={name})
def {name}(*given):
    return jnp.zeros(2) @ jnp.zeros(3)
"""


@pytest.fixture(autouse=True)
def _own(monkeypatch):
    monkeypatch.setattr(envs, "TASKS", dict(envs.TASKS))


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("gone.py", None, "gone.py: No such file or directory"),
        ("torn.py", "def make(:\n", "torn.py: invalid syntax in line 1"),
        ("empty.py", "", "empty.py: does not define `make`; see docs/extending.md"),
        ("other.py", OWN, "its Env is called 'push'; call it 'other', like the file"),
        ("push.py", OWN, "the name 'push' is taken by envs.franka.push; rename the file"),
        ("lost.py", "\nimport a_module_that_is_not_there\n", "lost.py: line 2: ModuleNotFoundError: No module named"),
        ("bad.py", "import json\nx = json.loads('{')\n", "bad.py: line 2: JSONDecodeError: Expecting property name"),
        ("file.py", "open('/nowhere/at/all')\n", "file.py: line 1: FileNotFoundError: [Errno 2]"),
        ("fails.py", "def make(impl):\n    return 1 / 0\n", "fails.py: line 2: ZeroDivisionError: division by zero"),
        ("none.py", "def make(impl):\n    pass\n", "make(impl) returns a NoneType, not an envs.Env"),
    ],
)
def test_a_bad_task_is_one_line(tmp_path, name, text, words):
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=re.escape(words)) as refused:
        envs.make(str(tmp_path / name))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["reset", "step", "make_worlds"])
def test_a_task_that_fails_while_it_runs_is_one_line(tmp_path, name, key):
    (tmp_path / "mine.py").write_text(TOY.format(name=name))

    def play():
        env = envs.make(str(tmp_path / "mine.py"))
        pool = envs.sample_worlds(env, key, 1)

        def rest(carry, obs, key):
            return jnp.zeros(2), carry

        jax.jit(lambda key: envs.play_episode(env, pool, rest, (), key, gamma=0.9))(key)

    with pytest.raises(UserError, match=r"task .*mine\.py: line 6: TypeError: .*\(2,\)") as refused:
        play()
    assert "\n" not in str(refused.value) and refused.value.__cause__ is not None
    (tmp_path / "mine.py").unlink()


def test_modules_are_found_and_their_faults_are_named(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "own_package").mkdir()
    (tmp_path / "own_package/broken.py").write_text("\n\nimport a_module_that_is_not_there\n")
    assert extend.load("task", "envs.franka.push", "SCENE").SCENE is not None
    with pytest.raises(UserError, match=r"no module 'own_package.gone'; a file is named with its .py"):
        extend.load("task", "own_package.gone", "make")
    with pytest.raises(UserError, match=r"own_package.broken: .*broken.py, line 3: ModuleNotFoundError: No module"):
        extend.load("task", "own_package.broken", "make")
