import dataclasses
import itertools
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest
from test_curves import curve

from sgft_jax.analysis import figures, release
from sgft_jax.analysis.curves import Curve
from sgft_jax.analysis.hybrid import Results
from sgft_jax.methods import FIXED_NAMES, NAMES

ROOT = Path(__file__).parents[3]


def curves(count, seeds=3):
    values = np.random.default_rng(0).uniform(0.2, 1.0, (count, seeds, 5))
    return [curve(x, np.arange(5), method=f"method-{i}") for i, x in enumerate(values)]


def pixels(image, color):
    """How many have about that colour."""
    wanted = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return (np.abs(image[..., :3] - wanted).max(-1) < 0.01).sum()


def read(path):
    return matplotlib.image.imread(path)


def test_the_axis_says_how_long_a_rollout_is_where_evaluations_are_free():
    """On a robot they are real episodes, and transitions those of both."""
    (own,) = curves(1)
    steps = int(own.transitions[1])
    assert figures._unit([own]).startswith(f"real rollouts of {steps} transitions, ")
    dear = dataclasses.replace(own, transitions=own.transitions + 20 * steps * np.array([0, 1, 2, 2, 2]))
    assert figures._unit([dear]) == "real rollouts"


@pytest.mark.parametrize("count", [1, 2, 6])
def test_every_curve_has_a_colour_of_its_own(tmp_path, count):
    image = read(figures.learning_curves(tmp_path / "new" / "c.png", {"push": curves(count)}, title="Push"))
    drawn = [pixels(image, color) > 200 for color in figures.colours(curves(6)).values()]
    assert drawn == [True] * count + [False] * (6 - count)
    assert (image[[0, -1]] > 0.99).all() and (image[:, [0, -1]] > 0.99).all()  # nothing is cut off at the border


@pytest.mark.parametrize("real", ["gymnasium:HalfCheetah-v5", "gymnasium:my_lab:Pusher-that-has-a-name-of-its-own-v0"])
def test_a_long_title_is_not_cut_off(real, tmp_path):
    title = f"halfcheetah on the {real} real system"
    image = read(figures.learning_curves(tmp_path / "t.png", {"sac": curves(1)}, title=title))
    assert (image[[0, -1]] > 0.99).all() and (image[:, [0, -1]] > 0.99).all()
    assert pixels(image[:50], figures._INK) > 100  # it is there


@pytest.mark.parametrize(("count", "sizes"), [(6, [6]), (7, [4, 3]), (13, [5, 4, 4])])
def test_more_than_six_curves_become_small_multiples(count, sizes):
    parts = figures._split("push", curves(count))
    assert [len(own) for _, own, _ in parts] == sizes
    assert all(len(own) + len(others) == count or not others for _, own, others in parts)
    assert len({line.name for _, own, _ in parts for line in own}) == count
    assert [words for words, *_ in parts][:1] == (["push"] if count == 6 else [f"push, 1 of {len(sizes)}"])


def test_parts_of_a_panel_have_one_scale(tmp_path, monkeypatch):
    """Seven returns, one of which is far above the others; a panel of its own has its own."""
    seven = [curve([[10.0**i, 2.0 * 10**i]], (0, 1), method=f"m{i}", score="return") for i in range(7)]
    figures_made, save = [], figures._save
    monkeypatch.setattr(figures, "_save", lambda figure, *more: figures_made.append(figure) or save(figure, *more))
    figures.learning_curves(tmp_path / "s.png", {"many": seven, "one": seven[:1]}, title="")
    limits = [axes.get_ylim() for axes in figures_made[0].axes]
    assert limits[0] == limits[1] and limits[0][1] >= 2e6 and limits[2][1] < 3


def test_every_method_has_one_colour():
    """Also those that no figure shows together; spare colours are none of theirs."""
    assert figures.COLOURS.keys() == {*NAMES, *FIXED_NAMES}
    spare = list(itertools.islice(figures._spare(), 100))
    assert len({*figures.COLOURS.values(), *spare}) == len(figures.COLOURS) + 100


def test_no_two_names_of_a_figure_share_a_colour():
    """A method keeps its colour wherever it is; its variants, and methods from elsewhere, get what is left."""
    names = [(method, "") for method in NAMES] + [("guarded", "again"), ("guarded", "horizon=1"), ("mine", "")]
    drawn = [curve([0.0], (0,), method=method, variant=variant) for method, variant in names]
    chosen = figures.colours(drawn)
    assert len(set(chosen.values())) == len(chosen) == len(names)
    assert all(chosen[method] == figures.COLOURS[method] for method in NAMES)
    assert chosen == figures.colours(drawn[::-1])
    (alone,) = figures.colours([curve([0.0], (0,), method="sac", variant="horizon=1")]).values()
    assert alone == figures.COLOURS["sac"]


