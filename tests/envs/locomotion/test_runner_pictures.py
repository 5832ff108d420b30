"""The camera keeps beside a runner, however far it gets."""

import mediapy
import numpy as np
import pytest
from runners import TASKS, at_rest, theta_of

from envs import gaps
from envs.mujoco import render
from experiments.cli import select_renderer


def share_of_orange(path):
    """Of the picture, which is that of one leg."""
    picture = mediapy.read_image(path).astype(int)
    return ((picture[..., 0] > 120) & (picture[..., 0] - picture[..., 2] > 60)).mean()


@pytest.mark.parametrize("task", TASKS)
def test_a_runner_is_in_the_picture_at_any_x(task, tmp_path, monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    if reason := select_renderer():
        pytest.skip(reason)
    seen = []
    for x in (0.0, 300.0):
        qpos = np.tile(np.asarray(at_rest(task).qpos), (40, 1))
        qpos[:, 0], qpos[:, 3] = x, -0.4  # one leg ahead of the other
        render.render_episode(TASKS[task].SCENE, theta_of(task, gaps.SIM), qpos, tmp_path / f"{x}.mp4")
        seen.append(share_of_orange(tmp_path / f"{x}.png"))
    assert seen[0] > 0.001
    np.testing.assert_allclose(seen[1], seen[0], rtol=0.1)
