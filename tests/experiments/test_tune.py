"""Tuning: the same budget for every method, on another real system, chosen by area under the curve, and used."""

import dataclasses
import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from priors_by_hand import save_prior

from envs import gaps
from envs.types import UserError
from experiments import compare, finetune
from experiments.runner import cli, grid, tuned
from experiments.runner.finetune_args import arguments, resolved, run_folder, with_settings
from experiments.studies import spaces, tune
from sgft_jax.files.disk import jsonable
from sgft_jax.io import checkpoint
from sgft_jax.io.runs import FORMAT
from sgft_jax.methods import get_method

STEPS = 20  # of an episode
SYSTEMS = ("mild", "soft", "default")


@pytest.fixture(autouse=True)
def _toy(toy_task, monkeypatch):
    monkeypatch.setattr("envs.gaps.presets", lambda task: {name: gaps.Gap(name, {}, {}) for name in SYSTEMS})


@pytest.fixture
def ran(monkeypatch):
    """Runs that only leave what is read; later trials are better, the fourth (number 3) lacks something at first."""
    seen = []

    def run(args):
        seen.append(args)
        if args.variant == "trial-3" and len(seen) < 5:
            raise UserError("lacks something")
        for real in args.real:
            number = int(args.variant.removeprefix("trial-")) if "trial" in args.variant else 0
            leave(replace(args, real=(real,)), [[0.0, 0.0], [0.1 * number, 0.1 * number], [0.5, 0.5]])

    monkeypatch.setattr(grid, "finetune", run)
    return seen


def leave(args, success, *, rollouts=(0, 5, 10)):
    """A finished run: success [evaluations][seeds] after so many rollouts."""
    folder = run_folder(args, *args.real)
    folder.mkdir(parents=True, exist_ok=True)
    config = {
        "sgft_jax": "0",
        "format": FORMAT,
        "kind": "finetune",
        "config": jsonable(resolved(args)) | {"real": args.real[0]},
    }
    (folder / "config.json").write_text(json.dumps(config))
    final = {"final": {"rollouts": rollouts[-1]}, "gap": {"name": args.real[0]}}
    (folder / "summary.json").write_text(json.dumps(final))
    with open(folder / "eval.jsonl", "w") as file:
        for n, each in zip(rollouts, success, strict=True):
            line = {"step": STEPS * n, "rollouts": n, "robot_minutes": n / 30, "success": each, "return": each}
            file.write(json.dumps(line) + "\n")
    return folder


def budget(out, **changes):
    given = {"tasks": ("toy",), "methods": ("sac",), "trials": 4, "seeds": 2, "rollouts": 10, "out": out}
    return tune.TuneArgs(**{**given, **changes})


def written(out, method="sac"):
    return json.loads((out / f"tuned/toy/{method}.json").read_text())


# ------------------------------------------------------------ spaces


@pytest.mark.parametrize("method", spaces.SPACES)
def test_a_space_holds_the_default_repeats_nothing_and_is_as_large_as_the_others(method):
    space, default = spaces.space_of(method), spaces.first(method)[0]
    assert all(default[name] in values and len(set(values)) == len(values) for name, values in space.items())
    assert 243 <= math.prod(map(len, space.values())) <= 324
    for values in zip(*(values * 3 for values in space.values()), strict=False):  # each is a value that a method takes
        with_settings(arguments(method), dict(zip(space, values, strict=True)))


@pytest.mark.parametrize("method", spaces.FIRST)
def test_settings_that_are_tried_first_differ_and_are_options_of_the_method(method):
    found = spaces.first(method)
    assert len(found) == 1 + len(spaces.FIRST[method]) == len({str(settings) for settings in found})
    for settings in found:
        with_settings(arguments(method), settings)


def test_warm_up_can_be_chosen_wherever_a_method_but_guarded_has_it():
    options = {name: dataclasses.asdict(get_method(name).config()) for name in spaces.SPACES if name != "guarded"}
    for warmup in ("critic_warmup", "lr_warmup"):
        having = {name for name, own in options.items() if warmup in own}
        assert having == {name for name in options if {None, 0} <= set(spaces.space_of(name).get(warmup, ()))}
        assert "sac" in having


def test_all_methods_with_a_space_are_tuned_by_default():
    assert set(tune.TuneArgs().methods) == set(spaces.SPACES)


