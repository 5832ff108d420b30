"""The task of `docs/examples/own_task.py` with a control period of 50 ms, so that many kills take less time."""

from envs import Env, extend
from envs.mujoco.scene import make_env
from experiments.studies.reliable.runs import TASK

PERIOD, _SUBSTEP = 0.05, 0.01  # s


def make(impl: str = "auto") -> Env:
    """The task: what `--task` looks for."""
    scene = extend.load("--task", str(TASK), "SCENE").SCENE
    return make_env(
        scene._replace(name="quick_task", control_dt=PERIOD, substeps=round(PERIOD / _SUBSTEP), ramp=PERIOD / 2), impl
    )
