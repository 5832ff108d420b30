"""The examples of docs/extending.md run, and what is wrong with a file of one's own is said in one line."""

import contextlib
import io
import os
import re
import shlex
from pathlib import Path

import h5py
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import untrained

import envs
from envs import extend, gaps
from envs.types import UserError
from experiments import figures, finetune, hybrid, pretrain
from experiments.runner import cli, finetune_args
from sgft_jax import Batch, NetworkConfig, Prior, get_method
from sgft_jax.files.disk import jsonable
from sgft_jax.io.priors import load_prior, save_prior
from sgft_jax.learners import sac
from sgft_jax.methods import sgft_sac

ROOT = Path(__file__).parent.parent
EXAMPLES = ROOT / "docs/examples"
TASK, METHOD, FIXED_METHOD, GAP = (
    str(EXAMPLES / name) for name in ("own_task.py", "own_method.py", "own_fixed_method.py", "own_gap.toml")
)
NETWORK = NetworkConfig(hidden=(8,))


@pytest.fixture(autouse=True)
def _own(monkeypatch):
    monkeypatch.setattr(envs, "TASKS", dict(envs.TASKS))
    monkeypatch.setattr(os, "environ", {**os.environ, "SGFT_IMPL": "c"})  # nothing to compile
    monkeypatch.setattr(cli, "set_up", lambda: None)


@pytest.fixture(scope="module")
def prior(tmp_path_factory):
    """An untrained prior of the example's task, with its card."""
    home = tmp_path_factory.mktemp("runs")
    config = sac.SACConfig(3, 1, network=NETWORK, ensemble_size=2)
    card = {"task": "own_task", "obs_dim": 3, "act_dim": 1, "network": jsonable(NETWORK), "gamma": 0.9}
    folder = home / "pretrain/own_task/fast/seed-0/prior/seed-0"
    params = jax.jit(lambda key: untrained.sac_params(config, key))(jax.random.key(0))
    save_prior(folder, Prior(params, {**card, "algorithm": "sac", "ensemble_size": 2, "seed": 0}))
    return folder


def test_examples_are_short_and_explained():
    page = (ROOT / "docs/extending.md").read_text()
    for path in EXAMPLES.glob("own_*"):
        assert len(path.read_text().splitlines()) < 85 and f"(examples/{path.name})" in page


@pytest.mark.slow
def test_the_critic_of_the_example_prefers_what_the_policy_does(monkeypatch, capsys):
    """Before anything is learned, and after a rollout too where the critic is kept."""
    example = extend.load("example", str(EXAMPLES / "critic_against_returns.py"), "main")
    for name, value in {"STARTS": 8, "ROLLOUTS": (0, 1), "SEEDS": 1}.items():
        monkeypatch.setattr(example, name, value)
    monkeypatch.chdir(ROOT)
    example.main({"lr_critic": 1e-12})
    lines = [[float(word) for word in line.split()] for line in capsys.readouterr().out.splitlines()[1:]]
    assert [line[0] for line in lines] == [0, 1]
    for _, q, earned, q_random, earned_by_random, share in lines:
        assert q > q_random and earned > earned_by_random and share < 0.5


@pytest.mark.slow
def test_exact_identification_solves_what_the_policy_alone_does_not(monkeypatch, capsys):
    example = extend.load("example", str(EXAMPLES / "exact_identification.py"), "main")
    monkeypatch.setattr(example, "EPISODES", 16)
    monkeypatch.chdir(ROOT)
    example.main(["hammer-2-19"], [])
    alone, commands, both = (int(word) for word in re.findall(r" (\d+) \[", capsys.readouterr().out))
    assert alone < commands < both == 100


# --- a task ---------------------------------------------------------------------------------------------------------


@pytest.mark.heavy
def test_the_task_can_be_solved_and_overshot(key):
    """A careful hand stops the puck at the mark; one that pushes as fast as it can throws it past."""
    env = envs.make(TASK)
    pool = envs.sample_worlds(env, key, 4)

    def act(careful, obs, key):
        return jnp.where(careful, jnp.clip(3 * (0.3 - obs[1:2]), -1, 1), 1.0), careful

    play = jax.jit(jax.vmap(lambda careful, key: envs.play_episode(env, pool, act, careful, key, gamma=0.9)))
    for careful, expected in ((True, 1.0), (False, 0.0)):
        episodes = play(jnp.full(4, careful), jax.random.split(key, 4))
        assert episodes.success.mean() == expected and not episodes.exploded.any()


def test_worlds_differ_in_what_the_parameters_say(key):
    env = envs.make(TASK)
    worlds = envs.sample_worlds(env, key, 3)
    np.testing.assert_allclose(worlds.model["dof_frictionloss"][:, 1], worlds.theta.params[:, 1], rtol=1e-6)
    np.testing.assert_allclose(worlds.model["body_mass"][:, 2], worlds.theta.params[:, 0], rtol=1e-6)


