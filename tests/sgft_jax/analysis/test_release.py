"""Tables that are written from runs, read back, and those that come with the project."""

import csv
import gzip
import json
from pathlib import Path

import numpy as np
import pytest
from runs_by_hand import pretrained, save

from envs.types import UserError
from sgft_jax.analysis.curves import area
from sgft_jax.analysis.reading import read_runs
from sgft_jax.analysis.release import COLUMNS, export, read_data
from sgft_jax.files.disk import read_csv

DATA = Path(__file__).parents[3] / "docs" / "data"
PRIORS = ("aaaaaaaaaaaa", "bbbbbbbbbbbb")


def test_runs_become_tables_and_the_same_curves_again(tmp_path):
    out, to = tmp_path / "runs", tmp_path / "data"
    save(out, "sac", [[0.2, 1 / 3], [0.8, 1.0]], rollouts=[0, 20], priors=PRIORS)
    save(out, "sac_slow", [[0.0, 0.1], [0.1, 0.2]], rollouts=[0, 5], real="hard", variant="slow")
    save(out, "mbpo", [[0.5], [0.6]], rollouts=[0, 5], task="other", seeds="seed-4")
    assert sorted(path.name for path in export(out, to)) == ["curves-other.csv.gz", "curves-toy.csv.gz", "runs.csv.gz"]
    before, after = ({(c.task, c.gap, c.name): c for c in found.curves} for found in (read_runs(out), read_data(to)))
    assert before.keys() == after.keys()
    for key, curve in before.items():
        for name in ("seeds", "prior", "x", "transitions"):
            np.testing.assert_array_equal(getattr(after[key], name), getattr(curve, name))
        for score in ("success", "return"):
            np.testing.assert_allclose(after[key].of(score).values, curve.of(score).values, rtol=5e-4)
    runs = {row["method"] + row["variant"]: row for row in read_csv(to / "runs.csv.gz")}
    assert runs["sac"]["commit"] == "0123456789ab" and runs["sac"]["priors"] == "fast-aaaaaa"
    assert runs["sacslow"]["options.horizon"] == "4"


def test_what_is_judged_by_its_return_still_is(tmp_path):
    folder = save(tmp_path / "runs", "sac", [[0.0], [0.0]], rollouts=[0, 20], seeds="seeds-0-0")
    (folder / "summary.json").write_text('{"score": "return"}')
    export(tmp_path / "runs", tmp_path / "data")
    (before,), (after,) = read_runs(tmp_path / "runs").curves, read_data(tmp_path / "data").curves
    assert before.score == after.score == "return"
    np.testing.assert_allclose(after.values, before.values)


def test_what_is_there_already_stays_and_the_same_run_is_replaced(tmp_path):
    first, second, to = tmp_path / "a", tmp_path / "b", tmp_path / "data"
    save(first, "sac", [[0.2, 0.2], [0.8, 1.0]], rollouts=[0, 20])
    save(first, "mbpo", [[0.2, 0.2], [0.4, 0.4]], rollouts=[0, 20])
    save(second, "sac", [[0.2, 0.2], [0.5, 0.5], [0.6, 0.6]], rollouts=[0, 20, 40])
    export(first, to)
    once = {path.name: path.read_bytes() for path in to.iterdir()}
    export(first, to)
    assert {path.name: path.read_bytes() for path in to.iterdir()} == once
    export(second, to)
    assert {c.method: c.x[-1] for c in read_data(to).curves} == {"sac": 40, "mbpo": 20}
    assert len(read_csv(to / "runs.csv.gz")) == 2


def test_a_plain_table_stays_plain_and_two_of_a_name_are_refused(tmp_path):
    save(tmp_path / "runs", "sac", [[0.2, 0.2]], rollouts=[0])
    to = tmp_path / "data"
    export(tmp_path / "runs", to)
    (before,) = read_data(to).curves
    (to / "curves-toy.csv").write_bytes(gzip.decompress((to / "curves-toy.csv.gz").read_bytes()))
    with pytest.raises(UserError, match=r"curves-toy.csv: curves-toy.csv.gz lies beside it; keep one of the two"):
        read_data(to)
    (to / "curves-toy.csv.gz").unlink()
    export(tmp_path / "runs", to)
    assert sorted(path.name for path in to.iterdir()) == ["curves-toy.csv", "runs.csv.gz"]
    np.testing.assert_array_equal(read_data(to).curves[0].values, before.values)