# ------------------------------------------------------------ drawing and scoring


def test_a_draw_begins_with_the_first_settings_and_repeats_nothing():
    space, first = {"a": (1, 2, 3), "b": (None, 5)}, [{"a": 2, "b": None, "c": 0}, {"a": 2, "b": None, "c": 1}]
    seven = tune.draw(space, first, 9, key=(0, 1))
    assert seven[:2] == first and sorted(map(str, seven[2:])) == sorted(
        str({"a": a, "b": b, "c": 0}) for a in (1, 2, 3) for b in (None, 5) if (a, b) != (2, None)
    )
    assert tune.draw(space, first, 3, key=(0, 1)) == seven[:3] and tune.draw(space, first, 1, key=(0, 1)) == first[:1]
    assert any(tune.draw(space, first, 9, key=(k, 1)) != seven for k in range(3))


def test_tasks_methods_and_seeds_have_draws_of_their_own(tmp_path):
    def drawn(method, **changes):
        return [trial.settings for trial in tune.trials(budget(tmp_path, **changes), "toy", method)]

    assert drawn("sac") == drawn("sac", rollouts=20, seeds=5, trials=4) == drawn("sac", trials=9)[:4]
    assert drawn("sac-reset") != drawn("sac-reset", seed=7) and drawn("sac")[3:] != drawn("sac", seed=7)[3:]
    assert drawn("rlpd")[0] == {
        "utd": 20.0,
        "lr_actor": 3e-4,
        "lr_critic": 1e-3,
        "target_critics": 1,
        "simulated_share": 0.5,
        "critic_warmup": 0,
    }


def test_a_score_is_the_area_up_to_the_budget(tmp_path):
    """Rollouts 0, 5, 10, 20: 0, 1, 1 of one seed has (5/2 + 5) / 10 = 0.75, 0, 0, 0.4 of the other 0.2 5 / 10 = 0.1."""
    (_, trial) = tune.trials(budget(tmp_path, trials=2), "toy", "sac")
    assert tune.score(trial, 10) is None
    leave(trial.cells[0].args, [[0, 0], [1, 0], [1, 0.4], [0, 0]], rollouts=(0, 5, 10, 20))
    (_, trial) = tune.trials(budget(tmp_path, trials=2), "toy", "sac")
    found = tune.score(trial, 10)
    assert found.areas == {"mild": pytest.approx([0.75, 0.1])}
    assert found.area == pytest.approx(0.425) and found.final == pytest.approx(0.7)


def test_ties_go_to_the_higher_end_then_to_the_earlier_trial():
    scores = [tune.Score(area, final, {}) for area, final in ((0.5, 0.6), (0.5, 0.8), (0.5, 0.8), (0.4, 1.0))]
    assert tune.best(scores) == 1 and tune.best(scores[::3]) == 0


# ------------------------------------------------------------ the command


def test_every_trial_is_a_run_apart_from_the_comparison(tmp_path, ran):
    tune.tune(budget(tmp_path, trials=3, reals=("mild", "soft")))
    first, second, _ = ran
    assert [run.variant for run in ran] == ["trial-0", "trial-1", "trial-2"]
    assert {(run.seed, run.seeds, run.rollouts, run.real, run.resume) for run in ran} == {
        (100, 2, 10, ("mild", "soft"), False)
    }
    assert first.out == tmp_path / "tune" and first.prior == tmp_path / "pretrain/toy/robust"
    assert first.options == arguments("sac").options
    expected = tune.trials(budget(tmp_path), "toy", "sac")[1].settings
    assert {name: getattr(second.options, name) for name in expected} == expected != spaces.first("sac")[0]
    assert not (tmp_path / "finetune").exists()
    assert written(tmp_path)["budget"]["reals"] == ["mild", "soft"] and len(written(tmp_path)["gaps"]) == 2


