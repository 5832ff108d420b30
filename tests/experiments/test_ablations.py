"""Transforms, horizon and severity, from run folders made by hand."""

import json
import re
from pathlib import Path

from runs_by_hand import rising, save

from experiments import ablations
from experiments.comparison import names_of, read_comparison
from sgft_jax.methods import METHODS

METHODS_PAGE = Path(__file__).parents[2] / "docs/methods.md"


def read(out):
    return [read_comparison(folder) for folder in sorted(out.glob("finetune/*/*"))]


def test_marks_are_the_transforms_that_the_page_of_methods_names():
    rows = re.findall(r"^\| `([\w-]+)` \| [^|]* \| ([^|]*)\|", METHODS_PAGE.read_text(), re.M)
    listed = {name: {part for part in cell.strip().split(", ") if part} for name, cell in rows}
    marked = {
        method.name: {part for part, mark in zip(("branch", "shape", "shorten"), ablations.marks(method), strict=True)
                      if mark}
        for method in METHODS.values()
    }  # fmt: skip
    assert marked == listed
    assert all(len(method.transforms(1, 1, 0.0)) == len(marked[name]) for name, method in METHODS.items())


def test_transforms_of_the_methods_that_are_sac_otherwise(tmp_path):
    for name in ("sac", "pbrs-branch", "rlpd", "sgft-sac_tuned"):
        save(tmp_path, name, task="push", **rising(40, to=50))
    save(tmp_path, "sgft-sac", task="push", **rising(20))
    save(tmp_path, "sgft-sac", task="insert", **rising(20))
    sections, missing = ablations.transforms(read(tmp_path))
    rows = re.findall(r"^\| ([\w-]+) \| (.?) \| (.?) \| (.?) \| (\w+) \| 2 \| ([\d,]+) \[", "\n".join(sections), re.M)
    assert rows == [
        ("sgft-sac", "✓", "✓", "✓", "kept", "400"),
        ("pbrs-branch", "✓", "✓", "", "new", "800"),
        ("sac", "", "", "", "kept", "800"),
    ]
    assert "### Transforms on push" in sections[1] and len(sections) == 2
    assert "area to 50 rollouts" in sections[1]  # where the shortest run ends
    (line,) = missing
    assert line.startswith("insert/default: no table of transforms, which takes two of sgft-sac, sgft, pbrs-branch")
    assert "rlpd" not in line and "tdmpc2" not in line and "frozen-critic" not in line


def test_nothing_but_the_horizon_differs(tmp_path, monkeypatch):
    drawn = {}
    monkeypatch.setattr(
        ablations.plot, "curve_panels", lambda path, panels, **more: drawn.update({path.name: (panels, more)}) or path
    )
    save(tmp_path, "sgft-sac", task="push", **rising(20))
    save(tmp_path, "sgft-mpc", task="push", **rising(20))
    save(tmp_path, "sgft-mpc_h8", task="push", horizon=8, **rising(20))
    save(tmp_path, "sgft-sac_h1", task="push", horizon=1, branches=5, **rising(40))
    save(tmp_path, "sgft-sac_h2", task="push", horizon=2, rollouts=[0, 50], success=[[0, 0], [1.0, 0.5]])
    save(tmp_path, "sgft-sac_slow", task="push", horizon=8, lr_actor=1e-5, **rising(90))
    save(tmp_path, "sgft_h4", task="push", horizon=4, **rising(90))
    save(tmp_path, "sgft-sac", task="insert", **rising(20))
    initial = save(tmp_path, "sgft-sac_initial", task="insert", horizon=1, **rising(90))
    config = json.loads((initial / "config.json").read_text())
    config["config"]["initial_rollouts"] = 20
    (initial / "config.json").write_text(json.dumps(config))
    (_, text, planned), missing = ablations.horizons(read(tmp_path), tmp_path)
    assert {name: {task: list(curves) for task, curves in panels.items()} for name, (panels, _) in drawn.items()} == {
        "horizon-sgft-sac.png": {"push": ["H = 1, 5 branches", "H = 2", "H = 4"]},
        "horizon-sgft-mpc.png": {"push": ["H = 1", "H = 8"]},
    }
    assert drawn["horizon-sgft-sac.png"][1]["order"] == ["H = 1, 5 branches", "H = 2", "H = 4"]
    assert "| push | H = 8 | sgft-mpc_h8 | 2 | 400 " in planned and "sgft-sac" not in planned
    assert "| push | H = 2 | sgft-sac_h2 | 2 | > 1,000 [1,000, > 1,000] | > 1,000 [1,000, > 1,000] | 75 " in text
    assert "| push | H = 1, 5 branches | sgft-sac_h1 | 2 | 800 [800, 800] | 800 [800, 800] | 100 " in text
    assert "| 75 [50, 100] (50) | 1 of 2 |" in text and "| 100 [100, 100] (100) | 0 of 2 |" in text
    assert missing == ["insert/default: no two horizons of sgft-sac or sgft-mpc with all else equal"]


