"""Impure: pictures and videos of episodes, drawn by C MuJoCo with a graphics context.

Rendering needs a graphics library but no screen: set MUJOCO_GL to egl or osmesa before MuJoCo is first imported.
"""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from envs.mujoco.parts import NO_CONTACT
from envs.mujoco.scene import Scene, View
from envs.types import UserError

FPS = 10  # in real time; a graphics library without a graphics card needs 0.1 s a frame
SIZE = 360, 480  # height, width in pixels
CAPTION = 52  # pixels, height of the strip above a captioned video
LEAST = 0.3  # of the camera's distance: what a scene extends over at least
JUMP = 0.5  # m or rad in one control step: an event, such as a puck that fell, and nothing to draw in between
SUPERSAMPLING = 2  # drawn so many times larger, then averaged: smooth edges on every backend
TILE, TILES = 0.75, 16  # m, of a tile of the floor; how many there are along each side
_GROUND = "ground"


def render_episode(scene: Scene, theta: Mapping[str, float] | Sequence[float], qpos: np.ndarray, path: Path) -> None:
    """Writes the episode as `path` (.mp4) and the frame in its middle as .png beside it.

    theta: domain parameters by name or in the order of `scene.parameters`. qpos: [T + 1, nq], one per control step.
    Raises UserError when MuJoCo cannot render here.
    """
    frames = list(_frames(scene, theta, qpos))
    _write(path, frames, frames[len(frames) // 2])


def render_side_by_side(
    scene: Scene,
    thetas: Sequence[Mapping[str, float] | Sequence[float]],
    episodes: Sequence[np.ndarray],
    captions: Sequence[str],
    path: Path,
) -> None:
    """Writes several episodes of one task as one video, side by side, each under its caption; see `render_episode`."""
    write_side_by_side(
        [list(_frames(scene, *episode)) for episode in zip(thetas, episodes, strict=True)], captions, path
    )


def write_side_by_side(columns: Sequence[Sequence[np.ndarray]], captions: Sequence[str], path: Path) -> None:
    """Writes columns of frames [*SIZE, 3] uint8, each under its caption, as one video, and its last frame as .png.

    A column that ends earlier shows its last frame until the end. The last frame shows how each has ended.
    """
    pairs = list(zip(map(_caption, captions), columns, strict=True))

    def frame(i: int) -> np.ndarray:
        parts = [np.concatenate([strip, column[min(i, len(column) - 1)]]) for strip, column in pairs]
        return np.concatenate(parts, axis=1)

    frames = [frame(i) for i in range(max(map(len, columns)))]
    _write(path, frames, frames[-1])


def smooth(qpos: np.ndarray, *, control_dt: float, fps: float) -> np.ndarray:
    """[frames, nq]: qpos [T + 1, nq] at control steps of so many s, linear in between; jumps stay jumps."""
    last = len(qpos) - 1
    index = np.minimum(np.arange(round(last * control_dt * fps) + 1) / (control_dt * fps), last)
    before = np.floor(index).astype(int)
    after = np.minimum(before + 1, len(qpos) - 1)
    move = qpos[after] - qpos[before]
    move = np.where(np.abs(move) > JUMP, 0.0, move)
    return qpos[before] + (index - before)[:, None] * move


def _frames(scene: Scene, theta: Mapping[str, float] | Sequence[float], qpos: np.ndarray) -> Iterator[np.ndarray]:
    values = theta.values() if isinstance(theta, Mapping) else theta
    by_name = dict(zip([p.name for p in scene.parameters], map(float, values), strict=True))
    model = dressed(scene, by_name).compile()
    # What is drawn begins and ends at multiples of the extent, which MuJoCo takes from the scene at rest.
    model.stat.extent = max(model.stat.extent, LEAST * (scene.view.distance if scene.view else 1.0))
    data = mujoco.MjData(model)
    camera = _camera(model, scene.view)
    renderer = _renderer(model)
    try:
        for row in smooth(np.asarray(qpos), control_dt=scene.control_dt, fps=FPS):
            data.qpos[:] = row
            if scene.view is not None and scene.view.follow:
                _follow(model, data, scene.view, camera)
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            yield _shrink(renderer.render())
    finally:
        renderer.close()


def _follow(model: mujoco.MjModel, data: mujoco.MjData, view: View, camera: mujoco.MjvCamera) -> None:
    """Takes the camera and the floor along. The floor goes by whole pairs of tiles: they seem to stay."""
    mujoco.mj_kinematics(model, data)
    place = data.body(view.follow).xpos
    camera.lookat[:] = place + view.target
    if view.floor is not None:
        ground = model.body(_GROUND).mocapid[0]
        data.mocap_pos[ground, :2] = 2 * TILE * np.round(place[:2] / (2 * TILE))


def dressed(scene: Scene, theta: dict[str, float]) -> mujoco.MjSpec:
    """The scene of one theta with what only a viewer needs: sky, lights, a floor, and the scene's own decoration."""
    spec = scene.build(theta)
    scene.dress(spec)
    _add_surroundings(spec, scene.view)
    _add_lights(spec, follow=scene.view.follow if scene.view else "")
    visual = spec.visual
    visual.map.znear, visual.map.zfar = 0.02, 20
    visual.quality.shadowsize, visual.quality.offsamples = 1024, 0
    visual.map.shadowclip = 3  # shadows reach further than the picture: MuJoCo draws stripes where they end
    visual.global_.offheight, visual.global_.offwidth = (SUPERSAMPLING * n for n in SIZE)
    return spec


def _add_surroundings(spec: mujoco.MjSpec, view: View | None) -> None:
    look = {"width": 256, "height": 256}
    gradient, checker = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, mujoco.mjtBuiltin.mjBUILTIN_CHECKER
    sky, flat = mujoco.mjtTexture.mjTEXTURE_SKYBOX, mujoco.mjtTexture.mjTEXTURE_2D
    spec.add_texture(name="sky", type=sky, builtin=gradient, rgb1=[0.92, 0.94, 0.97], rgb2=[0.6, 0.67, 0.77], **look)
    if view is None or view.floor is None:
        return
    spec.add_texture(name="tiles", type=flat, builtin=checker, rgb1=[0.84, 0.85, 0.87], rgb2=[0.78, 0.8, 0.82], **look)
    tiles = spec.add_material(name="tiles", texrepeat=[TILES / 2, TILES / 2], reflectance=0.0)
    tiles.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    ground = spec.worldbody.add_body(name=_GROUND, mocap=True, pos=[0, 0, view.floor])
    half = TILE * TILES / 2
    ground.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[half, half, 0.1], material="tiles", **NO_CONTACT)


def _add_lights(spec: mujoco.MjSpec, *, follow: str) -> None:
    """follow: the body that the light which casts shadows keeps beside: shadows end some metres from a light."""
    for light in spec.lights:
        spec.delete(light)
    sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    add = spec.worldbody.add_light
    home = spec.body(follow) if follow else spec.worldbody
    track = mujoco.mjtCamLight.mjCAMLIGHT_TRACK if follow else mujoco.mjtCamLight.mjCAMLIGHT_FIXED
    bright = {"diffuse": [0.5] * 3, "specular": [0.2] * 3, "castshadow": True}
    home.add_light(type=sun, mode=track, pos=[0.9, -1.0, 2.5], dir=[-0.35, 0.4, -1.0], **bright)
    add(type=sun, pos=[0.5, 1.5, 2.0], dir=[0.3, -0.7, -0.6], diffuse=[0.2] * 3, specular=[0.0] * 3, castshadow=False)
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.35] * 3, [0.2] * 3


