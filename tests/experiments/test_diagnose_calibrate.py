import numpy as np
import pytest

from experiments.studies import diagnose_calibrate
from experiments.studies.diagnose_calibrate import Cases
from sgft_jax.analysis import verdict
from sgft_jax.analysis.verdict import Coefficients, Inputs

C = Coefficients(base=0.1, improvable=0.2, explained=0.5, pace=4.0)


def cases(n=60, coefficients=C, noise=0.0, gaps=6):
    rng = np.random.default_rng(0)
    x = Inputs(*rng.uniform(0, 1, (3, n)))
    gains = verdict.gain(x, coefficients) + noise * rng.normal(size=n)
    rollouts = np.array([0, 1, 2, 4, 8, 20])
    curves = [
        (rollouts, s + g * verdict.progress(rollouts, coefficients.pace)) for s, g in zip(x.success, gains, strict=True)
    ]

    def names(word, of):
        return np.array([f"{word}{i % of}" for i in range(n)])

    return Cases(x, x.success, x.success, gains, curves, names("gap", gaps), names("prior", 4))


def test_the_formula_by_hand():
    x = Inputs(success=0.2, improvable=0.5, explained=1.0)
    assert verdict.gain(x, C) == pytest.approx(0.8 * (0.1 + 0.1 + 0.5))
    assert verdict.gain(x, C._replace(base=2.0)) == pytest.approx(0.8)  # never more than what is missing
    assert verdict.success_after(x, 0, C) == 0.2 and verdict.success_after(x, 20, C) == pytest.approx(0.76)
    ratio = (1 - np.exp(-1)) / (1 - np.exp(-5))
    assert verdict.success_after(x, 4, C) == pytest.approx(0.2 + 0.56 * ratio)


@pytest.mark.parametrize(("name", "sign"), [("success", -1), ("improvable", 1), ("explained", 1)])
def test_it_is_monotone_in_every_input(name, sign):
    x = Inputs(0.4, 0.4, 0.4)
    change = verdict.gain(x._replace(**{name: 0.6}), C) - verdict.gain(x, C)
    assert sign * change > 0.01


def test_rollouts_until_success():
    full = Coefficients(1.0, 0.0, 0.0, pace=4.0)
    x = Inputs(0.0, 1.0, 1.0)
    n = verdict.rollouts_until(x, 0.9, full)
    assert n == 9  # 1 - exp(-n / 4) >= 0.9 (1 - exp(-5)), n >= 8.97
    assert verdict.rollouts_until(x._replace(success=0.95), 0.9, full) == 0
    assert verdict.rollouts_until(x, 0.9, full._replace(base=0.5)) is None


def test_a_fit_finds_the_coefficients_and_never_a_negative_one():
    assert diagnose_calibrate.fit(cases()) == pytest.approx(C, abs=1e-6)
    downwards = cases(coefficients=Coefficients(0.8, -0.6, 0.0, 4.0))
    assert diagnose_calibrate.fit(downwards).improvable == 0.0


def test_every_second_gap_is_held_out_whole_and_teaches_nothing():
    some = cases()
    out = diagnose_calibrate.held_out(some.gaps)
    assert set(some.gaps[out]) == {"gap1", "gap3", "gap5"} and set(some.gaps[~out]) == {"gap0", "gap2", "gap4"}
    odd = some._replace(gains=np.where(out, 0.0, some.gains))
    assert diagnose_calibrate.fit(odd.of(~out)) == pytest.approx(C, abs=1e-6)


def test_agreement_and_table():
    some = cases(noise=0.02)
    predicted = verdict.gain(some.inputs, C)
    band = diagnose_calibrate.agreement(predicted, some)
    assert 0.9 < band.low < band.estimate < band.high <= 1.0
    assert diagnose_calibrate.agreement(-predicted, some).estimate == -band.estimate
    rows = diagnose_calibrate.table(predicted, some)
    assert sum(count for _, _, count, *_ in rows) == 60
    for low, high, _, expected, measured in rows:
        assert low <= expected <= high and measured == pytest.approx(expected, abs=0.03)


def test_inputs_of_a_diagnosis():
    found = {
        "rollouts": 3,
        "success": 1 / 3,
        "horizons": [1, 2, 4, 8],
        "value": {"shortfall": 120.0, "real": [{"improvable": 0.7}, {"improvable": 0.9}]},
        "model_error": {"real": [1.0, 1.0, 8.0, 1.0], "identified": [1.0, 1.0, 2.0, 1.0]},
    }
    assert verdict.inputs_of(found) == pytest.approx(Inputs(success=1.25 / 4, improvable=0.7, explained=0.75))
    found["value"]["shortfall"] = -1.0
    found["model_error"]["identified"] = [9.0] * 4
    assert verdict.inputs_of(found) == pytest.approx(Inputs(success=0.5, improvable=0.7, explained=0.0))
