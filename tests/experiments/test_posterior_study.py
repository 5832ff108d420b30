"""The study of posteriors, as small as it can be."""

import json

import numpy as np
import pytest

from experiments.studies import posterior


@pytest.mark.slow
def test_both_parts_on_push(tmp_path, monkeypatch, capsys):
    sizes = {"_CANDIDATES": 3, "_JUDGES": 2, "_EPISODES": 1, "_PLAYED": 2, "EXPONENTS": (0.001, 0.002)}
    for name, value in sizes.items():
        monkeypatch.setattr(posterior, name, value)
    args = posterior.PosteriorArgs(
        parts=("gate", "calibrate"),
        tasks=("push",),
        systems=2,
        rollouts=(1,),
        draws=20,
        particles=8,
        states=4,
        impl="c",
        json=True,
        out=tmp_path,
    )
    posterior.main(args)
    summary = json.loads((tmp_path / "posterior/summary.json").read_text())
    assert json.loads(capsys.readouterr().out) == summary
    (gate,), lines = summary["gate"], summary["calibrate"]
    assert gate["least beaten"] >= 0.9 and gate["passed"], "the truth explains its rollouts best"
    assert [line["exponent"] for line in lines] == [0.0, 0.001, 0.002]
    assert lines[0]["ancestors"] == 8 and lines[0]["stages"] == 0 < lines[-1]["stages"]
    numbers = [value for line in lines for value in line.values() if isinstance(value, float)]
    assert np.isfinite(numbers).all() and len(lines[0]["by unknown"]) == 12


def test_bad_numbers_are_one_line_and_leave_nothing(tmp_path, capsys):
    from experiments.runner import cli

    with pytest.raises(SystemExit) as stopped:
        cli.run_main(
            posterior.main,
            posterior.PosteriorArgs,
            "",
            argv=["--rollouts", "2", "0", "--out", str(tmp_path / "out")],
        )
    assert stopped.value.code == 2 and "--rollouts is 0" in capsys.readouterr().err and not any(tmp_path.iterdir())