@pytest.mark.parametrize(
    ("right", "wrong", "words"),
    [
        ('type="slide"', 'type="slid"', r"invalid keyword: 'slid'; Element 'joint', line 7$"),
        ('mass="0.2"', 'mass="-1"', r"mass, .* negative in geom; Element name 'tip', id 0, line 7$"),
        (
            'joint="pusher" kp',
            'joint="puser" kp',
            r"unknown transmission target 'puser' .*; Element name '', id 0, line 11",
        ),
        ("</mujoco>", "", r"XML parse error 15; Error=XML_ERROR_PARSING .* Line number=2$"),
    ],
)
def test_what_mujoco_says_of_a_scene_names_the_element_or_the_line(tmp_path, right, wrong, words):
    task = tmp_path / "mine.py"
    task.write_text(Path(TASK).read_text().replace(right, wrong))
    with pytest.raises(UserError, match=r"mine\.py: line \d+: ValueError: .*" + words) as refused:
        envs.make(str(task))
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_commands_take_the_file(prior, tmp_path):
    """Pretraining of a moment; where it leaves what, and what it says comes next."""
    options = """--preset cpu --no-video --no-report --config.n-envs 4 --config.worlds 2 --config.env-steps 60
        --config.random-transitions 64 --config.batch-size 16 --config.chunk-steps 15 --config.updates-per-step 1
        --config.replay-capacity 128 --config.network.hidden 8 --config.eval-episodes 4 --config.ensemble-size 1"""
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        pretrain.main(["--task", TASK, *options.split(), "--out", str(tmp_path)])
    assert (tmp_path / "pretrain/own_task/cpu/seed-0/prior/seed-0/prior.json").exists()
    (line,) = [line for line in said.getvalue().splitlines() if line.startswith("next: ")]
    given = cli.parse(finetune_args.FinetuneArgs, "", shlex.split(line)[4:], default=finetune_args.arguments("guarded"))
    assert given.task == TASK and given.real == ("sim",)  # it comes with no gap `default`
    finetune_args.check(given)


# --- a method -------------------------------------------------------------------------------------------------------


def test_the_transform_by_hand(key):
    bend = extend.load("method", METHOD, "bend").bend(2.0)
    zero = jnp.zeros(3)
    batch = Batch(zero, zero, jnp.array([0.01, -100.0, 2.0]), zero, zero)
    bent = bend.apply(bend.init(None, key), None, batch, key)
    np.testing.assert_allclose(bent.reward, [0.01, -2.0, 2 * np.tanh(1.0)], rtol=1e-4)  # tanh(1) = 0.76


@pytest.mark.heavy
def test_the_method_keeps_the_settings_of_sgft_sac(prior, monkeypatch):
    """Its horizon, branches and warm-ups reach the learner; what SGFT-SAC does besides clipping is done, too."""
    seen, make = {}, sac.make_sac

    def spy(config, hyper):
        learner = make(config, hyper)
        seen["config"] = config, hyper
        return learner._replace(update=lambda s, b, k: (seen.update(batch=b), learner.update(s, b, k))[1])

    monkeypatch.setattr(sac, "make_sac", spy)
    env, known = envs.make(TASK), load_prior(prior)
    found = {}
    for name, method in (("own", get_method(METHOD)), ("ours", get_method("sgft-sac"))):
        tuner = method.build(method.config(), known, env)
        state = jax.eval_shape(lambda t=tuner: t.init(known.params, jax.random.key(0)))
        jax.eval_shape(lambda s, t=tuner: t.learn(s, jax.random.key(0), 1), state)
        found[name] = seen["config"], jax.tree.map(jnp.shape, seen["batch"]), tuner.updates_per_rollout
    assert found["own"] == found["ours"]
    (config, hyper), batch, updates = found["own"]
    assert batch.context == (256 * (1 + 2 * 4), 4) and config.context_dim == 4 and config.actor_batch == 256
    assert hyper.actor_start == updates == 8 * env.episode_length and hyper.actor_ramp == 1000
    assert get_method(METHOD).config().clip_shaped == sgft_sac.Config().clip_shaped == 2.0


@pytest.mark.slow
def test_the_method_runs_alone(capsys):
    extend.load("method", METHOD, "METHOD").main()
    assert re.search(r"mean shaped reward -?\d\.\d+, critic loss \d", capsys.readouterr().out)


@pytest.mark.slow
def test_the_method_and_the_gap_run_in_a_command_and_are_drawn(prior, tmp_path):
    options = """--rollouts 2 --seeds 1 --eval-every 1 --eval-episodes 2 --no-video --options.initial-rollouts 1
        --options.utd 0.2 --options.batch-size 8 --options.branches 1"""
    given = ["--task", TASK, "--method", METHOD, "--real", GAP, "--prior", str(prior), "--out", str(tmp_path)]
    finetune.main([*given, *options.split()])
    run = tmp_path / "finetune/own_task/own_gap/sgft-bent/seed-0"
    assert '"clip_shaped": 2.0' in (run / "config.json").read_text() and (run / "policy/seed-0/prior.json").exists()
    assert "| sgft-bent | 1 |" in figures.figures(figures.FiguresArgs(task=TASK, out=tmp_path)).read_text()


