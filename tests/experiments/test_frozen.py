"""The frozen test: what runs, in which order, as which processes. Nothing is trained here."""

import json
from pathlib import Path

import pytest

from envs import gaps
from envs.types import UserError
from experiments.runner import cli, grid
from experiments.studies import frozen
from sgft_jax.methods import NAMES


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(frozen, "_PAUSE", 0.0)
    monkeypatch.setattr(cli, "set_up", lambda: None)


@pytest.fixture
def ran(monkeypatch):
    """Fine-tuning runs that only leave their folders."""
    seen = []

    def finetune(args):
        seen.append(args)
        for real in args.real:
            folder = grid.run_folder(args, real)
            folder.mkdir(parents=True, exist_ok=True)
            (folder / "config.json").write_text("{}")
            (folder / "summary.json").write_text(json.dumps({"final": {"rollouts": args.rollouts}}))

    monkeypatch.setattr(grid, "finetune", finetune)
    return seen


def every(**changes):
    return {unit.name: unit for unit in frozen.units(frozen.FrozenArgs(**changes))}


def have_priors(folder, seeds):
    for seed in seeds:
        (folder / f"prior/seed-{seed}").mkdir(parents=True)
        (folder / f"prior/seed-{seed}/prior.json").touch()


def played(tmp_path, ran, name, **changes):
    """The arguments of the one run of a unit."""
    unit = every(out=tmp_path, **changes)[name]
    assert unit.state() == "missing"
    for prior in every(out=tmp_path, **changes).values():
        if prior.name in unit.needs:
            own = prior.work.args[0]
            have_priors(frozen.run_folder(own), range(own.seed, own.seed + own.seeds))
    unit.work()
    assert unit.state() == "finished"
    (args,) = ran
    return args


# ------------------------------------------------------------ what there is to do


def test_every_method_runs_on_every_task_after_its_priors():
    names = list(every())
    for task in frozen.TASKS:
        assert {f"{task}/{method}" for method in NAMES if method not in frozen.LEFT_OUT} <= set(names)
    for name, unit in every().items():
        assert all(names.index(need) < names.index(name) for need in unit.needs)
        assert bool(unit.needs) != ("/prior-" in name)
    assert every()["hammer/tdmpc2"].needs == ("hammer/prior-robust-tdmpc2",)
    assert every()["push/sysid"].needs == ("push/prior-informed",)
    assert every()["push-ball/mbpo"].needs == ("push-ball/prior-robust",)


def test_the_main_methods_run_on_all_test_gaps_and_without_one(tmp_path, ran):
    args = played(tmp_path, ran, "insert/mbpo")
    file = frozen._test_file("insert")
    assert args.real == ("sim", *(f"{file}:{name}" for name in gaps.read_file(file)))
    assert (args.seeds, args.seed, args.rollouts, args.eval_every, args.variant) == (12, 0, 20, 2, "")
    assert args.prior == tmp_path / "pretrain/insert/robust/seeds-0-11"


def test_methods_with_priors_of_their_own_have_fewer(tmp_path, ran):
    args = played(tmp_path, ran, "push/recurrent", fewer=2)
    assert len(args.real) == 9 and args.seeds == 2
    assert args.prior == tmp_path / "pretrain/push/recurrent/seeds-0-1"


def test_the_default_method_runs_again_with_the_same_priors_and_other_seeds(tmp_path, ran):
    args = played(tmp_path, ran, "push/guarded-again")
    assert (args.method, args.variant, args.seed, args.seeds) == ("guarded", "again", 12, 12)
    assert args.prior == tmp_path / "pretrain/push/robust/seeds-0-11"  # seed 12 starts from prior 0 again


def test_the_others_run_on_the_first_partial_and_the_first_failed_gap(tmp_path, ran):
    args = played(tmp_path, ran, "hammer/pbrs")
    strata = {gap.name: gap.stratum for gap in gaps.read_file(frozen._test_file("hammer")).values()}
    chosen = [real.rpartition(":")[2] for real in args.real]
    assert [strata[name] for name in chosen] == ["partial", "failed"] and args.seeds == 6
    assert chosen == [next(n for n in strata if strata[n] == stratum) for stratum in ("partial", "failed")]


def test_a_run_that_lacks_a_gap_is_unfinished(tmp_path, ran):
    args = played(tmp_path, ran, "push/sac")
    (grid.run_folder(args, args.real[3]) / "summary.json").unlink()
    unit = every(out=tmp_path)["push/sac"]
    assert unit.state() == "unfinished"
    unit.work()
    assert [run.real for run in ran[1:]] == [(args.real[3],)] and ran[1].resume


