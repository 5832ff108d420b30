"""Pictures: frames between control steps, and real files where MuJoCo can render."""

import subprocess
from pathlib import Path

import imageio_ffmpeg
import jax
import mediapy
import mujoco
import numpy as np
import pytest

from envs import extend
from envs.franka import hammer, insert, push
from envs.mujoco import render
from envs.types import UserError
from experiments.runner.pictures import select_renderer

ROOT = Path(__file__).parents[3]
SCENES = {"push": push.SCENE, "hammer": hammer.SCENE, "insert": insert.SCENE}


def nominal(scene):
    return {p.name: p.nominal for p in scene.parameters}


def still(scene, steps):
    """qpos [steps + 1, nq] of a scene that waits at its start."""
    params = np.array(list(nominal(scene).values()), np.float32)
    return np.tile(scene.initial(params, jax.random.key(0)).qpos, (steps + 1, 1))


def frames_of(path, height, width):
    """[frames, height, width, 3] of a video."""
    raw = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    done = subprocess.run([imageio_ffmpeg.get_ffmpeg_exe(), "-i", str(path), *raw], capture_output=True, check=True)
    return np.frombuffer(done.stdout, np.uint8).reshape(-1, height, width, 3)


@pytest.fixture
def renderer(monkeypatch):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    if reason := select_renderer():
        pytest.skip(reason)


def test_smooth_is_linear_and_keeps_jumps():
    # 0.2 s at 10 frames a second: one frame in between. The second coordinate jumps by 0.9 m.
    frames = render.smooth(np.array([[0.0, 0.0], [0.1, 0.9], [0.3, 0.9]]), control_dt=0.2, fps=10)
    np.testing.assert_allclose(frames, [[0, 0], [0.05, 0], [0.1, 0.9], [0.2, 0.9], [0.3, 0.9]], atol=1e-12)


@pytest.mark.parametrize("name", SCENES)
def test_dressing_leaves_motion_alone(name):
    """The drawn model has the joints and the solid geoms of the simulated one."""
    scene = SCENES[name]
    plain, drawn = scene.build(nominal(scene)).compile(), render.dressed(scene, nominal(scene)).compile()
    assert drawn.nq == plain.nq and drawn.npair == plain.npair
    data, plain_data = mujoco.MjData(drawn), mujoco.MjData(plain)
    data.qpos[:] = plain_data.qpos[:] = still(scene, 0)[0]
    for model, d in ((drawn, data), (plain, plain_data)):
        mujoco.mj_forward(model, d)
    np.testing.assert_allclose(data.body("link7").xpos, plain_data.body("link7").xpos, atol=1e-12)


@pytest.mark.parametrize("thickness", [0.001, 0.01])
def test_a_driven_nail_is_seen(thickness):
    """Its flat head has sunk to 1 mm below the board, where the hammer stopped; the drawn one stands out."""
    theta = nominal(hammer.SCENE) | {"head_thickness": thickness}
    model = render.dressed(hammer.SCENE, theta).compile()
    data = mujoco.MjData(model)
    data.qpos[-1] = -thickness - 0.001
    mujoco.mj_forward(model, data)
    (dome,) = np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_ELLIPSOID)
    board = theta["nail_z"] - 2 * theta["nail_half_height"]
    assert 0.005 < data.geom_xpos[dome, 2] + model.geom_size[dome, 2] - board < 0.01


@pytest.mark.heavy
def test_a_tiny_scene_is_seen(renderer):
    """Two small balls at one place, and far from where they were: MuJoCo draws to 20 times the extent."""
    task = extend.load("task", str(ROOT / "docs/examples/own_task.py"), "make").SCENE

    def unmarked(theta):
        spec = task.build(theta)
        spec.delete(spec.site("mark"))
        return spec

    def image(scene):
        (frame,) = render._frames(scene, nominal(scene), still(scene, 0))
        return frame.astype(int)

    for scene, marked in ((task, True), (task._replace(build=unmarked), False)):
        r, g, b = np.moveaxis(image(scene), -1, 0)
        assert ((g > np.maximum(r, b) + 20).sum() > 100) == marked
        assert (abs(r - b) < 3).sum() > 100  # grey balls before a blue sky


@pytest.mark.heavy
@pytest.mark.parametrize("name", [pytest.param(x, marks=[pytest.mark.slow] * (x != "push")) for x in SCENES])
def test_pictures_show_the_robot(renderer, tmp_path, name):
    scene = SCENES[name]
    render.render_episode(scene, nominal(scene), still(scene, 1), tmp_path / "sub" / "episode.mp4")
    picture = mediapy.read_image(tmp_path / "sub" / "episode.png")
    assert picture.shape == (*render.SIZE, 3)
    assert picture.std() > 20  # neither black nor blank
    frames = frames_of(tmp_path / "sub" / "episode.mp4", *render.SIZE)
    assert len(frames) == 3  # 0.2 s at 10 frames a second, ends included


@pytest.mark.heavy
def test_side_by_side_waits_for_the_longer_episode(renderer, tmp_path):
    scene, path = push.SCENE, tmp_path / "both.mp4"
    thetas, episodes = [nominal(scene), list(nominal(scene).values())], [still(scene, 1), still(scene, 2)]
    render.render_side_by_side(scene, thetas, episodes, ["before", "after " * 40], path)
    height, width = render.SIZE
    video = frames_of(path, height + render.CAPTION, 2 * width)
    assert len(video) == 5  # of 0.4 s
    assert video[0, : render.CAPTION].max() > 150  # the captions


def test_the_picture_beside_two_films_shows_how_both_have_ended(tmp_path):
    """Three grey frames beside one that stays."""
    columns = [[np.full((*render.SIZE, 3), grey, np.uint8) for grey in greys] for greys in ((50,), (0, 100, 200))]
    render.write_side_by_side(columns, ["before", "after"], tmp_path / "both.mp4")
    left, right = np.split(mediapy.read_image(tmp_path / "both.png")[render.CAPTION :], 2, axis=1)
    assert (left == 50).all() and (right == 200).all()


def test_no_renderer_is_one_line(monkeypatch, tmp_path):
    def broken(*args):
        raise RuntimeError("no display\nlong story")

    monkeypatch.setattr(mujoco, "Renderer", broken)
    with pytest.raises(
        UserError, match=r"^MuJoCo cannot render here \(no display\); install libegl1 or libosmesa6 and"
    ) as e:
        render.render_episode(push.SCENE, nominal(push.SCENE), still(push.SCENE, 1), tmp_path / "x.mp4")
    assert "\n" not in str(e.value)