# --- a method of fixed data -----------------------------------------------------------------------------------------


def test_the_method_of_fixed_data_is_read_with_its_presets():
    method = get_method(FIXED_METHOD, "fixed")
    assert (method.name, method.kind, method.config.rows) == ("sac-both", "hybrid", 128)
    args = hybrid.arguments(FIXED_METHOD, preset="small")
    assert (args.options.rows, args.options.hidden) == (16, (32, 32))


@pytest.mark.slow
def test_the_method_of_fixed_data_learns_from_both_kinds_of_rows_in_a_command(tmp_path):
    episodes = np.random.default_rng(0)
    log, n = tmp_path / "log.hdf5", 40
    with h5py.File(log, "w") as file:
        file["observations"] = episodes.normal(size=(n, 3)).astype(np.float32)
        file["next_observations"] = episodes.normal(size=(n, 3)).astype(np.float32)
        file["actions"] = episodes.uniform(-1, 1, (n, 1)).astype(np.float32)
        file["rewards"] = episodes.normal(size=n).astype(np.float32)
        file["terminals"], file["timeouts"] = np.zeros(n, bool), np.arange(n) % 20 == 19
    options = """--gap sim --preset small --options.hidden 8 --options.rows 4 --seeds 1 --no-video
        --schedule.updates 12 --schedule.chunk-updates 6 --schedule.simulators 2 --schedule.buffer 64
        --eval-every 6 --eval-episodes 2"""
    hybrid.main(
        ["--task", TASK, "--method", FIXED_METHOD, "--data", str(log), *options.split(), "--out", str(tmp_path)]
    )
    run = tmp_path / "hybrid/own_task/sim/log/sac-both/seed-0"
    assert (run / "summary.json").exists() and '"rows": 4' in (run / "config.json").read_text()


@pytest.mark.parametrize(
    ("command", "file", "words"),
    [
        (finetune, FIXED_METHOD, "sac-both has nothing for fine-tuning: `online` is None"),
        (hybrid, METHOD, "sgft-bent has nothing for learning from a fixed set of data or a simulator: `fixed` is None"),
    ],
)
def test_a_method_of_the_other_kind_is_refused(command, file, words, capsys):
    with pytest.raises(SystemExit) as stopped:
        command.main(["--method", file])
    assert stopped.value.code == 2 and words in capsys.readouterr().err


# --- a real system --------------------------------------------------------------------------------------------------


def test_the_gap_is_outside_the_training_range(key):
    env = envs.make(TASK)
    gap = gaps.load(env, GAP)
    ranges = {p.name: (p.low, p.high) for p in env.parameters}
    assert gap.params["rail_friction"] < ranges["rail_friction"][0]
    worlds = gaps.worlds(env, gap, key, n=3)
    np.testing.assert_allclose(worlds.theta.params[:, 1], 0.25)
    assert len(np.unique(worlds.theta.params[:, 0])) == 3 and (worlds.theta.effects.low.action_scale == 1.25).all()


@pytest.mark.slow
def test_a_pretended_robot_teaches_a_policy(prior, capsys):
    example = extend.load("example", str(EXAMPLES / "own_gap.py"), "finetune")
    env = envs.make(TASK)
    before = load_prior(prior, task="own_task")
    robot = example.PretendedRobot(env, gaps.load(env, GAP))
    start = robot.reset()
    assert start.shape == (3,) and robot.step(np.ones(1))[0] > start[0]
    options = {"batch_size": 8, "horizon": 2, "utd": 0.1, "critic_warmup": 0, "actor_ramp": 0}
    after = example.finetune(env, robot, before, rollouts=6, **options)
    assert len(re.findall(r"return -?\d+\.\d+, success (?:True|False)", capsys.readouterr().out)) == 6
    assert jax.tree.map(jnp.shape, after) == jax.tree.map(jnp.shape, before.params)
    changed = jax.tree.map(lambda a, b: bool((a != b).any()), after.actor, before.params.actor)
    assert any(jax.tree.leaves(changed))


# --- what can be wrong ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "does not define `METHOD`"),
        ("METHOD = 3\n", "METHOD is a int, not a sgft_jax.Method"),
        ("import sgft_jax\nMETHOD = sgft_jax.Method('sac', sgft_jax.get_method('sac'))\n", "the name 'sac' is taken"),
        ("import sgft_jax\nMETHOD = sgft_jax.Method('a/b', sgft_jax.get_method('sac'))\n", "cannot name a folder"),
    ],
)
def test_a_bad_method_is_one_line_and_code_2(tmp_path, capsys, text, words):
    (tmp_path / "mine.py").write_text(text)
    with pytest.raises(SystemExit) as stopped:
        finetune.main(["--method", str(tmp_path / "mine.py")])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and words in error and error.count("\n") == 1
