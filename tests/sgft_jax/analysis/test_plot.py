import itertools

import matplotlib.image
import numpy as np
import pytest

from sgft_jax.analysis import plot

X = np.arange(0, 2001, 500)


def scores(seeds):
    return np.clip(np.random.default_rng(0).uniform(0.2, 1.0, (seeds, len(X))), 0, 1)


def pixels(image, color):
    """How many have about that colour."""
    wanted = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return (np.abs(image[..., :3] - wanted).max(-1) < 0.01).sum()


def test_learning_curves_draw_every_method(tmp_path):
    curves = {"SGFT-SAC": (X, scores(5)), "SAC": (X, scores(5) / 2)}
    path = plot.learning_curves(
        tmp_path / "figures" / "curves.png", curves, title="Hammer", zero_shot=0.2, rollout_length=100, control_dt=0.05
    )
    image = matplotlib.image.imread(path)
    assert image.shape[:2] == (600, 1080)  # 7.2 x 4 inches at 150 dpi: readable at the width of a README
    for color in plot.PALETTE[:2]:
        assert pixels(image, color) > 200


def test_as_many_lines_as_methods_look_different():
    looks = [tuple(look.values()) for look in plot._looks(20)]
    assert len(set(looks)) == 20 and looks[0] == (plot.PALETTE[0], "-")
    assert all(color != plot.PALETTE[0] for color, _ in looks[1:])  # that of the method which a figure is about


def test_one_seed_draws_a_line_without_a_band(tmp_path):
    assert plot.learning_curves(tmp_path / "one.png", {"SAC": (X, scores(1))}, title="Push").exists()


def test_counts_have_ticks_at_whole_numbers_only():
    """Ticks at 2.5 rollouts were labelled 2, and those at 7.5 labelled 8."""
    _, (axes,) = plot._figure(7.2, 4.0, columns=1)
    axes.set_xlim(0, 20)
    plot._thousands(axes)
    ticks = axes.get_xticks()
    assert len(ticks) > 3 and (ticks == np.round(ticks)).all()


def test_scaling_draws_lines_and_their_references(tmp_path):
    lines = {"push": ([32, 512], [5e4, 9e4]), "insert": ([32, 512], [6e4, 2e5])}
    path = plot.scaling(tmp_path / "s.png", lines, {"push": ([32, 512], [1e5, 2e5])}, title="t", x="worlds", y="steps")
    image = matplotlib.image.imread(path)
    for color in plot.PALETTE[:2]:
        assert pixels(image, color) > 200


def test_landscape_does_not_search_a_place_for_its_legend(tmp_path, monkeypatch):
    """With so many lines that takes so long on a slow machine that matplotlib warns, by its clock."""
    monkeypatch.setattr("time.perf_counter", itertools.count(step=2).__next__)
    grid, path = np.linspace(0, 1, 5), np.linspace(0, 1, 8)[:, None] * [0.5, 0.8]
    imagined = np.broadcast_to(path[:-1, None, None], (7, 3, 2, 2))
    image = matplotlib.image.imread(
        plot.landscape(
            tmp_path / "l.png", grid, grid, np.outer(grid, grid), path, path + 0.1, imagined, title="t", axes=("x", "y")
        )
    )
    for color in (plot.PALETTE[1], plot.PALETTE[5]):
        assert pixels(image, color) > 200


@pytest.mark.parametrize("n", [1, 200])
def test_pretraining_panels(tmp_path, n):
    returns = np.linspace(0, 5, n)
    path = plot.pretraining(
        tmp_path / "pretraining.png",
        title="Pretraining",
        steps=np.arange(10) * 1e5,
        success=np.linspace(0, 1, 10),
        returns=np.linspace(0, 50, 10),
        value=returns,
        monte_carlo=returns,
        dynamics_error=[0.1, 0.2, 0.3],
        baseline_error=[0.2, 0.5, 0.9],
    )
    assert matplotlib.image.imread(path).shape[:2] == (480, 1800)


