"""The runners in every engine against C MuJoCo: each step of an episode again, from the state it began in."""

import jax
import mujoco
import numpy as np
import pytest
from compiled import make
from runners import EVERY, TASKS, compiled, member, pool_of, thrown

from envs.mujoco.engines import warp as engine_warp

STEPS = 24
SLOWER = ["jax", *(["warp"] if engine_warp.available() else [])]
ENGINES = ["c", *(pytest.param(impl, marks=pytest.mark.slow) for impl in SLOWER)]


@pytest.fixture(scope="module", params=["halfcheetah", pytest.param("walker2d", marks=pytest.mark.slow)])
def falling(request):
    """(task, gaps, pool, states [STEPS + 1, gaps], actions [STEPS, gaps, 6])."""
    names = [name for own, name in EVERY if own == request.param and name != "joint-noise"]
    env = make(request.param, "c")
    pool = pool_of(env, names)
    return request.param, names, pool, *thrown(env, pool, STEPS)


def repeated(task, gap, before, actions):
    """Positions and speeds [STEPS, 9] one control step after each of the states [STEPS]; how many contacts there were.

    The model is compiled from the edited scene itself, not put together from a world's fields.
    """
    model, found, touched = compiled(task, gap), [], 0
    data = mujoco.MjData(model)
    for t, action in enumerate(actions):
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = (x[t] for x in before[:3])
        data.ctrl[:] = action
        mujoco.mj_step(model, data, TASKS[task].SUBSTEPS)
        found.append((data.qpos.copy(), data.qvel.copy()))
        touched += data.ncon
    return *map(np.array, zip(*found, strict=True)), touched


@pytest.mark.heavy
@pytest.mark.parametrize("impl", ENGINES)
def test_every_step_of_every_gap_is_that_of_mujoco(falling, impl):
    """1e-4 in positions and 5e-3 in speeds, on the floor and in the limits too."""
    task, names, pool, states, actions = falling
    env, before = make(task, impl), member(states, slice(0, -1))
    with jax.numpy_rank_promotion("allow"):  # MJX broadcasts matrices against vectors
        again = jax.jit(jax.vmap(jax.vmap(env.step, (0, 0, 0, None)), (None, 0, 0, None)))
        after = again(pool, before, actions, jax.random.key(0))
    assert not after.invalid.any()
    touched = []
    for i, name in enumerate(names):
        qpos, qvel, count = repeated(task, name, member(before.physics, slice(None), i), actions[:, i])
        np.testing.assert_allclose(after.physics.qpos[:, i], qpos, atol=1e-4, err_msg=name)
        np.testing.assert_allclose(after.physics.qvel[:, i], qvel, atol=5e-3, err_msg=name)
        touched.append(count)
    assert min(touched) > 0
    np.testing.assert_allclose(after.reward, states.reward[1:], atol=1e-4 / env.control_dt)