def test_priors_go_on_where_they_stopped(tmp_path, monkeypatch):
    seen = []
    monkeypatch.setattr(frozen, "pretrain", seen.append)
    unit = every(out=tmp_path)["push/prior-robust"]
    unit.work()
    folder = tmp_path / "pretrain/push/robust/seeds-0-11"
    folder.mkdir(parents=True)
    (folder / "config.json").touch()
    assert unit.state() == "unfinished"
    unit.work()
    (folder / "summary.json").touch()
    assert unit.state() == "finished"
    assert [(args.preset, args.seeds, args.resume) for args in seen] == [("robust", 12, False), ("robust", 12, True)]


def test_processes_share_the_seeds_of_priors_and_the_systems_of_a_run(tmp_path, ran):
    found = every(out=tmp_path, split=2)
    parts = [found[f"hammer/prior-robust-tdmpc2.{i}"].work.args[0] for i in (1, 2)]
    assert [(own.seed, own.seeds) for own in parts] == [(0, 3), (3, 3)]
    assert found["hammer/tdmpc2.2"].needs == ("hammer/prior-robust-tdmpc2.1", "hammer/prior-robust-tdmpc2.2")
    first = played(tmp_path, ran, "hammer/tdmpc2.1", split=2)
    found["hammer/tdmpc2.2"].work()
    whole = ("sim", *(f"{frozen._test_file('hammer')}:{name}" for name in gaps.read_file(frozen._test_file("hammer"))))
    assert sorted(real for args in ran for real in args.real) == sorted(whole) and len(ran) == 2
    assert {args.seeds for args in ran} == {6} and first.prior == tmp_path / "pretrain/hammer/robust-tdmpc2"
    assert frozen._finished(found, "hammer/tdmpc2") and not frozen._finished(found, "hammer/sgft-tdmpc2")
    assert not any(unit.name.startswith("push-ball/mbpo.") for unit in found.values())  # one system


def test_no_process_is_without_a_seed(tmp_path):
    names = [name for name in every(out=tmp_path, split=4, fewer=3) if "push/prior-informed" in name]
    assert names == [f"push/prior-informed.{i}" for i in (1, 2, 3)]


def test_priors_that_one_process_has_begun_stay_together(tmp_path):
    folder = tmp_path / "pretrain/push/robust/seeds-0-11"
    folder.mkdir(parents=True)
    (folder / "config.json").touch()
    found = every(out=tmp_path, split=2)
    assert found["push/prior-robust"].state() == "unfinished" and "push/prior-robust.1" not in found
    assert found["push/sac.1"].needs == ("push/prior-robust",)


def test_priors_of_other_runs_are_not_mixed_in(tmp_path, ran):
    have_priors(tmp_path / "pretrain/insert/robust-tdmpc2/seed-0", [0])
    with pytest.raises(UserError, match=r"robust-tdmpc2: holds 7 priors, not 6; move those of other runs away"):
        played(tmp_path, ran, "insert/tdmpc2.1", split=2)
    assert ran == []


def test_a_part_comes_with_the_priors_that_it_needs():
    assert [unit.name for unit in frozen.select(every(), ("hammer/sysid", "hammer/sac-r"))] == [
        "hammer/prior-robust",
        "hammer/prior-informed",
        "hammer/sysid",
        "hammer/sac-reset",
    ]
    found = every()
    assert frozen.select(found, ()) == frozen.select(found, ("push", "insert", "hammer")) == list(found.values())
    with pytest.raises(UserError, match=r"--only slide: no unit begins like this"):
        frozen.select(every(), ("slide",))


# ------------------------------------------------------------ doing it


class Process:
    """Ends at the n-th look."""

    def __init__(self, looks, code):
        self.looks, self.code, self.returncode, self.terminated = looks, code, None, False

    def poll(self):
        self.looks -= 1
        self.returncode = self.code if self.looks <= 0 else None
        return self.returncode

    def terminate(self):
        self.terminated = True


def pool(tmp_path, monkeypatch, units, *, fails=(), **changes):
    """A pool of units {name: needs} whose processes last three looks; and its starts: (name, GPU, beside how many)."""
    begun = []

    def process(self, unit, gpu):
        begun.append((unit.name, gpu, len(self.running)))
        return Process(3, int(unit.name in fails))

    monkeypatch.setattr(frozen.Pool, "_process", process)
    waiting = [frozen.Unit(name, needs, lambda: "missing", lambda: None) for name, needs in units.items()]
    return frozen.Pool(frozen.FrozenArgs(out=tmp_path, **changes), waiting), begun


def test_units_wait_for_what_they_need_and_share_the_gpus(tmp_path, monkeypatch, capsys):
    units = {"p": (), "q": (), "a": ("p",), "b": ("q",), "c": ("p",)}
    own, begun = pool(tmp_path, monkeypatch, units, jobs=1, gpus=2)
    assert own.work() == []
    assert begun == [("p", 0, 0), ("q", 1, 1), ("a", 0, 0), ("b", 1, 1), ("c", 0, 0)]
    assert capsys.readouterr().out.count("done") == 5