def _renderer(model: mujoco.MjModel) -> mujoco.Renderer:
    try:
        return mujoco.Renderer(model, *(SUPERSAMPLING * n for n in SIZE))
    except Exception as error:  # MuJoCo raises whatever its graphics backend does
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        raise UserError(
            f"MuJoCo cannot render here ({reason}); install libegl1 or libosmesa6 and set MUJOCO_GL to egl or osmesa"
        ) from error


def _camera(model: mujoco.MjModel, view: View | None) -> mujoco.MjvCamera:
    camera = mujoco.MjvCamera()
    mujoco.mjv_defaultFreeCamera(model, camera)
    if view is not None:
        camera.lookat[:], camera.distance = view.target, view.distance
        camera.azimuth, camera.elevation = view.azimuth, view.elevation
    return camera


def _shrink(image: np.ndarray) -> np.ndarray:
    n, zero = SUPERSAMPLING, np.zeros((), np.uint16)
    rows = sum((image[i::n] for i in range(n)), zero)  # ten times faster than a sum over axes of blocks
    return (sum((rows[:, i::n] for i in range(n)), zero) // n**2).astype(np.uint8)


def _caption(text: str) -> np.ndarray:
    """[CAPTION, width, 3] a strip with the text, shrunk until it fits."""
    from PIL import Image, ImageDraw, ImageFont

    strip = Image.new("RGB", (SIZE[1], CAPTION), (28, 30, 36))
    draw = ImageDraw.Draw(strip)
    size = 32.0
    while draw.textlength(text, font=ImageFont.load_default(size)) > SIZE[1] - 24 and size > 8:
        size -= 1.0
    middle = SIZE[1] / 2, CAPTION / 2
    draw.text(middle, text, fill=(240, 240, 240), font=ImageFont.load_default(size), anchor="mm")
    return np.asarray(strip)


def _write(path: Path, frames: list[np.ndarray], still: np.ndarray) -> None:
    import imageio_ffmpeg
    import mediapy

    path.parent.mkdir(parents=True, exist_ok=True)
    mediapy.set_ffmpeg(imageio_ffmpeg.get_ffmpeg_exe())
    mediapy.write_video(path.with_suffix(".mp4"), frames, fps=FPS, crf=20)
    mediapy.write_image(path.with_suffix(".png"), still)
