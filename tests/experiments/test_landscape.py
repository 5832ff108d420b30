"""V_sim as a map: highest behind the puck, which the hand of a rollout approaches."""

import numpy as np
import pytest

from experiments.runner import cli
from experiments.studies import landscape
from sgft_jax.analysis import figures


@pytest.mark.heavy
def test_the_map_is_highest_behind_the_puck(tmp_path, monkeypatch, capsys):
    drawn, draw = [], figures.landscape

    def record(*args, **more):
        drawn.append(args)
        return draw(*args, **more)

    monkeypatch.setattr(figures, "landscape", record)
    argv = ["--impl", "c", "--seed", "10", "--branches", "3", "--horizon", "2", "--out", str(tmp_path)]
    cli.run_main(landscape.main, landscape.LandscapeArgs, "", argv=argv)
    (path, x, y, values, points), puck = drawn[0], drawn[0][4]["puck"][0]
    assert capsys.readouterr().out.strip() == str(path) and path.stat().st_size > 10_000
    row, column = np.unravel_index(values.argmax(), values.shape)
    best = np.array([x[column], y[row]])
    assert np.linalg.norm(best - puck) < 0.08 and best[0] < puck[0]
    away = np.linalg.norm(points["rollout"] - puck, axis=1)
    assert len(away) > 3 and (np.diff(away) < 0).all()
    assert points["imagined"].shape == (len(away) * 3 * 2, 2)
    steps = np.linalg.norm(
        points["imagined"].reshape(len(away), 3, 2, 2)[:, :, 0] - points["rollout"][:, None], axis=-1
    )
    assert 0.005 < np.median(steps) < 0.08  # one command is at most 5 cm