def test_what_needs_a_failed_unit_is_not_tried(tmp_path, monkeypatch):
    own, begun = pool(tmp_path, monkeypatch, {"p": (), "q": (), "a": ("p",), "b": ("q",)}, fails=("p",), jobs=4)
    assert own.work() == ["p", "a"]
    assert [name for name, *_ in begun] == ["p", "q", "b"]


def test_when_the_time_is_up_nothing_begins(tmp_path, monkeypatch, capsys):
    own, begun = pool(tmp_path, monkeypatch, {"p": ()}, minutes=0.0)
    assert own.work() == [] and begun == []
    assert "no new units after 0 minutes" in capsys.readouterr().out


def test_processes_end_with_the_command(tmp_path, monkeypatch):
    own, _ = pool(tmp_path, monkeypatch, {"p": ()})

    def interrupt(seconds):
        raise KeyboardInterrupt

    monkeypatch.setattr(frozen.time, "sleep", interrupt)
    with pytest.raises(KeyboardInterrupt):
        own.work()
    assert own.running["p"].process.terminated


def test_a_process_does_one_unit_on_its_gpu(tmp_path, monkeypatch):
    """What it is told is understood by the command line itself."""
    seen = {}

    def start(words, **given):
        seen.update(given, words=words)
        return Process(1, 0)

    monkeypatch.setattr(frozen.subprocess, "Popen", start)
    args = frozen.FrozenArgs(out=tmp_path / "a b", gpus=1, priors=3, split=2)
    unit = every(out=args.out, split=2)["push/sac.1"]
    frozen.Pool(args, [unit]).work()
    assert seen["words"][1:3] == ["-m", "experiments.studies.frozen"] and seen["env"]["CUDA_VISIBLE_DEVICES"] == "0"
    told = cli.parse(frozen.FrozenArgs, "", seen["words"][3:])
    assert (told.unit, told.split, told.priors, told.out) == ("push/sac.1", 2, 3, tmp_path / "a b")
    assert Path(seen["stdout"].name) == args.out / "frozen/push-sac.1.log"


def test_the_command_ends_with_the_scoreboard_and_names_what_failed(tmp_path, ran, monkeypatch, capsys):
    def process(self, unit, gpu):
        code = int("mbpo" in unit.name)
        if not code:
            unit.work()
        return Process(1, code)

    monkeypatch.setattr(frozen.Pool, "_process", process)
    monkeypatch.setattr(frozen, "pretrain", lambda args: leave_prior(args))
    monkeypatch.setattr(frozen, "board", lambda args: f"board of {args.reference}, {len(args.gaps)} files")
    words = ["--only", "push/guarded", "push/mbpo", "--out", str(tmp_path)]
    with pytest.raises(SystemExit) as stopped:
        cli.run_main(frozen.main, frozen.FrozenArgs, "", argv=words)
    told = capsys.readouterr()
    assert stopped.value.code == 2 and told.err == f"error: failed, see {tmp_path / 'frozen'}: push/mbpo\n"
    assert "board of guarded, 3 files" in told.out and "missing    push/guarded\n" in told.out
    cli.run_main(frozen.main, frozen.FrozenArgs, "", argv=["--only", "push/guarded", "--dry", "--out", str(tmp_path)])
    assert "finished   push/guarded\n" in capsys.readouterr().out


def test_without_the_method_that_others_are_compared_with_there_is_no_scoreboard(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(frozen.Pool, "work", lambda self: [])
    cli.run_main(frozen.main, frozen.FrozenArgs, "", argv=["--only", "push/sac", "--out", str(tmp_path)])
    assert "Success in per cent" not in capsys.readouterr().out


def leave_prior(args):
    folder = frozen.run_folder(args)
    have_priors(folder, range(args.seed, args.seed + args.seeds))
    (folder / "summary.json").touch()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--jobs", "0"], "--jobs is 0: must be at least 1"),
        (["--gpus", "-1"], "--gpus is -1: must be at least 0"),
        (["--minutes", "-3"], "--minutes is -3.0: must be at least 0"),
        (["--split", "0"], "--split is 0: must be at least 1"),
        (["--unit", "push/sack"], "did you mean 'push/sac'"),
        (["--only", "pull"], "--only pull: no unit begins like this"),
    ],
)
def test_bad_input(words, said, tmp_path, capsys):
    with pytest.raises(SystemExit) as stopped:
        cli.run_main(frozen.main, frozen.FrozenArgs, "", argv=[*words, "--out", str(tmp_path)])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and said in error and error.count("\n") == 1
