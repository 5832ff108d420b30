"""A task that cannot be meant is refused where it is made, in one line that names task and field."""

from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

import envs
from envs import extend
from envs.base import Entry, Parameter, World
from envs.mujoco.scene import Measured, make_env
from envs.mujoco.worlds import PhysicsState
from envs.types import UserError

EXAMPLE = extend.load("task", str(Path(__file__).parents[2] / "docs/examples/own_task.py"), "make")
SCENE = EXAMPLE.SCENE
MASS, FRICTION = EXAMPLE.PARAMETERS
NAN = float("nan")


def twice(entries):
    return (*entries, entries[0])


def state(change):
    def initial(params, key):
        return change(SCENE.initial(params, key))

    return initial


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"name": ""}, "'name'"),
        ({"observation": ()}, "'observation' must be a tuple of entries, at least one"),
        ({"observation": twice(SCENE.observation)}, "'observation' must have names that differ, got pusher_x"),
        ({"action": (Entry("push", "N", 0),)}, "'action' has 'push', whose size must be a whole number of at least 1"),
        ({"action": (Entry("push", "N", -1),)}, "'action' has 'push', whose size must be"),
        ({"action": (Entry("push", "N", 1, error=-1.0),)}, "'action' has 'push', whose error must be"),
        ({"parameters": (MASS, MASS)}, "'parameters' must have names that differ, got puck_mass"),
        ({"parameters": (MASS._replace(name="latency"),)}, "'parameters' must not be called like effects, got latency"),
        (
            {"parameters": (MASS._replace(nominal=NAN), FRICTION)},
            "'parameters' has 'puck_mass', whose nominal value and range must be",
        ),
        (
            {"parameters": (MASS._replace(high=1e39), FRICTION)},
            "'parameters' has 'puck_mass', whose nominal value and range must be",
        ),
        (
            {"parameters": (MASS._replace(low=0.12, high=0.08), FRICTION)},
            "'parameters' has 'puck_mass', which needs minimum <= low <=",
        ),
        (
            {"parameters": (MASS._replace(nominal=0.2), FRICTION)},
            "'parameters' has 'puck_mass', which needs minimum <= low <=",
        ),
        (
            {"parameters": (MASS._replace(minimum=0.09), FRICTION)},
            "'parameters' has 'puck_mass', which needs minimum <= low <=",
        ),
        ({"episode_length": 0}, "'episode_length' must be a whole number of at least 1, got 0"),
        ({"episode_length": 1.5}, "'episode_length' must be a whole number"),
        ({"control_dt": 0.0}, "'control_dt' must be a number of seconds above 0"),
        ({"control_dt": NAN}, "'control_dt' must be a number of seconds above 0"),
        ({"control_dt": 0.1}, "'control_dt' is 0.1 s, but 20 substeps of MuJoCo's timestep take 0.2 s"),
        ({"substeps": 0}, "'substeps' must be a whole number of at least 1"),
        ({"ramp": -0.1}, "'ramp' must be a number of seconds, not negative"),
        ({"max_speed": 0}, "'max_speed' must be a number above 0"),
        ({"score": "points"}, "'score' must be one of success, return, got points"),
        ({"success": None}, "'score' is 'success', but nothing tells its success"),
        ({"success_anytime": 1}, "'success_anytime' must be True or False"),
        ({"cartesian": True}, "'cartesian' needs an action that begins with x and y"),
        ({"training": {"obs_nois": 0.1}}, "'training': 'obs_nois' is neither"),
        ({"training": {"latency": 0.3}}, "'training': effect 'latency'"),
        ({"actuators": {"obs_noise": [2.0, 1.0]}}, "'actuators': effect 'obs_noise' needs finite numbers"),
        ({"reward": lambda o, a, n: jnp.int32(1)}, r"'reward' must be a float32 of shape \[\], got int32\[\]"),
        ({"reward": lambda o, a, n: n[:1]}, r"'reward' must be a float32 of shape \[\], got float32\[1\]"),
        ({"success": lambda o: o[1]}, r"'success' must be a bool of shape \[\], got float32\[\]"),
        ({"terminated": lambda o, a, n: n[1]}, r"'terminated' must be a bool of shape \[\], got float32\[\]"),
        ({"observe": lambda p, s: s.qpos}, r"'observe' must be a float32 of shape \[3\], got float32\[2\]"),
        ({"observe": lambda p, s: jnp.zeros(3, int)}, r"'observe' must be a float32 of shape \[3\], got int32\[3\]"),
        ({"observe": lambda p, s: {"pusher_x": s.qpos}}, "'observe': observation: 'puck_speed' is not both declared"),
        ({"target": lambda qpos, action: qpos}, r"'target' must be a float32 of shape \[1\], got float32\[2\]"),
        ({"motors": lambda p, before, target: target[0]}, r"'motors' must be a float32 of shape \[1\]"),
        (
            {"initial": state(lambda s: s._replace(qvel=jnp.zeros(3)))},
            r"'initial: qvel' must be a float32 of shape \[2\]",
        ),
        (
            {"initial": state(lambda s: s._replace(ctrl=[0.0]))},
            r"'initial: ctrl' must be a float32 of shape \[1\], got list",
        ),
        ({"initial": state(tuple)}, "'initial' must return a PhysicsState, got tuple"),
        ({"event": lambda p, s: s.qpos}, "'event' must return a PhysicsState"),
        (
            {"settled": lambda p, obs: PhysicsState(obs, obs, obs, obs)},
            r"'settled: qpos' must be a float32 of shape \[2\]",
        ),
        (
            {"measured": lambda *step: Measured(reward=jnp.zeros(1))},
            r"'measured: reward' must be a float32 of shape \[\]",
        ),
        ({"measured": lambda *step: Measured(success=jnp.zeros((), bool))}, "measures 'success': then its function"),
    ],
)
def test_a_scene_that_cannot_be_meant(changed, words):
    with pytest.raises(UserError, match=f"^task {changed.get('name', 'own_task')}:? ?{words}"):
        make_env(SCENE._replace(**changed), "c")


