"""The benchmark measures what it says it does; how fast things are is not tested."""

import json
import os
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from priors_by_hand import save_prior

from envs.franka import hammer
from envs.mujoco.worlds import PhysicsState
from envs.types import UserError
from experiments.bench import physics, startup, training, updates
from experiments.bench.timing import fastest, fastest_in_turns, measure
from experiments.benchmark import BenchmarkConfig, main


def test_the_fastest_call_counts_without_the_first(monkeypatch):
    times = iter([10.0, 10.5, 20.0, 20.25, 30.0, 31.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(times))
    calls = []
    assert fastest(lambda: calls.append(1), repeats=3) == 0.25 and len(calls) == 4


def test_calls_in_turns_are_timed_apart(monkeypatch):
    times = iter([10.0, 11.0, 20.0, 20.5, 30.0, 30.25, 40.0, 42.0])  # a, b, a, b
    monkeypatch.setattr(time, "perf_counter", lambda: next(times))
    calls = []
    found = fastest_in_turns([lambda: calls.append("a"), lambda: calls.append("b")], repeats=2)
    assert found == [0.25, 0.5] and "".join(calls) == "ababab"


def test_memory_is_that_of_the_compiled_program():
    timing = measure(lambda x: x + 1.0, (jnp.zeros(250_000),), repeats=1)
    assert timing.memory_mb == pytest.approx(2.0, rel=0.01)  # a megabyte in, one out
    assert timing.compile_s > 0 and timing.seconds > 0


SMALL = BenchmarkConfig(
    tasks=("hammer",), worlds=(2,), impls=("c",), control_steps=2, repeats=1, width=8, batches=(4,), updates=2
)


@pytest.mark.slow
def test_updates_are_compared_with_the_hand_written_ones(tmp_path):
    with jax.numpy_rank_promotion("allow"):  # the hand-written update broadcasts ensembles against batches
        (line,) = main(replace(SMALL, parts=("updates",), out=tmp_path))["updates"]
    assert line["updates/bare"] == pytest.approx(line["updates_per_s"] / line["bare_per_s"])
    assert line["gb_per_update"] > 1e-6


@pytest.mark.slow
def test_a_hybrid_run_is_compared_with_its_hand_written_update(tmp_path):
    with jax.numpy_rank_promotion("allow"):  # the hand-written update and MJX promote ranks
        config = replace(SMALL, parts=("hybrid",), tasks=("halfcheetah",), impls=("jax",), out=tmp_path)
        (line,) = main(config)["hybrid"]
    assert line["members"] == 1 and line["run/bare"] == pytest.approx(line["updates_per_s"] / line["bare_per_s"])
    assert line["simulators_share"] == pytest.approx(1 - line["run/bare"] / line["updates/bare"])


@pytest.mark.slow
@pytest.mark.usefixtures("toy_task")
def test_a_rollout_through_a_system_is_compared_with_a_fused_one(tmp_path):
    for seed in (0, 1):
        save_prior(tmp_path / "prior" / f"seed-{seed}", seed)
    config = replace(SMALL, parts=("system",), tasks=("toy",), seeds=(2,), prior=tmp_path, out=tmp_path)
    (line,) = main(config)["system"]
    assert line["seeds"] == 2 and line["fused/system"] == pytest.approx(line["fused_s"] / line["system_s"])


@pytest.mark.slow
def test_numbers_reach_the_disk(tmp_path, capsys):
    measured = main(replace(SMALL, parts=("physics", "plain"), out=tmp_path))
    (line,), (plain,) = measured["physics"], measured["plain"]
    assert line["worlds"] == 2 and line["env/bare"] == pytest.approx(line["env_per_s"] / line["bare_per_s"])
    assert plain["updates_per_s"] > 0
    stored = json.loads((tmp_path / "benchmark" / "summary.json").read_text())
    assert stored["physics"] == [line] and stored["plain"] == [plain]
    assert stored["provenance"]["versions"]["mujoco"]
    assert "hammer" in capsys.readouterr().out


def test_engines_alone_repeat_the_commands_they_are_given(monkeypatch):
    """MuJoCo's rollout from that state under these commands ends where single steps do; MJX's too, in a slow test."""
    host, window, expected = _window()
    seen = []
    rollout = physics.mujoco.rollout.Rollout.rollout
    monkeypatch.setattr(
        physics.mujoco.rollout.Rollout, "rollout", lambda *a, **k: seen.append(rollout(*a, **k)) or seen[-1]
    )
    assert physics._c_alone(host, window, 3, repeats=1) > 0
    state = seen[-1][0]
    assert state.shape[1] == 6  # two control periods of three steps
    np.testing.assert_allclose(state[:, -1, 1 : 1 + host.nq], expected, atol=1e-6)


@pytest.mark.slow
def test_mjx_alone_repeats_the_commands_it_is_given(monkeypatch):
    host, window, expected = _window()
    seen = []
    monkeypatch.setattr(physics, "measure", lambda run, given, repeats: seen.append(jax.jit(run)(*given)))
    with jax.numpy_rank_promotion("allow"):
        physics._mjx_alone(host, "jax", window, 3, 1)
    np.testing.assert_allclose(seen[0][0], expected, atol=1e-5)


def _window():
    """(Hammering's scene, two worlds of it moved gently, so that no servo saturates, where C MuJoCo takes them)."""
    host = hammer.build({p.name: p.nominal for p in hammer.PARAMETERS}).compile()
    arm = np.asarray(hammer.initial(jnp.array([p.nominal for p in hammer.PARAMETERS]), jax.random.key(0)).qpos)
    commands = arm[: host.nu] + 0.003 * np.array([[[1.0], [-1.0]], [[2.0], [0.5]]])
    ends = []
    for world in range(2):
        data = physics.mujoco.MjData(host)
        data.qpos[:] = arm
        for ctrl in commands[:, world]:
            data.ctrl[:] = ctrl
            physics.mujoco.mj_step(host, data, 3)
        ends.append(data.qpos.copy())

    def two(x):
        return jnp.broadcast_to(jnp.asarray(x, jnp.float32), (2, len(x)))

    start = PhysicsState(two(arm), two(np.zeros(host.nv)), two(np.zeros(host.nv)), two(arm[: host.nu]), two([]))
    return host, physics.Window(start, jnp.asarray(commands, jnp.float32)), np.stack(ends)


def test_another_librarys_agent_gets_the_sizes_and_a_full_replay(monkeypatch):
    """The library is played by a stand-in: it needs not be installed."""

    class Agent:
        def __init__(self, policy, env, *, batch_size, buffer_size, policy_kwargs):
            self.asked = (policy, env.observation_space, env.action_space, batch_size, buffer_size, policy_kwargs)
            self.rows = []
            self.replay_buffer = SimpleNamespace(add=lambda *row: self.rows.append(row))
            agents.append(self)

        def set_logger(self, logger):
            assert logger == ("in", None)  # no folder, no formats: nothing is left behind

        def train(self, *, gradient_steps, batch_size):
            return gradient_steps, batch_size

    agents: list[Agent] = []
    box = SimpleNamespace(Box=lambda low, high, shape, dtype: shape)
    modules = {
        "gymnasium": SimpleNamespace(Env=object, spaces=box),
        "sbx": SimpleNamespace(SAC=Agent),
        "stable_baselines3.common.logger": SimpleNamespace(Logger=lambda folder, formats: ("in", folder, *formats)),
    }
    monkeypatch.setattr(updates.importlib, "import_module", modules.__getitem__)
    train = updates.other_sac("sbx", batch=4, width=8, obs_dim=3, act_dim=2, capacity=5)
    assert agents[0].asked == ("MlpPolicy", (3,), (2,), 4, 5, {"net_arch": [8, 8]}) and len(agents[0].rows) == 5
    assert train(7) == (7, 4)


def test_a_library_that_does_not_import_is_left_out_with_a_word(monkeypatch, capsys):
    def load(name):
        if name == "sbx":
            raise AttributeError("no pytype_aval_mappings")

    monkeypatch.setattr(updates.importlib.util, "find_spec", lambda name: name)
    monkeypatch.setattr(updates.importlib, "import_module", load)
    assert list(updates.importable()) == ["stable_baselines3"]
    assert capsys.readouterr().out == "sbx is installed but left out: AttributeError: no pytype_aval_mappings\n"


def test_startup_is_measured_with_empty_caches_and_with_filled_ones(monkeypatch):
    caches = []

    def run(command, *, env, stdout):
        out = Path(command[-1].removeprefix("--out="))
        assert command[1:3] == ["-m", "experiments.pretrain"] and "--config.env-steps=77" in command
        caches.append((env["SGFT_CACHE_DIR"], env["WARP_CACHE_PATH"]))
        folder = out / "pretrain/push/cpu/seeds-0-1"
        (folder / "prior").mkdir(parents=True)
        os.utime(folder / "prior", (time.time() + 5, time.time() + 5))
        seeds = [{"success": 1.0}, {"success": 0.9}]
        (folder / "summary.json").write_text(json.dumps({"impl": "c", "seeds": seeds, "time/train_s": 2.0}))
        return SimpleNamespace(returncode=0)

    monkeypatch.setattr(startup.subprocess, "run", run)
    empty, filled = startup.to_priors("push", "c", 2, preset="cpu", env_steps=77)
    assert caches[0] == caches[1] and not Path(caches[0][0]).parent.exists()
    assert (empty["caches"], filled["caches"]) == ("empty", "filled")
    assert empty["success"] == 0.9 and empty["train_s"] == 2.0 and 5 <= empty["prior_s"] < 6
    monkeypatch.setattr(startup.subprocess, "run", lambda *_, **__: SimpleNamespace(returncode=2))
    with pytest.raises(UserError, match=r"startup: experiments.pretrain --task=push .* has failed, see above"):
        startup.to_priors("push", "c", 2, preset="cpu", env_steps=None)


def test_devices_get_their_shares_and_are_compared_with_as_many_times_one(monkeypatch):
    asked = []

    def pretrain(args):
        asked.append(args)
        speed = {1: 100.0, 2: 180.0, 4: 300.0}[args.devices]
        steps = args.config.env_steps
        return {"impl": "c", "env_steps": steps, "time/train_s": steps / speed, "time/compile_s": 1.0}

    monkeypatch.setattr(training, "pretrain", pretrain)
    size = {"worlds": 64, "batch": 32, "preset": "cpu", "env_steps": 640}
    found = training.weak_scaling("push", "c", (4, 1, 2), **size)
    assert [line["env/ideal"] for line in found] == pytest.approx([1.0, 0.9, 0.75])
    assert [line["ideal_per_s"] for line in found] == pytest.approx([100.0, 200.0, 400.0])
    sizes = [(args.config.n_envs, args.config.batch_size, args.config.env_steps) for args in asked]
    assert sizes == [(256, 128, 2560), (64, 32, 640), (128, 64, 1280)]
    assert asked[2].config.replay_capacity == 2 * training.PRESETS["cpu"].replay_capacity


@pytest.mark.slow
def test_one_device_trains_and_is_its_own_ideal(tmp_path):
    (line,) = main(replace(SMALL, parts=("devices",), preset="cpu", env_steps=200, out=tmp_path))["devices"]
    assert line["env_per_s"] > 0 and line["env/ideal"] == 1.0


@pytest.mark.heavy_after_first
@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"tasks": ("hamer",)}, "task: there is no 'hamer', did you mean 'hammer'?"),
        ({"worlds": (4, 0)}, "--worlds is 0"),
        ({"repeats": 0}, "--repeats is 0"),
        ({"parts": ("devices",), "devices": (2, 0)}, "--devices is 0"),
        ({"batches": ()}, "--batches is 0"),
        ({"control_steps": 30}, "--control-steps 30 is more than half an episode of push"),
        ({"parts": ("finetune",)}, "--parts finetune needs --prior FOLDER"),
        ({"preset": "fats"}, "--preset: there is no 'fats', did you mean 'fast'?"),
    ],
)
def test_bad_input(change, complaint, tmp_path, monkeypatch):
    for module in (physics, updates):
        monkeypatch.setattr(module, "speed", lambda *_, **__: pytest.fail("measured"))
    with pytest.raises(UserError, match=complaint.replace("?", r"\?")):
        main(BenchmarkConfig(out=tmp_path, **change))
    assert not (tmp_path / "benchmark").exists()
