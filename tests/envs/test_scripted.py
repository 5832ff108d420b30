"""Scripted controllers: statistics by hand, scripts that do move their objects."""

import jax
import numpy as np
import pytest
from scripted import PROBES, as_params, play_script, summarise


def test_summary_by_hand():
    travels = np.array([[3.0, 4.0], [0.0, -15.0], [0.1, 0.0]])  # 5 and 15 mm; the third hardly moves and is left out
    errors = np.array([[0.3, 0.4], [0.0, 1.0], [9.0, 9.0]])  # 0.5 mm too far, 1 mm too short
    summary = summarise(travels, errors)
    assert summary.travel == 10.0  # (5 + 15) / 2
    assert summary.mean == 0.75  # (0.5 + 1) / 2
    assert summary.worst == 1.0
    np.testing.assert_allclose(summary.relative, 0.075)  # 1.5 / 20
    np.testing.assert_allclose(summary.bias, -0.025)  # (0.5 - 1) / 20


def test_summary_of_an_object_at_rest():
    summary = summarise(np.zeros((2, 3)), np.array([[0.0, 0.0, 0.2], [0.0, 0.0, 0.0]]))
    assert summary.worst == 0.2
    assert summary.relative == 0.0


@pytest.mark.parametrize("task", [pytest.param("push", marks=pytest.mark.slow), "insert"])
def test_scripts_solve_the_nominal_task(task):
    probe = PROBES[task]
    theta = {p.name: p.nominal for p in probe.scene.parameters}
    state = jax.jit(probe.scene.initial)(as_params(theta), jax.random.key(0))
    episode = play_script(probe, theta, state, steps=probe.scene.episode_length)
    assert any(probe.scene.success(probe.scene.observe(as_params(theta), step.after)) for step in episode)