def test_what_fails_does_not_stop_the_rest_and_the_command_goes_on(tmp_path, ran, capsys):
    with pytest.raises(UserError, match=r"1 of the trials did not run: toy/mild: sac_trial-3: lacks something"):
        tune.tune(budget(tmp_path))
    assert len(ran) == 4 and not (tmp_path / "tuned").exists()
    assert "toy/sac: 3 of 4 trials are finished; nothing is chosen" in capsys.readouterr().out
    tune.tune(budget(tmp_path))
    assert [run.variant for run in ran[4:]] == ["trial-3"]
    # Areas: (0.05 k 5 + (0.05 k + 0.25) 5) / 10 = 0.05 k + 0.125 of trial k.
    result = written(tmp_path)
    assert (result["trial"], result["options"]) == (3, result["trials"][3]["options"])
    assert [trial["area"] for trial in result["trials"]] == pytest.approx([0.125, 0.175, 0.225, 0.275])
    assert result["budget"] == {
        "trials": 4,
        "reals": ["mild"],
        "seeds": [100, 101],
        "rollouts": 10,
        "eval_every": 5,
        "halve": False,
    }
    assert result["gaps"] == [{"name": "mild"}] and result["provenance"]["versions"]
    assert "--tuned --tasks toy --methods sac" in capsys.readouterr().out
    tune.tune(budget(tmp_path, trials=6))
    assert [run.variant for run in ran[5:]] == ["trial-4", "trial-5"] and written(tmp_path)["trial"] == 5


def test_trials_of_other_options_are_refused(tmp_path, ran):
    (trial,) = tune.trials(budget(tmp_path, trials=1), "toy", "sac")
    leave(with_settings(trial.cells[0].args, {"utd": 3.0}), [[0, 0], [0, 0], [0, 0]])
    with pytest.raises(UserError, match=r"trial-0.*another configuration: options.utd was 3\.0, now 1\.0"):
        tune.tune(budget(tmp_path))
    assert ran == []


def test_dry_and_the_clock_run_nothing(tmp_path, ran, capsys):
    tune.tune(budget(tmp_path, dry=True))
    assert capsys.readouterr().out.count("missing") == 4
    tune.tune(budget(tmp_path, minutes=0.0))
    assert "stopped after 0 minutes" in capsys.readouterr().out and ran == [] and not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--trials", "0"], "--trials is 0: must be at least 1"),
        (["--trials", "245"], "--trials is 245: guarded has only 244 different ones"),
        (["--methods", "sgft-sca"], "did you mean 'sgft-sac'"),
    ],
)
def test_bad_input(argv, words, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.run_main(tune.tune, tune.TuneArgs, "Tune.", argv=[*argv, "--out", str(tmp_path)])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and words in error and error.count("\n") == 1


# ------------------------------------------------------------ successive halving


@pytest.mark.parametrize(
    ("trials", "rollouts", "expected", "total"),
    [
        (8, 40, [(8, 10), (4, 20), (2, 40)], 8 * 10 + 4 * 10 + 2 * 20),
        (5, 12, [(5, 4), (3, 6), (2, 12)], 5 * 4 + 3 * 2 + 2 * 6),  # a quarter of 12 is no evaluation, 4 is
        (2, 40, [(2, 40)], 80),
    ],
)
def test_rungs_of_halving(tmp_path, trials, rollouts, expected, total):
    every = 2 if rollouts == 12 else 5
    args = budget(tmp_path, trials=trials, rollouts=rollouts, eval_every=every, halve=True)
    assert tune.rungs(args) == expected and tune.real_rollouts(tune.rungs(args)) == total
    assert tune.rungs(replace(args, halve=False)) == [(trials, rollouts)]


def test_rungs_that_do_not_grow_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"--halve: 8 trials would end after 5, 5, 10 rollouts, which do not grow"):
        tune.tune(budget(tmp_path, trials=8, halve=True))


def test_the_default_goes_on_with_the_best_of_the_others():
    scores = [tune.Score(area, 0.0, {}) for area in (0.1, 0.4, 0.2, 0.9, 0.4)]
    assert tune.keep(scores, 3) == [0, 1, 3] and tune.keep(scores, 1) == [0]


def made_up(monkeypatch, success):
    """Runs of which only the curve is left, success(trial, rollouts); the list of (trial, rollouts, resume) seen."""
    seen = []

    def run(args):
        number = int(args.variant.removeprefix("trial-"))
        seen.append((number, args.rollouts, args.resume))
        grown = range(0, args.rollouts + 1, 5)
        leave(args, [[success(number, n)] * 2 for n in grown], rollouts=tuple(grown))

    monkeypatch.setattr(grid, "finetune", run)
    return seen


