"""The grid of runs: what is missing runs, what is finished stays, what cannot run does not stop the rest."""

import json
from dataclasses import replace

import pytest

import envs
from envs.types import UserError
from experiments import compare
from experiments.runner import cli, grid
from experiments.runner.grid import complete
from sgft_jax.io import checkpoint
from sgft_jax.io.runs import Lock

GRID = {"tasks": ("push", "insert"), "methods": ("sgft-sac", "rlpd"), "seeds": 2, "rollouts": 10}


@pytest.fixture
def ran(monkeypatch):
    """Runs that only leave their folder; those of `rlpd` on insert lack something."""
    seen = []

    def finetune(args):
        seen.append(args)
        if (args.task, args.method) == ("insert", "rlpd") or any("lacking" in real for real in args.real):
            raise UserError("holds no prior")
        for real in args.real:
            leave(replace(args, real=(real,)), args.rollouts)

    monkeypatch.setattr(grid, "finetune", finetune)
    monkeypatch.setattr(cli, "set_up", lambda: None)
    return seen


def leave(args, rollouts, *, killed=False):
    folder = grid.run_folder(args, *args.real)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.json").write_text("{}")
    if rollouts:
        checkpoint.save(folder, rollouts, {}, meta={})
    if rollouts and not killed:
        (folder / "summary.json").write_text(json.dumps({"final": {"rollouts": rollouts}}))


def own_gaps(folder, *names):
    """The files of gaps of one's own."""
    for name in names:
        (folder / f"{name}.toml").touch()
    return tuple(str(folder / f"{name}.toml") for name in names)


def names(runs):
    return [(run.task, run.method, run.resume) for run in runs]


def test_by_default_all_tasks_with_a_default_real_system():
    args = compare.CompareArgs()
    assert {"push", "insert"} < set(args.tasks) and "halfcheetah" not in args.tasks
    grid.check(args)


def completed(args):
    """A line for each cell that could not run."""
    return complete(compare.cells(args), args)


def test_what_is_missing_runs_and_what_is_finished_stays(tmp_path, ran, capsys):
    args = compare.CompareArgs(out=tmp_path, **GRID)
    first, second = (cell.args for cell in compare.cells(args)[:2])
    leave(first, 10)
    leave(second, 0)  # killed before its end
    failed = completed(args)
    assert names(ran) == [("push", "rlpd", True), ("insert", "sgft-sac", False), ("insert", "rlpd", False)]
    assert failed == ["insert/default: rlpd: holds no prior"]
    assert "finished   push/default: sgft-sac, step 10\nunfinished push/default: rlpd\n" in capsys.readouterr().out
    ran.clear()
    completed(compare.CompareArgs(out=tmp_path, **{**GRID, "rollouts": 20}))
    assert names(ran)[0] == ("push", "sgft-sac", True)  # more rollouts were asked for


def test_real_systems_that_got_equally_far_go_on_together(tmp_path, ran, capsys):
    """Of five, one is finished, two were killed after 6 rollouts, one after 8, one has not begun."""
    soft, new = own_gaps(tmp_path, "soft", "new")
    reals = ("mild", "default", "hard", soft, new)
    grid = {**GRID, "tasks": ("push",), "methods": ("sac",), "reals": reals, "out": tmp_path}
    for cell, done in zip(compare.cells(compare.CompareArgs(**grid)), (10, 6, 8, 6), strict=False):
        leave(cell.args, done, killed=done < 10)
    completed(compare.CompareArgs(**grid))
    assert [(run.real, run.resume) for run in ran] == [
        (("default", soft), True),
        (("hard",), True),
        ((new,), False),
    ]
    printed = capsys.readouterr().out.splitlines()
    assert printed[:2] == ["finished   push/mild: sac, step 10", "unfinished push/default: sac, step 6"]
    assert printed[5] == "--- push/default: sac, push/soft: sac"
    ran.clear()
    completed(compare.CompareArgs(**{**grid, "rollouts": 20, "together": False}))
    assert [run.real for run in ran] == [(real,) for real in reals]