def test_horizons_without_a_run_of_the_default_one(tmp_path):
    for horizon in (1, 2):
        save(tmp_path, f"sgft-sac_horizon-{horizon}", horizon=horizon, **rising(20))
    (_, text), missing = ablations.horizons(read(tmp_path), tmp_path)
    assert "| toy | H = 2 |" in text and (tmp_path / "horizon-sgft-sac.png").stat().st_size > 10_000
    assert missing == ["toy/default: no two horizons of sgft-mpc with all else equal"]


def test_horizons_of_variants_beside_a_default_run_without_another(tmp_path):
    save(tmp_path, "sgft-sac", **rising(20))
    for horizon in (1, 4):
        save(tmp_path, f"sgft-sac_slow-{horizon}", horizon=horizon, lr_actor=1e-5, **rising(20))
    (_, text), _ = ablations.horizons(read(tmp_path), tmp_path)
    assert "| toy | H = 1 | sgft-sac_slow-1 |" in text and "| toy | H = 4 | sgft-sac_slow-4 |" in text


def test_an_older_run_lacks_options_that_came_later(tmp_path):
    older = save(tmp_path, "sgft-sac", **rising(20)) / "config.json"
    config = json.loads(older.read_text())
    del config["config"]["options"]["train_encoder"]
    older.write_text(json.dumps(config))
    save(tmp_path, "sgft-sac_h1", horizon=1, **rising(20))
    sections, _ = ablations.horizons(read(tmp_path), tmp_path)
    assert "| toy | H = 1 |" in sections[1] and "| toy | H = 4 |" in sections[1]


def test_a_run_without_its_configuration_has_no_horizon(tmp_path):
    (save(tmp_path, "sgft-sac", **rising(20)) / "config.json").unlink()
    save(tmp_path, "sgft-sac_h1", horizon=1, **rising(20))
    sections, missing = ablations.horizons(read(tmp_path), tmp_path)
    assert not sections and len(missing) == 1


def severity(out):
    found = read(out)
    return ablations.severity(found, out, names_of(found))