@pytest.mark.parametrize("task", ["push", "halfcheetah"])
def test_no_two_names_of_a_committed_figure_share_a_colour(task):
    by_gap = {}
    for line in release.read(Path("runs"), ROOT / "docs/data").curves:
        if line.task == task:
            by_gap.setdefault(line.gap, []).append(line)
    for gap, lines in by_gap.items():
        chosen = figures.colours(lines)
        assert len(set(chosen.values())) == len({line.name for line in lines}), gap


def test_a_band_needs_three_seeds(tmp_path):
    """Two seeds and one draw the same line and nothing around it."""
    images = [
        read(figures.learning_curves(tmp_path / f"{n}.png", {"": [curve([[0.1, 0.9]] * n, (0, 1))]}, title=""))
        for n in (1, 2)
    ]
    assert pixels(images[0], figures.COLOURS["sac"]) == pixels(images[1], figures.COLOURS["sac"]) > 200
    assert figures._note(curves(1, seeds=1)) == "one seed"
    assert figures._note(curves(1, seeds=2)) == "line: interquartile mean of 2 seeds"
    assert "drawing seeds" in figures._note(curves(1, seeds=3))


def test_returns_are_drawn_too(tmp_path):
    path = figures.learning_curves(tmp_path / "r.png", {"": [curve([-300, 40], (0, 1), score="return")]}, title="")
    assert pixels(read(path), figures.COLOURS["sac"]) > 200


def test_a_run_without_a_real_rollout_is_drawn(tmp_path):
    assert figures.learning_curves(tmp_path / "z.png", {"": [curve([[0.5]], (0,))]}, title="").exists()


def test_curves_over_updates(tmp_path, monkeypatch):
    """A panel for each simulator; methods without one are in both, those that miss a run in none."""
    updates, scores = np.array([0, 10_000, 20_000]), np.arange(9.0).reshape(3, 3)
    places = [("h2oplus", "released", "medium", "gravity"), ("iql", "", "medium", ""), ("sac", "", "", "friction")]
    places.append(("iql", "", "replay", ""))
    curves = [
        Curve(
            "halfcheetah",
            gap,
            method,
            preset,
            seeds=np.arange(3),
            x=updates,
            scores={"return": scores + 5 * (i % 3)},
            score="return",
            data=data,
            unit="updates",
        )
        for i, (method, preset, data, gap) in enumerate(places)
    ]
    methods = [curve.spec for curve in curves[:3]]
    results = Results(("medium", "replay"), ("gravity", "friction"), methods, curves)
    figures_made, save = [], figures._save
    monkeypatch.setattr(figures, "_save", lambda figure, *more: figures_made.append(figure) or save(figure, *more))
    image = read(figures.learning_curves(tmp_path / "h.png", results.panels("medium"), title="Medium"))
    assert all(pixels(image, figures.COLOURS[method]) > 200 for method in ("h2oplus", "iql", "sac"))
    panels = {axes.get_title(loc="left"): axes for axes in figures_made[0].axes}
    lines = {words: {line.get_label(): line for line in axes.get_lines()} for words, axes in panels.items()}
    assert {words: list(drawn) for words, drawn in lines.items()} == {
        "simulator: gravity": ["h2oplus:released", "iql"],
        "simulator: friction": ["iql", "sac"],
    }
    assert {axes.get_xlabel() for axes in panels.values()} == {"updates"}
    line = lines["simulator: friction"]["sac"]
    assert line.get_xdata().tolist() == [0, 10_000, 20_000]
    np.testing.assert_allclose(line.get_ydata(), [13, 14, 15])  # of 10, 13, 16 and so on
    (sac,) = (curve for curve in results.panels("medium")["simulator: friction"] if curve.name == "sac")
    band = panels["simulator: friction"].collections[1].get_paths()[0].get_extents()  # of three seeds
    assert sac.family == "simulator" and band.ymin < 13 and band.ymax > 15


@pytest.mark.parametrize("n", [1, 200])
def test_pretraining_panels(tmp_path, n):
    returns = np.linspace(0, 5, n)
    path = figures.pretraining(
        tmp_path / "pretraining.png",
        (np.arange(10) * 1e5, np.linspace(0, 1, 10), np.linspace(0, 50, 10)),
        (returns, returns),
        ([0.1, 0.2, 0.3], [0.2, 0.5, 0.9]),
        title="Pretraining",
    )
    assert read(path).shape[:2] == (384, 1440)
