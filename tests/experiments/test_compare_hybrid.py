"""The grid of methods, data sets and simulators: what runs together, what is left alone, what the tables say."""

import gzip
import json
from dataclasses import replace
from pathlib import Path

import pytest

from envs.types import UserError
from experiments import compare
from experiments.hybrid import run_folder
from experiments.runner import cli
from sgft_jax.analysis import figures
from sgft_jax.files.disk import jsonable
from sgft_jax.io.runs import FORMAT

METHODS = ("h2oplus", "sac", "iql", "rebrac:walker2d-medium")


@pytest.fixture
def ran(monkeypatch):
    """Runs that only leave their folders."""
    seen = []

    def hybrid(args):
        seen.append(args)
        for i, gap in enumerate(args.gap):
            leave(replace(args, gap=(gap,)), [100.0 * i + 10 * seed for seed in range(args.seeds)])

    monkeypatch.setattr(compare.hybrid, "hybrid", hybrid)
    monkeypatch.setattr(cli, "set_up", lambda: None)
    return seen


@pytest.fixture
def undrawn(monkeypatch):
    """Pictures of curves are empty files."""

    def draw(path, panels, *, title):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()

    monkeypatch.setattr(figures, "learning_curves", draw)


def leave(args, scores):
    """What a run leaves; without scores, one that was killed."""
    folder = compare.HYBRID_RUNS.folder(args)
    folder.mkdir(parents=True, exist_ok=True)
    config = {"config": dict(compare.HYBRID_RUNS.config(args)), "kind": "hybrid", "sgft_jax": "0", "format": FORMAT}
    (folder / "config.json").write_text(json.dumps(jsonable(config)))
    if scores:
        summary = {"task": "halfcheetah", "score": "return", "seeds": [*range(args.seeds)], "late": scores}
        summary["last"] = [-x for x in scores]
        (folder / "summary.json").write_text(json.dumps(summary))
        lines = [{"step": step, "score": [k * x for x in scores]} for step, k in ((0, 3), (1000, -1))]
        (folder / "eval.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))


@pytest.fixture
def grid(tmp_path):
    """Two data sets and two simulators."""
    data = tuple(tmp_path / f"{name}.hdf5" for name in ("medium", "replay"))
    for path in data:
        path.touch()
    return compare.HybridGridArgs(
        methods=METHODS, gaps=("gravity", "friction"), data=data, seeds=3, out=tmp_path / "runs"
    )


@pytest.mark.heavy
def test_each_method_runs_as_often_as_it_learns_from_other_things(grid, ran, capsys):
    compare.compare_hybrid(grid)
    found = [(run.method, None if run.data is None else run.data.stem, run.gap) for run in ran]
    assert found == [
        ("h2oplus", "medium", ("gravity", "friction")),
        ("sac", None, ("gravity", "friction")),
        ("iql", "medium", ("sim",)),
        ("rebrac", "medium", ("sim",)),
        ("h2oplus", "replay", ("gravity", "friction")),
        ("iql", "replay", ("sim",)),
        ("rebrac", "replay", ("sim",)),
    ]
    assert ran[3].variant == "walker2d-medium" and ran[3].options.critic_penalty == 0.1
    said = capsys.readouterr().out
    assert "missing    halfcheetah/gravity/medium: h2oplus\n" in said and "halfcheetah/gravity: sac\n" in said
    assert "halfcheetah/medium: rebrac:walker2d-medium\n" in said
    assert "| replay | friction | 110 ± 8 | 110 ± 8 | 10 ± 8 | 10 ± 8 |" in said
    (table,) = (grid.out / "figures").glob("hybrid-halfcheetah-sim-late.md")
    assert table.read_text() in said
    figures = {path.name for path in (grid.out / "figures").glob("*.png")}
    assert figures == {"hybrid-halfcheetah-sim-medium.png", "hybrid-halfcheetah-sim-replay.png"}
    assert "written: " + str(grid.out / "figures/hybrid-halfcheetah-sim-replay.png") in said
    # of 60 (mean over simulators) on D4RL's scale, -280 to 12,135: 2.7
    assert "| medium | 2.7 [2.7, 2.8] |" in said
    ran.clear()
    compare.compare_hybrid(replace(grid, score="last"))
    assert ran == [] and "| replay | friction | -110 ± 8 |" in capsys.readouterr().out


@pytest.mark.usefixtures("undrawn")
def test_what_was_killed_goes_on_and_what_is_missing_follows(grid, ran):
    first = compare.hybrid_cells(replace(grid, gaps=("gravity",)))[0]
    leave(first.args, None)
    compare.compare_hybrid(replace(grid, methods=("h2oplus",), data=grid.data[:1]))
    assert [(run.gap, run.resume) for run in ran] == [(("gravity",), True), (("friction",), False)]


@pytest.mark.usefixtures("undrawn")
def test_runs_with_other_settings_are_not_mixed(grid, ran, capsys):
    own = replace(grid, methods=("iql",), reference="iql")
    compare.compare_hybrid(own)
    with pytest.raises(UserError, match=r"schedule\.updates was 1000000, now 500"):
        compare.compare_hybrid(replace(own, schedule=replace(own.schedule, updates=500)))


@pytest.mark.usefixtures("undrawn")
def test_rebrac_takes_the_preset_of_each_data_set(grid, ran, tmp_path, capsys):
    names = ("halfcheetah-medium-replay-regenerated-seed-0", "halfcheetah_medium-v2", "mine")
    data = tuple(tmp_path / f"{name}.hdf5" for name in names)
    for path in data:
        path.touch()
    compare.compare_hybrid(replace(grid, methods=("rebrac",), reference="rebrac", data=data))
    presets = ["halfcheetah-medium-replay", "halfcheetah-medium", ""]
    assert [(run.preset, run.variant) for run in ran] == [(preset, "") for preset in presets]
    assert [run.options.critic_penalty for run in ran] == [0.001, 0.01, 0.001]
    said = capsys.readouterr().out
    assert f"missing    halfcheetah/{names[0]}: rebrac, preset halfcheetah-medium-replay\n" in said
    assert f"missing    halfcheetah/{names[1]}: rebrac, preset halfcheetah-medium\n" in said
    assert "halfcheetah/mine: rebrac, preset halfcheetah-medium-replay, as none is called after mine\n" in said
    assert "| data | simulator | rebrac |\n" in said


def test_tables_and_curves_name_the_schedule_and_the_updates(grid, ran, monkeypatch, capsys):
    titles = []
    monkeypatch.setattr(figures, "learning_curves", lambda path, panels, *, title: titles.append(title))
    chosen = compare.hybrid_defaults(["--schedule-preset", "released"])
    schedule = replace(chosen.schedule, updates=200_000)
    own = replace(grid, methods=("sac",), reference="sac", data=())
    own = replace(own, schedule_preset=chosen.schedule_preset, schedule=schedule)
    compare.compare_hybrid(own)
    assert (ran[0].schedule_preset, ran[0].schedule) == ("released", schedule)
    legend = "Every run made 200,000 updates, schedule released (simulators: 1; steps of each per round: 1,000; "
    assert legend in capsys.readouterr().out
    compare.compare_hybrid(replace(own, schedule_preset="fleet"))  # the same numbers, typed by hand: the same runs
    assert len(ran) == 1 and legend in capsys.readouterr().out
    assert titles == ["halfcheetah, schedule released"] * 2


@pytest.mark.usefixtures("undrawn")
def test_presets_of_one_method_are_rows_of_their_own(grid, ran, capsys):
    methods = ("h2oplus", "h2oplus:lambda-0.2", "h2oplus:no-ratio", "h2oplus:xql")
    compare.compare_hybrid(replace(grid, methods=methods, gaps=("gravity",), data=grid.data[:1]))
    assert [run.options.value_share for run in ran] == [0.1, 0.2, 0.1, 0.1]
    assert [run.options.ratio for run in ran] == [True, True, False, True] and ran[3].options.value_cut == 7.0
    assert f"| data | simulator | {' | '.join(methods)} |\n" in capsys.readouterr().out


def test_dry_runs_nothing(grid, ran, capsys):
    compare.compare_hybrid(replace(grid, dry=True))
    assert ran == [] and capsys.readouterr().out.count("missing") == 10 and not grid.out.exists()


@pytest.mark.parametrize(("task", "count"), [("halfcheetah", 9), ("walker2d", 7)])
def test_by_default_the_simulators_of_the_papers_tables(task, count, grid, ran, capsys):
    compare.compare_hybrid(replace(grid, task=task, gaps=(), methods=("sac",), reference="sac", data=(), dry=True))
    said = capsys.readouterr().out
    assert said.count("missing") == count and "range-only" not in said


def test_variants_of_gaps_run_where_they_are_named(grid, ran, capsys):
    own = replace(grid, task="walker2d", gaps=("broken-thigh-range-only",), methods=("sac",), reference="sac", data=())
    compare.compare_hybrid(replace(own, dry=True))
    assert "missing    walker2d/broken-thigh-range-only: sac\n" in capsys.readouterr().out


def test_cells_have_their_folders(grid):
    folder = run_folder(compare.hybrid_cells(replace(grid, methods=("sac",), data=()))[0].args, "gravity")
    assert folder.relative_to(grid.out) == Path("hybrid/halfcheetah/gravity/no-data/sac/seeds-0-2")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ("--methods iql:papre --reference iql:papre --data SET", "--preset: there is no 'papre'"),
        ("--methods sac iql --reference sac", "--data: iql learns from real data"),
        ("--minutes -3 --methods sac --reference sac", "--minutes is -3.0: must be at least 0"),
        ("--methods foo", "--methods: there is no 'foo'"),
        ("--methods sac foo:a --reference sac", "--methods: there is no 'foo:a'"),
        ("--methods sac", "--reference: there is no 'h2oplus'"),
        ("--data nowhere.hdf5", "--data nowhere.hdf5: no such file"),
        ("--gaps gravitiy --methods sac --reference sac", "gravitiy"),
        ("--seeds 0", "--seeds is 0: must be at least 1"),
        ("--schedule-preset flet", "--schedule-preset: there is no 'flet', did you mean 'fleet'"),
    ],
)
def test_bad_input(words, said, tmp_path, ran, capsys):
    (tmp_path / "set.hdf5").touch()
    with pytest.raises(SystemExit) as stopped:
        compare.main(["hybrid", *words.replace("SET", f"{tmp_path}/set.hdf5").split(), "--out", str(tmp_path / "runs")])
    error = capsys.readouterr().err
    assert stopped.value.code == 2 and error.count("\n") == 1 and said in error
    assert ran == []


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize("name", ["last", "late"])
def test_a_damaged_summary_is_named(name, grid, ran):
    compare.compare_hybrid(grid)
    path = next(grid.out.rglob("summary.json"))
    path.write_text(json.dumps(json.loads(path.read_text()) | {name: "high"}))
    with pytest.raises(UserError, match=rf"summary\.json: .*{name}.*; put back the file that the run has written"):
        compare.compare_hybrid(grid)