def test_severity_is_in_the_order_of_the_file_of_gaps(tmp_path, monkeypatch):
    drawn = {}

    def record(path, steps, scores, needed, **more):
        drawn.update(more, path=path, steps=steps, scores=scores, needed=needed)
        return path

    monkeypatch.setattr(ablations.plot, "severity", record)
    save(tmp_path, "sgft-sac", task="hammer", real="hard", **rising(60))
    save(tmp_path, "sgft-sac", task="hammer", real="default", **rising(20, level=0.96))
    save(tmp_path, "sgft-sac", task="hammer", real="camera", **rising(None))  # another kind of gap
    save(tmp_path, "sac", task="hammer", real="mild", **rising(None, to=10))
    save(tmp_path, "sac", task="hammer", real="default", **rising(None))
    save(tmp_path, "rlpd", task="hammer", real="mild", **rising(20))  # on one gap alone
    save(tmp_path, "sac", task="push", real="mild", **rising(20))
    sections, missing = severity(tmp_path)
    assert drawn["path"] == tmp_path / "severity-hammer.png" and drawn["steps"] == ["mild", "default", "hard"]
    assert drawn["needed"] == {
        "sgft-sac": [None, (400, True), (1200, True)], "sac": [(200, False), (2000, False), None],
    }  # fmt: skip
    # After 20 rollouts; the run of sac on mild ended before.
    assert [None if s is None else s.tolist() for s in drawn["scores"]["sgft-sac"]] == [None, [0.96] * 2, [0.0] * 2]
    assert drawn["scores"]["sac"][0] is None and drawn["thick"] == ["sgft-sac"]
    rows = re.findall(r"^\| ([\w-]+) \| (\w+) \| 2 \|.* \| ([> \d,]+)(?: \[.*?\])? \| (\d of 2) \|$", sections[1], re.M)
    assert rows == [
        ("sgft-sac", "default", "400", "0 of 2"), ("sgft-sac", "hard", "1,200", "0 of 2"),
        ("sac", "mild", "> 200", "2 of 2"), ("sac", "default", "> 2,000", "2 of 2"),
    ]  # fmt: skip
    assert missing == ["push: no method has run on more than one gap of mild, default, hard"]


def test_a_figure_of_severities_has_no_variants_beside_their_method(tmp_path, monkeypatch):
    drawn = []

    def record(path, steps, scores, needed, **_):
        drawn.extend(scores)
        return path

    monkeypatch.setattr(ablations.plot, "severity", record)
    for real in ("mild", "hard"):
        for name in ("sac", "sac_tuned", "mbpo_tuned"):  # of MBPO there is no other
            save(tmp_path, name, task="push", real=real, **rising(20))
    sections, _ = severity(tmp_path)
    assert sorted(drawn) == ["mbpo_tuned", "sac"]
    assert "| sac_tuned | mild |" in sections[1]


def test_how_far_sgft_is_ahead_by_severity(tmp_path):
    """Against the best other method with runs on most gaps, over what both runs had: 0.9 - 0.6, and 0.9 - 0.3."""
    steady = lambda level, **more: rising(0, level=level, **more)  # noqa: E731
    for real, level in (("mild", 0.6), ("hard", 0.3)):
        save(tmp_path, "sgft-sac", task="push", real=real, **steady(0.9))
        save(tmp_path, "mbpo", task="push", real=real, **steady(level, to=50))
        save(tmp_path, "sac", task="push", real=real, **steady(0.1))
        save(tmp_path, "sac_tuned", task="push", real=real, **steady(1.0))  # beside its method
    for real in ("mild", "default"):
        save(tmp_path, "sgft", task="push", real=real, **steady(0.5))
        save(tmp_path, "rlpd", task="push", real=real, **steady(1.0))
    save(tmp_path, "mbpo", task="push", real="default", **steady(0.6))
    text = severity(tmp_path)[0][1].split("minus that of ")[1]
    assert text.startswith("mbpo:")
    rows = re.findall(r"^\| (sgft\S*) \| (.*) \| (.*) \| (.*) \|$", text, re.M)
    assert rows == [
        ("sgft-sac", "30 [30, 30]", "-", "60 [60, 60]"), ("sgft", "-10 [-10, -10]", "-10 [-10, -10]", "-"),
    ]  # fmt: skip


def test_severities_without_two_kinds_of_method_compare_nothing(tmp_path):
    for real in ("mild", "hard"):
        save(tmp_path, "sgft-sac", task="push", real=real, **rising(20))
        save(tmp_path, "sac", task="push", real=real, rollouts=[0], success=[[0.0, 0.0]])
    assert "minus that of" not in severity(tmp_path)[0][1]


def test_a_figure_of_severities_with_holes(tmp_path):
    for real, to in (("mild", 10), ("hard", 10)):
        save(tmp_path, "sac", task="push", real=real, **rising(None, to=to, seeds=1))
    sections, _ = severity(tmp_path)
    assert (tmp_path / "severity-push.png").stat().st_size > 10_000 and "| sac | hard | 1 |" in sections[1]
