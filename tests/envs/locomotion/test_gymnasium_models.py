"""Gymnasium's own models as foreign oracle: ours move alike, the real systems and every gap.

Its files are read where it is installed. A gap is an edit of its model as H2O+'s code makes it, written here once more.
"""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from runners import EVERY, TASKS, compiled

gymnasium = pytest.importorskip("gymnasium", reason="make setup EXTRAS=dev, or pip install 'sgft-jax[gymnasium]'")
FILES = {"halfcheetah": "half_cheetah.xml", "walker2d": "walker2d.xml"}  # of -v4; Walker2d-v5 has other feet
ASSETS = Path(gymnasium.__file__).parent / "envs" / "mujoco" / "assets"
STEPS = 60


def edited(task, gap):
    """Gymnasium's model with the gap, compiled."""
    spec = mujoco.MjSpec.from_file(str(ASSETS / FILES[task]))
    thighs = [j for j in spec.joints if "thigh" in j.name]
    sizes = [g for g in spec.geoms if "thigh" in g.name]
    match gap.removesuffix("-range-only"):
        case "gravity":
            spec.option.gravity = [0, 0, -19.62]
        case "friction":
            for geom in spec.geoms:
                geom.friction = 0.3 * np.array(geom.friction)
        case "big-thigh" | "small-thigh":
            factor = 2.0 if gap == "big-thigh" else 0.5
            for geom in sizes:  # the half length of Walker2d's thigh is no number of the text that C edits
                geom.size = np.array(geom.size) * [factor, factor if task == "halfcheetah" else 1.0, 1.0]
        case "broken-thigh" | "flexible-thigh":
            factor = 0.5 if gap.startswith("broken") else 2.0
            for joint in thighs:
                joint.range = factor * np.array(joint.range)
        case "long-torso":
            torso = spec.geom("torso")
            torso.fromto = [-2, 0, 0, 2, 0, 0]
        case "soft-feet":
            for joint in spec.joints:
                joint.stiffness *= "foot" not in joint.name
    return spec.compile()


def scaled(task, gap, action):
    """The control that D4RL's wrapper makes of an action: Walker2d's thighs get the range that the gap left them."""
    factor = {"broken-thigh": 0.5, "flexible-thigh": 2.0}.get(gap, 1.0) if task == "walker2d" else 1.0
    return action * np.array([factor, 1, 1, factor, 1, 1])


def actions():
    """[STEPS, 6]: strong, and kept for a few steps, so that limits and the floor are met."""
    return np.repeat(np.random.default_rng(0).uniform(-1, 1, (STEPS // 4, 6)), 4, axis=0)


@pytest.mark.filterwarnings("ignore:compiler attribute 'settotalmass' is deprecated")
@pytest.mark.parametrize(("task", "gap"), [pair for pair in EVERY if pair[1] != "joint-noise"])
def test_our_models_move_like_gymnasiums(task, gap):
    """After every step from the same state, through contacts and into limits."""
    ours, theirs = compiled(task, gap), edited(task, gap)
    theirs.actuator_ctrllimited[:] = 0  # else MuJoCo would clip what the wrapper has scaled
    np.testing.assert_allclose(ours.body_mass, theirs.body_mass, rtol=1e-9)
    np.testing.assert_allclose(ours.body_inertia, theirs.body_inertia, rtol=1e-9)
    mine, own = mujoco.MjData(ours), mujoco.MjData(theirs)
    rng, contacts, limited = np.random.default_rng(1), 0, 0
    own.qpos[:] += 0.05 * rng.normal(size=9)
    own.qvel[:] = 0.1 * rng.normal(size=9)
    for action in actions():
        mine.qpos[:], mine.qvel[:], mine.qacc_warmstart[:] = own.qpos, own.qvel, own.qacc_warmstart
        mine.ctrl[:], own.ctrl[:] = action, scaled(task, gap, action)
        for model, data in ((ours, mine), (theirs, own)):
            mujoco.mj_step(model, data, TASKS[task].SUBSTEPS)
        np.testing.assert_allclose(mine.qpos, own.qpos, atol=1e-8)
        np.testing.assert_allclose(mine.qvel, own.qvel, atol=1e-6)
        contacts += own.ncon
        limited += (own.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT).sum()
    assert contacts > 15 and limited > 5
