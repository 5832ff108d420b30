"""The study of V_sim as a guide, as small as it can be, and its verdicts by hand."""

import json

import numpy as np
import pytest
from priors_by_hand import save_prior

from experiments.runner import cli
from experiments.studies import guidance
from experiments.studies.guidance import Seen

SIZES = ["--states", "8", "--actions", "4"]


@pytest.mark.heavy
@pytest.mark.usefixtures("toy_task")
def test_the_simulator_comes_first_and_every_real_system_has_a_line(tmp_path, capsys):
    save_prior(tmp_path / "prior/seed-0", 0)
    gap = tmp_path / "gaps.toml"
    gap.write_text("[weak.effects]\naction_scale = 0.5\n\n[heavy.params]\nmass = 1.3\n")
    argv = ["--prior", str(tmp_path / "prior/seed-0"), "--real", str(gap), *SIZES, "--out", str(tmp_path / "out")]
    cli.run_main(guidance.main, guidance.GuidanceArgs, "", argv=argv)
    written = json.loads((tmp_path / "out/guidance/toy/summary.json").read_text())
    assert [line["real"] for line in written["lines"]] == ["sim", "weak", "heavy"]
    assert written["margin"] > 0
    for line in written["lines"]:
        assert 0 <= line["improvable, H = 1"] <= 1 and 0 <= line["success"] <= 1
    assert capsys.readouterr().out.splitlines()[-1].endswith("guidance/toy/summary.json")


def seen(headroom, success, value=(1.0, 2.0), goal=(False, True)):
    rows = np.array([[x, x] for x in headroom], float)
    return Seen(rows, np.zeros(2), np.array(value), np.array(goal), np.array(success))


def test_a_state_is_improvable_where_the_best_action_keeps_the_promise_but_for_the_noise():
    line = guidance._judged(seen((0.1, -0.05, -0.3, -0.1), (True, False, False, False)), 0.1)
    assert line["improvable, H = 4"] == 0.75 and line["success"] == 0.25


def test_v_sim_at_goals_is_compared_with_all_others():
    line = guidance._judged(seen((0, 0), (False, True)), 0.1)
    assert line["V_sim higher at goals"] == 1
    assert guidance._judged(seen((0, 0), (False, True), value=(3.0, 2.0)), 0.1)["V_sim higher at goals"] == 0
    assert np.isnan(guidance._judged(seen((0, 0), (False, False), goal=(False, False)), 0.1)["V_sim higher at goals"])