def test_what_one_real_system_lacks_does_not_stop_the_others(tmp_path, ran):
    (lacking,) = own_gaps(tmp_path, "lacking")
    args = compare.CompareArgs(tasks=("push",), methods=("sac",), reals=("mild", lacking, "hard"), out=tmp_path)
    assert completed(args) == ["push/lacking: sac: holds no prior"]
    assert [run.real for run in ran] == [args.reals, ("mild",), (lacking,), ("hard",)]
    assert [cell.state for cell in compare.cells(args)] == ["finished", "missing", "finished"]


def test_a_file_without_a_name_means_all_of_its_gaps(tmp_path):
    file = tmp_path / "two.toml"
    file.write_text("[a.params]\nobject_mass = 9.0\n[b.params]\nobject_mass = 2.0\n")
    args = compare.CompareArgs(tasks=("push",), methods=("sac",), reals=("sim", str(file)), out=tmp_path)
    assert [str(cell) for cell in compare.cells(args)] == ["push/sim: sac", "push/a: sac", "push/b: sac"]


def test_several_processes_share_a_grid(tmp_path, ran, capsys, monkeypatch):
    """Of four cells one is another's from the start, one is opened in this moment, one is finished meanwhile."""
    args = compare.CompareArgs(out=tmp_path, **{**GRID, "methods": ("sgft-sac", "sac")})
    busy, opened, mine, done = compare.cells(args)
    leave(busy.args, 4, killed=True)
    held = [Lock(busy.folder)]
    run = grid.finetune

    def finetune(args):
        if args == opened.args:
            opened.folder.mkdir(parents=True)
            held.append(Lock(opened.folder))
            Lock(opened.folder)
        run(args)
        leave(done.args, 10)

    monkeypatch.setattr(grid, "finetune", finetune)
    assert completed(args) == []
    assert names(ran) == [("insert", "sgft-sac", False)] and ran == [mine.args]
    printed = capsys.readouterr().out
    assert all(f"left to another process: {cell}\n" in printed for cell in (busy, opened)) and "error" not in printed
    held.clear()
    monkeypatch.setattr(grid, "finetune", run)
    completed(args)
    assert names(ran)[1:] == [("push", "sgft-sac", True), ("push", "sac", False)]


def test_every_method_runs_with_its_own_settings(tmp_path, ran):
    completed(compare.CompareArgs(out=tmp_path, **GRID))
    sgft, rlpd = ran[:2]
    assert (sgft.options.utd, rlpd.options.utd) == (8, 20) and rlpd.options.critics == 10
    assert {run.rollouts for run in ran} == {10} and not any(run.video for run in ran)


def test_the_clock_stops_before_a_cell_not_in_it(tmp_path, ran, capsys):
    assert completed(compare.CompareArgs(out=tmp_path, minutes=0.0, **GRID)) == []
    assert ran == [] and "stopped after 0 minutes" in capsys.readouterr().out


def test_dry_lists_and_runs_nothing(tmp_path, ran, capsys):
    compare.compare(compare.CompareArgs(out=tmp_path, dry=True, **GRID))
    assert ran == [] and capsys.readouterr().out.count("missing") == 4


@pytest.mark.parametrize(
    ("argv", "words"),
    [
        (["--methods", "sgft-sca"], "did you mean 'sgft-sac'"),
        (["--tasks", "pull"], "task: there is no 'pull'"),
        (["--seeds", "0"], "--seeds is 0: must be at least 1"),
        (["--reals"], "--reals: name at least one"),
    ],
)
def test_bad_input(argv, words, tmp_path, ran, capsys):
    with pytest.raises(SystemExit) as stopped:
        compare.main([*argv, "--out", str(tmp_path)])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and error.startswith("error: ") and error.count("\n") == 1 and words in error
    assert envs.TASKS and ran == []