def test_halving_goes_on_with_the_better_half_and_chooses_at_the_end(tmp_path, monkeypatch, capsys):
    """Trials 5 and 6 learn fast, 7 learns more but late. Of 0, 5, 6, 7 the best other one after 20 rollouts is 7."""
    speed = {5: 0.02, 6: 0.015, 7: 0.01}

    def success(trial, n):
        return min(speed.get(trial, 0.0) * n, 0.1) if trial != 7 or n < 15 else 0.9

    seen = made_up(monkeypatch, success)
    tune.tune(budget(tmp_path, trials=8, rollouts=40, halve=True))
    assert seen == [
        *((k, 10, False) for k in range(8)),
        *((k, 20, True) for k in (0, 5, 6, 7)),
        *((k, 40, True) for k in (0, 7)),
    ]
    result = written(tmp_path)
    assert result["trial"] == 7 and result["budget"]["halve"] and len(result["trials"]) == 8
    assert [trial["rollouts"] for trial in result["trials"]] == [40, 10, 10, 10, 10, 20, 20, 40]
    # Of trial 5: 0, 0.1, 0.1 after 0, 5, 10 rollouts and then level, so (0.25 + 1.5) / 20.
    assert result["trials"][5]["area"] == pytest.approx(0.0875)
    assert "seeds: 2, real systems: 1; 320 real rollouts in all" in capsys.readouterr().out
    tune.tune(budget(tmp_path, trials=8, rollouts=40, halve=True))
    assert len(seen) == 14 and written(tmp_path)["trial"] == 7


def test_a_trial_that_stopped_early_is_not_chosen(tmp_path, monkeypatch):
    """After 40 rollouts trial 1 is better than the default and 2 better still; then 2 forgets all: the default wins."""
    seen = made_up(monkeypatch, lambda trial, n: (0.4, 0.5, 0.6 * (n <= 40), 0.0)[trial])
    tune.tune(budget(tmp_path, trials=4, rollouts=80, halve=True))
    assert seen[4:] == [(0, 80, True), (2, 80, True)]
    assert written(tmp_path)["trial"] == 0 and written(tmp_path)["trials"][1]["area"] == pytest.approx(0.5)


def test_halving_waits_for_every_trial_of_a_rung(tmp_path, monkeypatch, capsys):
    seen = made_up(monkeypatch, lambda trial, n: 0.1 * trial)
    tune.tune(budget(tmp_path, trials=4, rollouts=20, halve=True, minutes=0.0))
    tune.tune(budget(tmp_path, trials=4, rollouts=20, halve=True, dry=True))
    assert seen == [] and not (tmp_path / "tuned").exists()
    printed = capsys.readouterr().out
    assert "4 trials to 10 rollouts, 2 trials to 20 rollouts; seeds: 2" in printed
    assert "toy/sac: 0 of 4 trials are finished" in printed


# ------------------------------------------------------------ what uses it


def choose(out, method, **changes):
    """A file as tuning leaves it."""
    facts = {"trials": 8, "reals": ["mild"], "rollouts": 40} | changes
    options = {"utd": 2.0, "lr_actor": 3e-4}
    return tuned.write(out, "toy", method, {"budget": facts, "options": options})


def grid_of(out, **changes):
    given = {"tasks": ("toy",), "methods": ("sac", "sgft-sac"), "tuned": True, "rollouts": 10, "out": out}
    return compare.CompareArgs(**{**given, **changes})


def test_a_comparison_of_tuned_methods(tmp_path, ran):
    for method in ("sac", "sgft-sac"):
        choose(tmp_path, method)
    compare.compare(grid_of(tmp_path))
    assert {(run.options.utd, run.options.lr_actor) for run in ran} == {(2.0, 3e-4)}
    assert (tmp_path / "finetune/toy/default/sac_tuned/seeds-0-9").is_dir()
    assert [str(cell) for cell in compare.cells(grid_of(tmp_path))] == [
        "toy/default: sac_tuned",
        "toy/default: sgft-sac_tuned",
    ]
    tuned.write(
        tmp_path, "toy", "sac", {"budget": tuned.read(tmp_path, "toy", "sac")["budget"], "options": {"utd": 20}}
    )
    with pytest.raises(UserError, match=r"sac_tuned.*options.utd was 2\.0, now 20"):  # tuned again since
        compare.compare(grid_of(tmp_path))


