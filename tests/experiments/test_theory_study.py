"""The study of the paper's theory, as small as it can be."""

import json

import pytest

from experiments.runner import cli
from experiments.studies import theory


@pytest.mark.heavy
def test_bounds_hold_and_v_sim_guides_the_pendulum(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(theory, "_COARSE", 21)
    monkeypatch.setattr(theory, "_TORQUES", 21)
    argv = f"--systems 8 --horizons 1 3 --points 41 --out {tmp_path}".split()
    cli.run_main(theory.main, theory.TheoryArgs, "", argv=argv)
    written = json.loads((tmp_path / "theory/summary.json").read_text())
    bounds = written["bounds"]
    assert [(line["systems"], line["model"], line["H"]) for line in bounds] == [
        (systems, model, h) for systems in ("random", "pendulum") for model in ("right", "wrong") for h in (1, 3)
    ]
    broken = {name for line in bounds for name, x in line.items() if name.endswith("broken") and x > 0}
    assert broken <= {"lemma 1, printed broken"}
    assert all((line["median alpha"] > 0) == (line["model"] == "wrong") for line in bounds)
    before, tight, one, four, best = written["pendulum"]
    assert before["return"] < tight["return"] < one["return"] - 1 < four["return"] + 1 < best["return"] + 2
    assert tight["improvable states"] < 0.9 < one["improvable states"]
    figures = [line.removeprefix("figure: ") for line in capsys.readouterr().out.splitlines() if "figure" in line]
    assert figures == [str(tmp_path / "theory" / name) for name in ("bounds.png", "pendulum.png")]
    assert all((tmp_path / "theory" / name).stat().st_size > 10_000 for name in ("bounds.png", "pendulum.png"))