# --- released tables --------------------------------------------------------------------------------------------------


@pytest.mark.usefixtures("undrawn")
def test_a_released_table_says_what_the_runs_say(grid, ran, tmp_path, capsys):
    compare.compare_hybrid(grid)
    ran.clear()
    compare.compare_hybrid(replace(grid, export=tmp_path / "tables"))
    assert f"written: {tmp_path / 'tables/hybrid.csv.gz'}, 10 runs\n" in capsys.readouterr().out
    once = (tmp_path / "tables/hybrid.csv.gz").read_bytes()
    compare.compare_hybrid(replace(grid, export=tmp_path / "tables"))
    assert (tmp_path / "tables/hybrid.csv.gz").read_bytes() == once  # rows of the same runs are replaced
    for path in grid.data:
        path.unlink()  # the data are not needed
    capsys.readouterr()
    compare.compare_hybrid(replace(grid, released=tmp_path / "tables", out=tmp_path / "other"))
    said = capsys.readouterr().out
    assert ran == [] and "| replay | friction | 110 ± 8 | 110 ± 8 | 10 ± 8 | 10 ± 8 |" in said
    assert (tmp_path / "other/figures/hybrid-halfcheetah-sim-replay.png").exists()
    compare.compare_hybrid(replace(grid, released=tmp_path / "tables", seeds=2))
    assert "| replay | friction | 105 ± 5 | 105 ± 5 | 5 ± 5 | 5 ± 5 |" in capsys.readouterr().out