def test_a_tuned_comparison_must_be_fair(tmp_path, ran):
    command = r"python -m experiments.studies.tune --tasks toy --methods"
    with pytest.raises(UserError, match=rf"tuned/toy holds no options for sac, sgft-sac; .*{command} sac sgft-sac$"):
        compare.compare(grid_of(tmp_path))
    choose(tmp_path, "sac")
    choose(tmp_path, "sgft-sac", trials=16)
    with pytest.raises(UserError, match=rf"sac and sgft-sac had different budgets \(trials 8 and 16\); .*{command}"):
        compare.compare(grid_of(tmp_path))
    with pytest.raises(UserError, match=r"--reals mild: the options were tuned there"):
        compare.compare(grid_of(tmp_path, methods=("sac",), reals=("default", "mild")))
    path = tuned.write(tmp_path, "toy", "sac", {"budget": {}, "options": {"speed": 1}})
    with pytest.raises(UserError, match=rf"{path}: there is no option 'speed'; .*{command} sac"):
        tuned.read(tmp_path, "toy", "sac")
    path.write_text("[]")
    with pytest.raises(UserError, match=r"sac\.json: is no JSON object; tune again with: "):
        tuned.read(tmp_path, "toy", "sac")
    assert ran == []


def test_finetune_begins_with_tuned_options_and_takes_changes(tmp_path, monkeypatch, capsys):
    seen = []
    monkeypatch.setattr(finetune, "finetune", seen.append)
    choose(tmp_path, "sac")
    words = ["--task", "toy", "--method", "sac", "--out", str(tmp_path), "--tuned"]
    finetune.main([*words, "--options.utd", "4"])
    (run,) = seen
    assert (run.variant, run.options.utd, run.options.lr_actor, run.task) == ("tuned", 4.0, 3e-4, "toy")
    with pytest.raises(SystemExit) as stopped:
        finetune.main([*words, "--method", "rlpd"])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and error.count("\n") == 1 and "--tasks toy --methods rlpd" in error


@pytest.mark.slow
def test_tuned_runs_on_a_point_mass(tmp_path, monkeypatch):
    """Three real trials, two of which go on, then a run with what they chose: from a prior to the file and back."""
    for run, seed in (("a", 0), ("b", 1)):
        save_prior(tmp_path / f"pretrain/toy/robust/{run}/prior/seed-{seed}", seed)
    for name, mass in (("heavy", 2.0), ("light", 0.5)):
        (tmp_path / f"{name}.toml").write_text(f"[params]\nmass = {mass}\n")
    monkeypatch.setitem(spaces.SPACES, "sac", {"utd": (0.1, 1.0, 8.0), "batch_size": (256,)})
    monkeypatch.setitem(spaces.FIRST, "sac", ({"utd": 8.0},))
    sizes = {"tasks": ("toy",), "methods": ("sac",), "rollouts": 2, "eval_every": 1, "seeds": 2}
    tune.tune(tune.TuneArgs(trials=3, halve=True, reals=(str(tmp_path / "heavy.toml"),), out=tmp_path, **sizes))
    result = written(tmp_path)
    assert {trial["options"]["utd"] for trial in result["trials"]} == {8.0, 1.0, 0.1}
    assert sorted(trial["rollouts"] for trial in result["trials"]) == [1, 2, 2]
    assert [checkpoint.latest(Path(trial["folders"][0])) for trial in result["trials"]] == [
        trial["rollouts"] for trial in result["trials"]
    ]
    assert result["gaps"][0]["name"] == "heavy"
    assert all(np.shape(trial["areas"]["heavy"]) == (2,) for trial in result["trials"])
    real = str(tmp_path / "light.toml")
    compare.compare(compare.CompareArgs(tuned=True, reals=(real,), out=tmp_path, **sizes))
    (cell,) = compare.cells(compare.CompareArgs(tuned=True, reals=(real,), out=tmp_path, **sizes))
    assert cell.state == "finished" and checkpoint.latest(cell.folder) == 2
    stored = json.loads((cell.folder / "config.json").read_text())["config"]["options"]
    assert stored["utd"] == result["options"]["utd"]
    assert "| sac tuned | 2 |" in (tmp_path / "figures/tables.md").read_text()