def test_columns_stay_where_they_are_and_new_ones_follow(tmp_path):
    """Whatever comes first in the alphabet: a change of a released table shows what is new and no more."""
    to = tmp_path / "data"
    save(tmp_path / "a", "sac", [[0.2, 0.2]], rollouts=[0])
    export(tmp_path / "a", to)
    head = list(read_csv(to / "runs.csv.gz")[0])
    folder = save(tmp_path / "b", "mbpo", [[0.2, 0.2]], rollouts=[0], task="ahead")
    stored = json.loads((folder / "config.json").read_text())
    stored["config"]["options"] = {"another": 1}
    (folder / "config.json").write_text(json.dumps(stored))
    export(tmp_path / "b", to)
    (first, second) = read_csv(to / "runs.csv.gz")
    assert list(first) == [*head, "options.another"] and (first["task"], second["task"]) == ("ahead", "toy")


def test_pretraining_and_tuning(tmp_path):
    out, to = tmp_path / "runs", tmp_path / "data"
    pretrained(out)
    save(out / "tune", "sac_trial-0", [[0.2], [0.9]], rollouts=[0, 20], seeds="seed-9", variant="trial-0")
    scores = {"rollouts": 20, "area": 0.55, "final": 0.9, "areas": {}}
    trials = [{"options": {"utd": 2.0}, **scores, "folders": ["/home/somebody/x"]}]
    chosen = {"task": "toy", "method": "sac", "trial": 0, "trials": trials, "budget": {"trials": 1}, "space": {}}
    (out / "tuned/toy").mkdir(parents=True)
    (out / "tuned/toy/sac.json").write_text(json.dumps(chosen))
    written = {path.name: path for path in export(out, to)}
    assert sorted(written) == ["pretraining.csv.gz", "priors.csv.gz", "trials.csv.gz", "tuning.csv.gz"]
    assert [row["success"] for row in read_csv(written["pretraining.csv.gz"])] == ["0", "0", "0.4", "0.8"]
    prior = read_csv(written["priors.csv.gz"])[1]
    assert (prior["success"], prior["success/low"], prior["time/train_s"]) == ("0.9", "0.3", "12.5")
    trial = read_csv(written["tuning.csv.gz"])[0]
    assert (trial["chosen"], trial["rollouts"]) == ("True", "20")
    assert not any(b"/home/somebody" in gzip.decompress(path.read_bytes()) for path in written.values())


def test_nothing_to_write_or_read(tmp_path):
    with pytest.raises(UserError, match="holds no run"):
        export(tmp_path, tmp_path / "data")
    with pytest.raises(UserError, match=r"holds no curves-\*.csv"):
        read_data(tmp_path)


def test_the_released_tables():
    """At most 30 files and 1 MB, readable by anything that reads CSV, and every curve is the run of some row."""
    files = [path for path in DATA.rglob("*") if path.is_file()]
    assert len(files) <= 30 and sum(path.stat().st_size for path in files) <= 1_000_000
    with gzip.open(DATA / "curves-push.csv.gz", "rt", newline="") as file:
        head = next(csv.reader(file))
    assert head == list(COLUMNS[: len(head)])  # those from before lack the last column
    curves = read_data(DATA).curves
    identity = ("task", "gap", "method", "variant", "priors")
    runs = {tuple(row[name] for name in identity) for row in read_csv(DATA / "runs.csv.gz")}
    assert runs == {tuple(getattr(c, name) for name in identity) for c in curves} and len(runs) == len(curves)
    judged_by_return = {"halfcheetah"}
    assert all((c.score == "return") == (c.task in judged_by_return) for c in curves)
    assert all("return" in c.scores and c.x[0] == 0 for c in curves)


def test_tuning_tells_the_areas_of_its_trials():
    """What tuning.csv says of a trial follows from trials.csv: the mean area up to the budget's rollouts."""
    from sgft_jax.analysis.release import from_rows

    trials = {(c.method, c.variant): c for c in from_rows(read_csv(DATA / "trials.csv.gz"))}
    told = read_csv(DATA / "tuning.csv.gz")
    assert len(told) == len(trials) == 16
    for row in told:
        curve = trials[row["method"], f"trial-{row['trial']}"]
        grid = curve.x[curve.x <= json.loads(row["budget"])["rollouts"]]
        found = area(curve, grid)
        assert found is not None and found.mean() == pytest.approx(float(row["area"]), abs=1e-3)