@pytest.mark.usefixtures("undrawn")
def test_the_last_and_the_mean_of_ten_evaluations_come_from_the_curve(grid, ran, tmp_path, capsys):
    own = replace(grid, methods=("sac",), reference="sac", data=(), gaps=("gravity",))
    compare.compare_hybrid(own)
    (folder,) = (cell.folder for cell in compare.hybrid_cells(own))
    lines = [{"step": 10 * i, "score": [float(i)] * 3} for i in range(21)]
    (folder / "eval.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    compare.compare_hybrid(replace(own, export=tmp_path))
    for score, mean in (("last", "20"), ("late", "16")):  # 11 to 20: 15.5, to the even number
        compare.compare_hybrid(replace(own, released=tmp_path, score=score))
        assert f"| - | gravity | {mean} ± 0 |" in capsys.readouterr().out


@pytest.fixture
def standing(grid, ran, undrawn):
    """A run that also says how long three robots stood, at two evaluations."""
    own = replace(grid, methods=("sac",), reference="sac", data=(), gaps=("gravity",))
    compare.compare_hybrid(own)
    (folder,) = (cell.folder for cell in compare.hybrid_cells(own))
    seconds = {0: [1.0, 2.0, 3.0], 1000: [4.0, 6.0, 8.0]}
    lines = [{"step": n, "exploded": [0.0] * 3, "score": [10.0] * 3, "upright_s": x} for n, x in seconds.items()]
    (folder / "eval.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return own


def test_tables_also_show_what_else_a_task_is_judged_by(standing, tmp_path, capsys):
    head = "| measure | data | simulator | sac |\n"
    for score, mean in (("last", "6.00 [4.00, 8.00]"), ("late", "4.00 [2.50, 5.50]")):
        compare.compare_hybrid(replace(standing, score=score))
        said = capsys.readouterr().out
        assert head in said and f"| upright_s | - | gravity | {mean} |" in said
        compare.compare_hybrid(replace(standing, export=tmp_path))
        compare.compare_hybrid(replace(standing, released=tmp_path, score=score))
        assert f"| upright_s | - | gravity | {mean} |" in capsys.readouterr().out
    compare.compare_hybrid(replace(standing, released=tmp_path, score="last", seeds=2))
    assert "| upright_s | - | gravity | 5.00 |" in capsys.readouterr().out  # two seeds have no interval
    table = gzip.decompress((tmp_path / "hybrid.csv.gz").read_bytes()).decode().splitlines()
    assert len(table) == 5 and sum(",upright_s," in line for line in table) == 2


@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("lost", "said"),
    [
        (",upright_s,1000,", "a run of sac on halfcheetah lacks rows of upright_s"),
        (",return,0,", "a run of sac on halfcheetah lacks rows of score"),
        (",return,", "a run of sac on halfcheetah has neither success nor return"),
    ],
)
def test_a_table_without_some_of_its_rows_is_named(lost, said, standing, tmp_path):
    compare.compare_hybrid(replace(standing, export=tmp_path))
    path = tmp_path / "hybrid.csv.gz"
    lines = gzip.decompress(path.read_bytes()).decode().splitlines(keepends=True)
    path.write_bytes(gzip.compress("".join(line for line in lines if lost not in line).encode()))
    with pytest.raises(UserError, match=rf"hybrid\.csv\.gz: {said}; put the table back"):
        compare.compare_hybrid(replace(standing, released=tmp_path))


@pytest.mark.usefixtures("undrawn")
def test_runs_of_two_lengths_are_compared_in_their_order(grid, ran, tmp_path, capsys):
    own = replace(grid, methods=("iql", "cql", "edac"), reference="iql", data=grid.data[:1], gaps=("gravity",))
    for updates, order in ((1000, (1.0, 2.0, 3.0)), (2000, (1.0, 3.0, 2.0))):
        run = replace(own, schedule=replace(own.schedule, updates=updates), out=tmp_path / str(updates))
        for cell, score in zip(compare.hybrid_cells(run), order, strict=True):
            leave(cell.args, [score] * 3)
            (cell.folder / "eval.jsonl").write_text(json.dumps({"step": updates, "score": [score] * 3}) + "\n")
        compare.compare_hybrid(replace(run, export=tmp_path))
    compare.compare_hybrid(replace(run, released=tmp_path, beside=1000))
    said = capsys.readouterr().out
    assert "| medium | gravity | 0.50 | cql, edac, iql | edac, cql, iql |" in said and "after 1,000 updates" in said


@pytest.mark.heavy_after_first
@pytest.mark.usefixtures("undrawn")
@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"released": "none"}, r"hybrid\.csv: no such table; write one with: .*--export"),
        ({"released": "tables", "seeds": 9}, r"hybrid\.csv\.gz: \w+ has no seed 3; name others with --seed, --seeds"),
        ({"released": "tables", "task": "walker2d"}, r"has none of these runs, 1,000,000 updates of walker2d"),
        ({"released": "tables", "beside": 500}, r"has none of these runs, 500 updates of halfcheetah"),
        ({"beside": 500}, r"--beside: reads released tables"),
        ({"export": "tables/hybrid.csv.gz"}, r"hybrid\.csv\.gz is a file; choose another --export"),
        ({"export": "tables", "released": "tables"}, r"--export and --released exclude each other"),
        ({"export": "new", "methods": ("edac",), "reference": "edac"}, r"--export .*: none of these runs has finished"),
    ],
)
def test_what_released_tables_lack_is_one_line(changes, said, grid, ran, tmp_path):
    compare.compare_hybrid(grid)
    compare.compare_hybrid(replace(grid, export=tmp_path / "tables"))
    given = {name: tmp_path / text if name in ("released", "export") else text for name, text in changes.items()}
    with pytest.raises(UserError, match=said):
        compare.compare_hybrid(replace(grid, **given))


def test_a_damaged_table_is_named(grid, tmp_path):
    head = "task,real,data,gap,method,schedule,updates,commit,score,step,seed-0\n"
    (tmp_path / "hybrid.csv").write_text(head + "halfcheetah,sim,,gravity,sac,fleet,1000,,return,0,x\n")
    with pytest.raises(UserError, match=r"hybrid\.csv: could not convert string to float: 'x'; put the table back"):
        compare.compare_hybrid(replace(grid, released=tmp_path))