def test_a_python_number_is_a_reward():
    assert make_env(SCENE._replace(reward=lambda o, a, n: 1.0), "c").reward is not None


@pytest.fixture
def task(tmp_path, monkeypatch):
    """Writes a task of somebody's that is the toy, changed by a line: -> the file."""
    monkeypatch.setattr(envs, "TASKS", dict(envs.TASKS))

    def write(line):
        text = "import jax.numpy as jnp, toy\n\ndef make(impl):\n    env = toy.make()._replace(name='mine')\n"
        (tmp_path / "mine.py").write_text(f"{text}    {line}\n    return env\n")
        return str(tmp_path / "mine.py")

    return write


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("env = env._replace(parameters=env.parameters * 2)", "task mine: 'parameters' must have names that differ"),
        (
            "env = env._replace(make_worlds=lambda theta: theta)",
            "task mine: 'make_worlds' must return a World, got Theta",
        ),
        ("env = env._replace(reset=lambda w, k: k)", "task mine: 'reset' and 'step' must return an EnvState"),
        (
            "one = env.step; env = env._replace(step=lambda *x: one(*x)._replace(reward=jnp.zeros((), int)))",
            "task mine: 'step: reward' must be a float32 of shape [], got int32[]",
        ),
        (
            "one = env.step; env = env._replace(step=lambda *x: one(*x)._replace(physics=jnp.zeros(2)))",
            "task mine: 'step' must return a state like that of 'reset'",
        ),
        (
            "one = env.reset; env = env._replace(reset=lambda *x: one(*x)._replace(true_obs=jnp.full(4, jnp.nan)))",
            "task mine: 'reset' must observe finite numbers, got [nan nan nan nan]",
        ),
        ("env = env._replace(reward=lambda o, a, n: o.nothing)", "line 5: AttributeError"),
        (
            "env = env._replace(success=lambda o: o[0])",
            "task mine: 'success' must be a bool of shape [], got float32[]",
        ),
    ],
)
def test_a_task_of_plain_functions_that_cannot_be_meant(task, line, words):
    with pytest.raises(UserError) as refused:
        envs.make(task(line))
    assert words in str(refused.value) and "\n" not in str(refused.value)


def test_a_step_that_is_not_finite_is_invalid(task, key):
    """MuJoCo's state is not asked: what is observed and rewarded counts."""
    spoilt = "one = env.step; env = env._replace(step=lambda *x: one(*x)._replace(reward=jnp.log(x[2][0])))"
    env = envs.make(task(spoilt))
    world = jax.tree.map(lambda x: x[0], envs.sample_worlds(env, key, 1))
    assert isinstance(world, World)
    start = env.reset(world, key)
    ends = [bool(env.step(world, start, jnp.array([first, 0.0]), key).invalid) for first in (0.5, -0.5)]
    assert ends == [False, True]


def test_values_that_no_physics_means_have_a_bound():
    assert Parameter("mass", "kg", 0.2, 0.1, 0.3, minimum=0.01).bounds == (0.01, 300.0)
    assert Parameter("place", "m", 0.0, 0.0, 0.0).bounds == (-1000.0, 1000.0)
    assert Parameter("share", "", 0.5, 0.0, 1.0, 0.0, 1.0).bounds == (0.0, 1.0)
