"""MuJoCo's own system identification as an oracle: in one rollout it and our fit find how strongly a nail is damped.

The two ask the simulator differently. MuJoCo's replays the whole rollout from its exact start under the recorded
controls and compares the nail's height; ours is set to what was measured before each step, twelve numbers that do not
tell what the servos were told before. So ours is less exact where the hammer presses.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scripted

import envs
from envs.base import Varying
from envs.franka import arm, hammer
from envs.observations import with_system
from envs.types import Transition
from sgft_jax.models.system import most_probable_system

pytest.importorskip("mujoco.sysid.report.defaults", reason="make setup EXTRAS=dev, or pip install 'mujoco[sysid]'")
from mujoco import sysid

SCENE, STEPS = hammer.SCENE, 20
LOW, HIGH, MIDDLE = 250.0, 2500.0, 1375.0  # N s/m
TRUE = (600.0, 2200.0)  # far from the middle, where both searches begin
OURS, THEIRS = 0.15, 0.01  # how far either may be off, as a share of the truth
NOMINAL = {p.name: p.nominal for p in SCENE.parameters}
ENV = envs.make("hammer", "c")


@pytest.fixture(scope="module")
def record():
    """(damping) -> (states [STEPS + 1], actions [STEPS]) of a rollout in C MuJoCo that drives the nail home."""
    reset, step, script = jax.jit(ENV.reset), jax.jit(ENV.step), jax.jit(scripted.drive_nail)

    def play(damping):
        params, effects = {**NOMINAL, "nail_damping": damping}, {"obs_noise": 0.0}
        pool = envs.sample_worlds(ENV, jax.random.key(0), 1, params=params, effects=effects)
        world = jax.tree.map(lambda x: x[0], pool)
        states, actions = [reset(world, jax.random.key(1))], []
        for t in range(STEPS):
            actions.append(script(world.theta.params, states[-1].physics, t))
            states.append(step(world, states[-1], actions[-1], jax.random.key(t)))
        return jax.tree.map(lambda *x: jnp.stack(x), *states), jnp.stack(actions)

    return play


def our_fit():
    """(rows [STEPS]) -> the damping that `sysid` finds in them through the simulator."""
    told = with_system(ENV, (Varying("nail_damping", 0, LOW, HIGH),))
    ask, held, spread = told.simulator(), jnp.ones(STEPS, bool), jnp.full(ENV.measured_dim, 1e-3)
    fit = jax.jit(lambda rows: most_probable_system(ask, rows, held, spread, 1).mean[0])
    return lambda rows: LOW + 0.5 * (1.0 + float(fit(rows))) * (HIGH - LOW)


def rows_of(states, actions):
    """What a policy that is told the system sees of a real rollout: nothing of the system."""
    seen = jnp.concatenate([states.obs, jnp.zeros((STEPS + 1, 1))], axis=1)
    return Transition(seen[:-1], actions, jnp.zeros(STEPS), jnp.ones(STEPS), seen[1:])


def their_fit(physics):
    """The damping that MuJoCo finds in the nail's heights after each control step. physics: [STEPS + 1]."""
    spec = SCENE.build(NOMINAL)
    model = spec.compile()
    qpos, qvel, ctrl = (np.asarray(x, np.float64) for x in (physics.qpos, physics.qvel, physics.ctrl))
    names = [("nail_qpos", sysid.SignalType.MjStateQPos)]
    times = SCENE.control_dt * np.arange(STEPS + 1)
    heights = sysid.TimeSeries.from_names(times, qpos[:, arm.N_JOINTS :], model, names)
    start = sysid.create_initial_state(model, qpos[0], qvel[0])
    controls = controls_of(ctrl, model.opt.timestep)
    rollout = sysid.ModelSequences("hammer", spec, "rollout", start, controls, heights, allow_missing_sensors=True)

    def damp(spec, parameter):
        nail, damping = spec.joint("nail"), parameter.value[0]
        nail.damping = np.array([damping, 0.0, 0.0])
        nail.armature = damping * hammer.REACTION_TIME

    params = sysid.ParameterDict()
    params.add(sysid.Parameter("nail_damping", MIDDLE, LOW, HIGH, modifier=damp))
    found, _ = sysid.optimize(params, sysid.build_residual_fn(models_sequences=[rollout]), verbose=False)
    return found["nail_damping"].value[0]


def controls_of(ctrl, dt):
    """What servos were told at every physics step: it moves from one control [STEPS + 1, nu] to the next in a ramp."""
    progress = np.minimum((np.arange(SCENE.substeps) + 1) * dt / SCENE.ramp, 1.0)[None, :, None]
    told = (ctrl[:-1, None] + progress * np.diff(ctrl, axis=0)[:, None]).reshape(-1, ctrl.shape[1])
    told = np.concatenate([told, told[-1:]])  # it wants as many controls as states, and never applies the last one
    return sysid.TimeSeries(dt * np.arange(len(told)), told)


@pytest.mark.slow
def test_one_rollout_tells_our_fit_and_mujocos_the_same_damping(record):
    fit = our_fit()
    for true in TRUE:
        states, actions = record(true)
        assert their_fit(states.physics) == pytest.approx(true, rel=THEIRS)
        assert fit(rows_of(states, actions)) == pytest.approx(true, rel=OURS)
