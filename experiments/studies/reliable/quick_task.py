"""The task of `docs/examples/own_task.py` with a control period of 50 ms, so that many kills take less time."""

from envs import Env, extend
from envs.mujoco.scene import make_env
from experiments.studies.reliable.trial import QUICK_PERIOD, TASK

_SUBSTEP = 0.01  # s


def make(impl: str = "auto") -> Env:
    """The task: what `--task` looks for."""
    scene = extend.load("--task", str(TASK), "SCENE").SCENE
    times = {"control_dt": QUICK_PERIOD, "substeps": round(QUICK_PERIOD / _SUBSTEP), "ramp": QUICK_PERIOD / 2}
    return make_env(scene._replace(name="quick_task", **times), impl)
