import copy

import matplotlib.image
import numpy as np
import pytest

from sgft_jax.analysis import figures, verdict
from sgft_jax.analysis.verdict import Coefficients, Names

NAMES = Names(
    action=["x", "y"],
    sensors=[("hand", "m"), ("puck", "m"), ("angle", "rad")],
    errors=(0.0, 0.01, 0.0),
    dt=0.2,
    furthest=2.0,
)
C = Coefficients(base=0.0, improvable=0.5, explained=0.5, pace=3.0)
NOTHING = {
    "rollouts": 4,
    "success": 1.0,
    "horizons": [1, 2, 4, 8],
    "value": {
        "bias": 0.1,
        "rank_correlation": 0.9,
        "shortfall": 0.2,
        "margin": 0.3,
        "real": [{"improvable": 1.0, "improving": 0.4}] * 4,
        "simulated": [{"improvable": 1.0, "improving": 0.5}] * 4,
    },
    "model_error": {"real": [0.2] * 4, "identified": [0.1] * 4, "simulated": [0.1] * 4},
    "identified": {
        "scale": [1.0, 1.0],
        "rotation": 0.0,
        "bias": [0.0, 0.0],
        "sensor_errors": [0.0, 0.0, 0.0],
        "nats": 0.0,
        "simulated": {"scale": [1.0, 1.0], "rotation": 0.0, "bias": [0.0, 0.0], "sensor_errors": [0.0, 0.0, 0.0]},
    },
    "delay": {"share": 0.02, "nats": 3.0},
    "noise": {"real": [0.001, 0.001, 0.01], "simulated": [0.001, 0.001, 0.01]},
}


def found(**changes):
    """A diagnosis in which nothing differs but these entries, by names such as `identified__scale`."""
    new = copy.deepcopy(NOTHING)
    for name, value in changes.items():
        *path, last = name.split("__")
        place = new
        for key in path:
            place = place[key]
        place[last] = value
    return new


def counted(**changes):
    return {sign.name: sign.words for sign in verdict.signs(found(**changes), NAMES) if sign.strength >= 1}


@pytest.mark.parametrize(
    ("changes", "name", "words"),
    [
        ({"identified__scale": [1.4, 1.4]}, "command scale", "the robot moves 1.40 times as far as in simulation"),
        ({"identified__scale": [0.5, 1.0]}, "command scale", "0.50 (x), 1.00 (y)"),
        ({"identified__rotation": -0.3}, "command rotation", "-0.30 rad"),
        ({"identified__bias": [0.0, 0.2]}, "command bias", "+0.00 (x), +0.20 (y)"),
        ({"identified__sensor_errors": [0.0, -0.012, 0.0]}, "sensor error", "puck by -12.0 mm"),
        ({"identified__sensor_errors": [0.0, 0.02, 0.0]}, "sensor error", "+20.0 mm or more (the limit of the fit)"),
        ({"delay": {"share": 1.0, "nats": 90.0, "at_limit": True}}, "delay", "0.200 s or more (the limit of the fit)"),
        ({"delay": {"share": 0.5, "nats": 90.0}}, "delay", "0.100 s later than in simulation"),
        ({"delay": {"share": -0.5, "nats": 90.0}}, "delay", "0.100 s earlier"),
        ({"noise__real": [0.001, 0.001, 0.03]}, "noise", "angle is 0.03 rad, 0.01 rad in simulation"),
        ({"model_error__identified": [0.3] * 4}, "what is left", "err 3.0 times as much as in simulation"),
    ],
)
def test_every_kind_of_gap_is_named_and_no_other(changes, name, words):
    signs = counted(**changes, identified__nats=50.0)
    assert list(signs) == [name] and words in signs[name]
    said = verdict.verdict(found(**changes, identified__nats=50.0), NAMES)[0]
    assert said == f"gap: {name}. In words: {signs[name]}"


def test_what_is_identified_in_simulation_too_does_not_count():
    same = {"scale": [1.4, 0.7], "rotation": -0.3, "bias": [0.2, 0.0], "sensor_errors": [0.0, 0.02, 0.0]}
    both = {f"identified__{name}": value for name, value in same.items()} | {"identified__nats": 50.0}
    assert counted(**both, identified__simulated=same) == {}
    assert list(counted(**both)) == ["command scale", "command rotation", "command bias", "sensor error"]


def test_nothing_counts_without_evidence():
    assert counted(identified__scale=[1.4, 1.4], identified__nats=2.0) == {}
    assert counted(identified__scale=[1.4, 1.4], identified__nats=50.0, model_error__real=[0.102] * 4) == {}
    assert counted(delay={"share": 0.5, "nats": 2.0}) == {}
    assert verdict.verdict(NOTHING, NAMES)[0] == "gap: nothing stands out against simulation"


def test_what_is_worth_it():

    def words(**changes):
        return verdict.verdict(found(**changes), NAMES, C)[2:]

    solved, horizon, now = words(rollouts=40)
    assert "little to gain (+0 points expected)" in solved and now == "time: 90 % expected now"
    assert horizon == "horizon of SGFT: H = 1 is enough, 100 % of the states are improvable with it"
    failed, _, later = words(success=0.0, model_error__identified=[0.01] * 4)
    assert failed.startswith("fine-tuning: worth it, +") and "expected after" in later
    assert "points expected in 20 rollouts, from about 20 to" in failed  # (0 of 4 + what V_sim promises) / 5
    hopeless = {"value__real": [{"improvable": 0.0, "improving": 0.0}] * 4, "model_error__identified": [9.0] * 4}
    lost, horizon, never = words(success=0.0, **hopeless)
    assert "little hope" in lost and never == "time: 90 % are not expected within 20 rollouts"
    assert "no horizon up to 8 suffices" in horizon
    far = [{"improvable": share, "improving": 0.0} for share in (0.5, 0.6, 0.95, 1.0)]
    assert "H = 4 is enough, 95 %" in words(value__real=far)[1]


def test_three_failures_of_ten_call_for_a_guard():
    chosen = [verdict.choice(*counts) for counts in ((2, 10), (3, 10), (1, 4), (2, 4))]
    assert chosen == ["sac", "guarded", "sac", "guarded"]


@pytest.mark.heavy
def test_the_picture_shows_what_counts_in_colour(tmp_path):
    points = {where: (np.linspace(0, 5, 40), np.linspace(1, 4, 40)) for where in ("real", "simulated")}

    def orange(data):
        path = tmp_path / "d.png"
        figures.diagnosis(path, data, verdict.signs(data, NAMES), points, title="push")
        image = matplotlib.image.imread(path)[400:, 600:]  # the panel of signs
        wanted = [int(figures.PALETTE[1][i : i + 2], 16) / 255 for i in (1, 3, 5)]
        return (np.abs(image[..., :3] - wanted).max(-1) < 0.01).sum()

    assert orange(NOTHING) == 0 < 1000 < orange(found(identified__scale=[1.4, 1.4], identified__nats=50.0))
