"""The camera keeps beside a robot, however far it gets, and so does the floor."""

import mediapy
import numpy as np
import pytest
from runners import TASKS, at_rest, theta_of

from envs import gaps
from envs.locomotion import wheel_legged
from envs.mujoco import render
from experiments.runner.pictures import select_renderer


@pytest.fixture(autouse=True)
def _renderer(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    if reason := select_renderer():
        pytest.skip(reason)


def frame(scene, theta, qpos, path):
    """The picture [height, width, 3] of a robot that stays where it is."""
    render.render_episode(scene, theta, np.tile(qpos, (40, 1)), path / "still.mp4")
    return mediapy.read_image(path / "still.png").astype(int)


def share_of_orange(picture):
    """Of the picture, which is that of one leg, or of the mark."""
    return ((picture[..., 0] > 120) & (picture[..., 0] - picture[..., 2] > 60)).mean()


def shows_floor(picture):
    """Whether the lower edge is grey, as tiles are, and not blue, as the sky is."""
    edge = picture[-20:]
    return bool((np.abs(edge[..., 2] - edge[..., 0]) < 15).all())


@pytest.mark.heavy
@pytest.mark.parametrize("task", ["halfcheetah", pytest.param("walker2d", marks=pytest.mark.slow)])
def test_a_runner_is_in_the_picture_at_any_x(task, tmp_path):
    seen = []
    for x in (0.0, 300.0):
        qpos = np.array(at_rest(task).qpos)
        qpos[0], qpos[3] = x, -0.4  # one leg ahead of the other
        picture = frame(TASKS[task].SCENE, theta_of(task, gaps.SIM), qpos, tmp_path)
        assert shows_floor(picture)
        seen.append(share_of_orange(picture))
    assert seen[0] > 0.001
    np.testing.assert_allclose(seen[1], seen[0], rtol=0.1)


@pytest.mark.heavy
def test_a_robot_that_has_left_its_place_has_left_the_mark(tmp_path):
    theta = {p.name: p.nominal for p in wheel_legged.PARAMETERS}
    near, far = (frame(wheel_legged.SCENE, theta, np.array([x, 0.1]), tmp_path) for x in (0.0, 16.4))
    assert shows_floor(near) and shows_floor(far)
    assert share_of_orange(near) > 0.0005 and share_of_orange(far) == 0
    dark = [(picture.max(-1) < 60).mean() for picture in (near, far)]  # wheels
    assert dark[0] > 0.005 and abs(dark[1] / dark[0] - 1) < 0.1