@pytest.mark.parametrize(
    ("values", "placed"),
    [
        ([0.1, 0.5, 0.9], [0.1, 0.5, 0.9]),  # room enough: nothing moves
        ([0.5, 0.5], [0.55, 0.45][::-1]),  # a pair parts around its mean
        ([0.5, 0.45, 0.9], [0.525, 0.425, 0.9]),  # mean 0.475 -+ 0.05, order kept
        ([1.0, 1.0, 1.0], [0.8, 0.9, 1.0]),  # the top is the top
        ([0.0, 0.0, 0.25], [0.0, 0.1, 0.25]),  # and the bottom the bottom, where tick labels stand
        ([0.0] * 12, np.linspace(-0.1, 1.0, 12)),  # but where there are too many
        ([0.3, 0.35, 0.42], [0.25667, 0.35667, 0.45667]),  # a crowd grows: mean 0.35667
    ],
)
def test_labels_part(values, placed):
    np.testing.assert_allclose(plot._spread(values, gap=0.1), placed, atol=1e-4)


@pytest.mark.parametrize(("minutes", "text"), [(1.66, "1.7 min"), (120.4, "120 min"), (1500, "1,500 min")])
def test_minutes(minutes, text):
    assert plot._minutes(minutes) == text


def test_a_method_keeps_its_colour_where_others_are_absent(tmp_path):
    order = ["SGFT-SAC", "IQL", "SAC"]
    path = plot.learning_curves(tmp_path / "one.png", {"SAC": (X, scores(3))}, title="Push", order=order)
    image = matplotlib.image.imread(path)
    assert pixels(image, plot.PALETTE[2]) > 200 and not pixels(image, plot.PALETTE[0])


@pytest.mark.parametrize(("tasks", "methods"), [(1, 2), (2, 3), (5, 14)])
def test_panels_share_a_legend(tmp_path, tasks, methods):
    """As wide for 14 methods as for 2; only the legend makes it higher."""
    names = [f"method-{i}" for i in range(methods)]
    path = plot.curve_panels(
        tmp_path / "panels.png",
        {f"task {i}": {name: (X, scores(3) / (2 + j)) for j, name in enumerate(names[i:])} for i in range(tasks)},
        title="All tasks",
        over={f"task {i}": "rollouts" for i in range(tasks)},
        order=[*names, "absent"],
        thick=names[:1],
    )
    image = matplotlib.image.imread(path)
    assert image.shape[1] == {1: 960, 2: 1170, 5: 1560}[tasks]
    assert all(pixels(image, color) > 100 for color in plot.PALETTE[: min(methods, 7)])
    assert (image[[0, -1]] > 0.99).all() and (image[:, [0, -1]] > 0.99).all()  # nothing is cut off at the border


def test_no_line_leads_past_a_gap_where_a_method_failed(tmp_path):
    """500, more than 900 and 500 transitions: two points and a triangle, without the line of 500, 500 and 500."""
    gaps, unknown = ["mild", "default", "hard"], [None] * 3

    def blue(middle):
        path = plot.severity(
            tmp_path / "severity.png", gaps, {"SAC": unknown}, {"SAC": [(500, True), middle, (500, True)]},
            title="Push", success="success", transitions="transitions", order=["SAC"],
        )  # fmt: skip
        return pixels(matplotlib.image.imread(path), plot.PALETTE[0])

    through, past, none = blue((500, True)), blue((900, False)), blue(None)
    assert past < through - 200 and none < past


def test_gaps_that_need_no_real_transition_are_drawn(tmp_path):
    """Without a warning about axes of no height."""
    path = plot.severity(
        tmp_path / "severity.png", ["mild", "hard"], {"SAC": [None] * 2}, {"SAC": [(0, True)] * 2},
        title="Push", success="success", transitions="transitions", order=["SAC"],
    )  # fmt: skip
    assert matplotlib.image.imread(path).shape[1] == 1170
