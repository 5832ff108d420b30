"""Impure: writes figures as PNG files: learning curves, what pretraining left behind, how costs grow.

Functions take plain arrays and return the path they wrote. Colours are the Okabe-Ito palette (safe for colour-blind
readers), from the eighth line on dashed, then dotted; the first line shares its colour with none. A method keeps its
colour from figure to figure as long as the order of the methods stays (`order`, where a figure shows some of them).
"""

import itertools
import math
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter, LogLocator, MaxNLocator
from numpy.typing import ArrayLike

from sgft_jax.analysis.stats import iqm_interval

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
_DASHES = ("-", (0, (5, 1.5)), (0, (1.2, 1.2)), (0, (5, 1.2, 1.2, 1.2)))  # (0, (drawn, left out)) in widths of the line
_INK, _GREY, _FAINT = "#333333", "#777777", "#B0B0B0"
_FONT = {"size": 10, "color": _INK}
_THIN, _THICK = 1.4, 2.4  # where one legend serves many lines


def learning_curves(
    path: Path,
    curves: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    title: str,
    zero_shot: float | None = None,
    rollout_length: int | None = None,
    control_dt: float | None = None,
    quantity: str = "success rate",
    over: str = "real transitions",
    order: Sequence[str] | None = None,
) -> Path:
    """Success against real transitions, one line per method: IQM over seeds with its 95 % bootstrap band.

    curves: {method: (transitions [n_evaluations], success [n_seeds, n_evaluations])}. zero_shot: success of the policy
    before fine-tuning, drawn dashed. rollout_length (steps) and control_dt (s) add an axis on top in rollouts and
    minutes of robot time. quantity, over: names of the axes; what takes success's place is from 0 to 1, too. order: of
    all methods, these and those of other figures, which decides colours; default: that of curves.
    """
    figure, (axes,) = _figure(7.2, 4.0, columns=1)
    ends, looks = [], _looks_of(order or list(curves))
    for name, (transitions, success) in curves.items():
        style = {**looks[name], "linewidth": 2, "marker": "o", "markersize": 3}
        last = _draw_curve(axes, np.asarray(transitions), success, style, shade=_shade(len(curves)))
        ends.append((float(np.asarray(transitions)[-1]), last, name, looks[name]["color"]))
    if zero_shot is not None:
        axes.axhline(zero_shot, color=_INK, linewidth=1.2, linestyle=(0, (4, 3)), zorder=1.5)
        ends.append((max(x for x, *_ in ends), zero_shot, "zero-shot", _INK))
    axes.set_xlim(0, max(x for x, *_ in ends))
    axes.set_ylim(-0.03, 1.03)
    axes.set_xlabel(over, **_FONT)
    axes.set_ylabel(quantity, **_FONT)
    _label_ends(axes, ends)
    _thousands(axes)
    if rollout_length is not None and control_dt is not None:
        _robot_axis(axes, rollout_length, control_dt)
    figure.suptitle(title, x=0.01, ha="left", size=12, weight="bold", color=_INK)
    figure.text(0.99, 0.012, _seeds_note([s for _, s in curves.values()]), ha="right", size=8, color=_GREY)
    return _save(figure, path)


def curve_panels(
    path: Path,
    panels: Mapping[str, Mapping[str, tuple[ArrayLike, ArrayLike]]],
    *,
    title: str,
    over: Mapping[str, str],
    order: Sequence[str],
    thick: Collection[str] = (),
) -> Path:
    """Learning curves of several tasks next to each other, with one legend: IQM over seeds, 95 % bootstrap band.

    panels: {task: curves as those of `learning_curves`}. over: name of each panel's x axis. order: as there, and of the
    legend. thick: methods that stand out, drawn last and with stronger bands.
    """
    width, columns = _grid(len(panels))
    figure, grid = _figure(width, 2.7 * math.ceil(len(panels) / columns), columns=columns, count=len(panels))
    looks = _looks_of(order)
    for axes, (task, curves) in zip(grid, panels.items(), strict=True):
        for name in sorted(curves, key=lambda name: name in thick):
            x, success = curves[name]
            shade = 0.18 if name in thick else _shade(len(curves))
            style = {**looks[name], "linewidth": _THICK if name in thick else _THIN}
            _draw_curve(axes, np.asarray(x), success, style, shade=shade)
        axes.set_title(task, **_FONT, loc="left")
        axes.set_xlim(0, max(float(np.asarray(x)[-1]) for x, _ in curves.values()))
        axes.set_ylim(-0.03, 1.03)
        axes.set_xlabel(over[task], **{**_FONT, "size": 9})
        _thousands(axes)
    for axes in grid[::columns]:
        axes.set_ylabel("success rate", **_FONT)
    shown = {name for curves in panels.values() for name in curves}
    note = _seeds_note([success for curves in panels.values() for _, success in curves.values()])
    _legend_below(figure, {name: looks[name] for name in order if name in shown}, thick, note)
    figure.suptitle(title, x=0.01, ha="left", size=12, weight="bold", color=_INK)
    return _save(figure, path)


def severity(
    path: Path,
    gaps: Sequence[str],
    scores: Mapping[str, Sequence[ArrayLike | None]],
    needed: Mapping[str, Sequence[tuple[int, bool] | None]],
    *,
    title: str,
    success: str,
    transitions: str,
    order: Sequence[str],
    thick: Collection[str] = (),
) -> Path:
    """Methods on gaps that get harder: success, IQM over seeds with its 95 % interval, and what it took to get there.

    scores: {method: success [n_seeds] on each gap}. needed: {method: real transitions on each gap, and whether they
    were enough}, an open triangle where not. None where there is no run. success, transitions: names of the two axes.
    order, thick: as for `curve_panels`.
    """
    figure, (left, right) = _figure(7.8, 3.2, columns=2)
    looks, shift = _looks_of(order), _shifts(len(scores))
    for (name, each), dx in zip(scores.items(), shift, strict=True):
        look, weight = looks[name], _THICK if name in thick else _THIN
        bands = [None if score is None else iqm_interval(score) for score in each]
        x = np.arange(len(gaps)) + dx
        height = np.array([np.nan if band is None else float(band.estimate) for band in bands])
        for at, band in zip(x, bands, strict=True):
            if band is not None and np.isfinite(band.low):
                left.plot([at, at], [band.low, band.high], color=look["color"], linewidth=weight / 2)
        left.plot(x, height, **look, linewidth=weight, marker="o", markersize=4, clip_on=False)
        counts = np.array([np.nan if point is None else point[0] for point in needed[name]])
        enough = np.array([point is not None and point[1] for point in needed[name]])
        # nan, not left out: no line may lead past a gap where the method did not get there.
        right.plot(x, np.where(enough, counts, np.nan), **look, linewidth=weight, marker="o", markersize=4)
        right.plot(x[~enough], counts[~enough], color=look["color"], marker="^", mfc="white", linestyle="")
    left.set_ylim(-0.03, 1.03)
    right.set_ylim(0, 1.05 * right.dataLim.y1 or 1.0)  # 0 if all are there zero-shot
    right.yaxis.set_major_formatter(lambda n, _: f"{n:,.0f}")
    for axes, words in ((left, success), (right, transitions)):
        axes.set_xlim(-0.5, len(gaps) - 0.5)
        axes.set_xticks(range(len(gaps)), gaps)
        axes.set_title(words, **_FONT, loc="left")
    note = _seeds_note([score for each in scores.values() for score in each if score is not None], "interval")
    note = "; ".join(filter(None, [note, "triangle: so many were not enough"]))
    _legend_below(figure, {name: looks[name] for name in order if name in scores}, thick, note)
    figure.suptitle(title, x=0.01, ha="left", size=12, weight="bold", color=_INK)
    return _save(figure, path)


def scaling(
    path: Path,
    lines: Mapping[str, tuple[ArrayLike, ArrayLike]],
    references: Mapping[str, tuple[ArrayLike, ArrayLike]],
    *,
    title: str,
    x: str,
    y: str,
) -> Path:
    """How a quantity grows with a size, both on logarithmic axes.

    lines: {name: (sizes [n], values [n])}. references: the same for some of these names, drawn dashed in their colour.
    """
    figure, (axes,) = _figure(6.4, 4.0, columns=1)
    for (name, points), look in zip(lines.items(), _looks(len(lines)), strict=True):
        axes.plot(*map(np.asarray, points), **look, linewidth=2, marker="o", markersize=4, label=name)
        if name in references:
            axes.plot(*map(np.asarray, references[name]), color=look["color"], linewidth=1.2, linestyle=(0, (4, 3)))
    axes.set_xscale("log", base=2)
    axes.set_yscale("log")
    sizes = sorted({float(size) for points in lines.values() for size in np.asarray(points[0])})
    axes.set_xticks(sizes, [f"{size:,.0f}" for size in sizes])
    axes.minorticks_off()
    low, high = axes.get_ylim()
    steps = (1, 2, 5) if high < 30 * low else (1,)  # a single decade would have one tick, or none
    axes.yaxis.set_major_locator(LogLocator(subs=steps))
    axes.yaxis.set_major_formatter(EngFormatter(sep=" "))
    axes.set_xlabel(x, **_FONT)
    axes.set_ylabel(y, **_FONT)
    axes.legend(frameon=False, fontsize=9, labelcolor=_INK)
    figure.suptitle(title, x=0.01, ha="left", size=12, weight="bold", color=_INK)
    if references:
        figure.text(0.99, 0.012, "dashed: the reference", ha="right", size=8, color=_GREY)
    return _save(figure, path)


def pretraining(
    path: Path,
    *,
    title: str,
    steps: ArrayLike,
    success: ArrayLike,
    returns: ArrayLike,
    value: ArrayLike,
    monte_carlo: ArrayLike,
    dynamics_error: ArrayLike,
    baseline_error: ArrayLike | None = None,
) -> Path:
    """Panels: success and return while training, V_sim against what happened, model error by horizon if there is one.

    steps, success, returns: [n_evaluations], steps in env steps. value, monte_carlo: [n] V_sim of a state and the
    discounted return that followed. dynamics_error: [horizon] mean normalised error of the model's open-loop prediction
    1, 2, ... steps ahead; baseline_error: the same for predicting that nothing changes.
    """
    columns = 4 if np.size(dynamics_error) else 3
    figure, panels = _figure(3.0 * columns, 3.2, columns=columns)
    for axes, values, name in zip(panels, (success, returns), ("success rate", "return"), strict=False):
        axes.plot(np.asarray(steps) / 1e6, np.asarray(values), color=PALETTE[0], linewidth=2)
        axes.set_title(name, **_FONT, loc="left")
        axes.set_xlabel("env steps (millions)", **_FONT)
        axes.set_xlim(left=0)
    panels[0].set_ylim(-0.03, 1.03)
    _value_panel(panels[2], np.asarray(value), np.asarray(monte_carlo))
    if columns == 4:
        _dynamics_panel(panels[3], np.asarray(dynamics_error), baseline_error)
    figure.suptitle(title, x=0.005, ha="left", size=12, weight="bold", color=_INK)
    return _save(figure, path)


def landscape(
    path: Path,
    x: ArrayLike,
    y: ArrayLike,
    value: ArrayLike,
    real: ArrayLike,
    simulated: ArrayLike,
    imagined: ArrayLike,
    *,
    title: str,
    axes: tuple[str, str],
) -> Path:
    """A value function over a plane, a real and a simulated path in it, and the branches imagined along the real one.

    x, y: [G] increasing; value: [G, G], rows along y. real, simulated: [T + 1, 2]. imagined: [T, branches, H + 1, 2].
    axes: the words at the two axes.
    """
    figure, (panel,) = _figure(6.0, 5.0, columns=1)
    across, up, heights = np.asarray(x), np.asarray(y), np.asarray(value)
    least = float(np.percentile(heights, 35))  # a cliff at the edge of a table would take all the colours
    mesh = panel.pcolormesh(across, up, heights, cmap="cividis", shading="gouraud", vmin=least)
    figure.colorbar(mesh, ax=panel, label="V_sim", extend="min")
    branches = np.asarray(imagined)
    for i, one in enumerate(branches.reshape(-1, *branches.shape[2:])):
        panel.plot(*one.T, color="white", linewidth=0.5, alpha=0.7, label=None if i else "imagined")
    for path_, name, color in ((simulated, "simulated", PALETTE[5]), (real, "real", PALETTE[1])):
        places = np.asarray(path_)
        panel.plot(*places.T, color=color, linewidth=2, marker="o", markersize=3, label=name)
    panel.plot(
        *np.asarray(real)[0], color="white", markeredgecolor=_INK, marker="o", markersize=7, linestyle="", label="start"
    )
    panel.grid(visible=False)
    panel.set_aspect("equal")
    panel.set_xlim(across[0], across[-1])
    panel.set_ylim(up[0], up[-1])
    panel.set_xlabel(axes[0], **_FONT)
    panel.set_ylabel(axes[1], **_FONT)
    # Beside the drawing, for paths may lead anywhere, and dark, for the branches are white.
    figure.legend(
        *panel.get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8, frameon=True,
        facecolor=mesh.cmap(0.0), framealpha=1, labelcolor="white", edgecolor="none",
    )  # fmt: skip
    figure.suptitle(title, x=0.01, ha="left", size=11, weight="bold", color=_INK)
    return _save(figure, path)


def _value_panel(axes: Axes, value: np.ndarray, monte_carlo: np.ndarray) -> None:
    both = np.concatenate([value, monte_carlo])
    margin = 0.05 * (np.ptp(both) or 1.0)
    limits = (both.min() - margin, both.max() + margin)
    axes.plot(limits, limits, color=_FAINT, linewidth=1, zorder=0)
    axes.scatter(monte_carlo, value, s=6, color=PALETTE[0], alpha=min(1.0, 60 / len(value) ** 0.75), linewidths=0)
    axes.set_xlim(*limits)
    axes.set_ylim(*limits)
    axes.set_title("V_sim against discounted return", **_FONT, loc="left")
    axes.set_xlabel("return that followed", **_FONT)
    bias, error = float((value - monte_carlo).mean()), float(np.sqrt(((value - monte_carlo) ** 2).mean()))
    axes.text(0.04, 0.95, f"bias {bias:+.2g}\nRMSE {error:.2g}", transform=axes.transAxes, va="top", size=9, color=_INK)


def _dynamics_panel(axes: Axes, error: np.ndarray, baseline: ArrayLike | None) -> None:
    horizon = np.arange(1, len(error) + 1)
    axes.plot(horizon, error, color=PALETTE[0], linewidth=2, marker="o", markersize=3)
    if baseline is not None:
        axes.plot(horizon, np.asarray(baseline), color=_FAINT, linewidth=2)
        end = (len(error), float(np.asarray(baseline)[-1]))
        axes.annotate("if nothing moved", end, (-14, 0), textcoords="offset points", ha="right", size=9, color=_GREY)
    axes.set_ylim(bottom=0)
    axes.set_title("model error, standard deviations", **_FONT, loc="left")
    axes.set_xlabel("steps ahead", **_FONT)


# ---------------------------------------------------------------- the look


def _figure(width: float, height: float, *, columns: int, count: int | None = None) -> tuple[Figure, Sequence[Axes]]:
    """A figure without pyplot (no global state, no window), axes without frame. count: of panels; default one row."""
    figure = Figure(figsize=(width, height), dpi=150, layout="constrained")
    FigureCanvasAgg(figure)
    count = count or columns
    panels = [figure.add_subplot(math.ceil(count / columns), columns, i + 1) for i in range(count)]
    for axes in panels:
        axes.spines[["top", "right"]].set_visible(False)
        axes.spines[["left", "bottom"]].set_color(_FAINT)
        axes.tick_params(colors=_INK, labelsize=9, color=_FAINT)
        axes.grid(axis="y", color="#ECECEC", linewidth=0.8)
        axes.set_axisbelow(True)
    return figure, panels


def _save(figure: Figure, path: Path) -> Path:
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, facecolor="white")
    return path


def _draw_curve(axes: Axes, x: np.ndarray, success: ArrayLike, style: Mapping[str, Any], *, shade: float) -> float:
    """IQM over seeds [n_seeds, n] with its band, so opaque; style: of the line. Returns where the line ends."""
    band = iqm_interval(success)
    if np.isfinite(band.low).all():
        axes.fill_between(x, band.low, band.high, color=style["color"], alpha=shade, linewidth=0)
    axes.plot(x, band.estimate, **style, clip_on=False)
    return float(band.estimate[-1])


def _shade(curves: int) -> float:
    """How opaque the bands of so many curves are: all of them together must not hide the lines."""
    return 0.18 if curves <= len(PALETTE) else 0.06


def _seeds_note(successes: Sequence[ArrayLike], what: str = "band") -> str:
    """What the lines and bands of these results [n_seeds, ...] are."""
    seeds = sorted({np.asarray(success).shape[0] for success in successes})
    if not seeds:
        return ""
    counts = str(seeds[0]) if len(seeds) == 1 else f"{seeds[0]} to {seeds[-1]}"
    several = seeds[-1] > 1
    return f"interquartile mean of {counts} seed{'s' * several}" + f", 95 % bootstrap {what}" * several


def _looks(count: int) -> list[dict[str, Any]]:
    """Colour and dashes of so many lines, all different; the first, which a figure is about, has a colour to itself."""
    first, *others = PALETTE
    laps = itertools.cycle((color, dash) for dash in _DASHES for color in others)
    looks = itertools.islice(itertools.chain([(first, _DASHES[0])], laps), count)
    return [{"color": color, "linestyle": dash} for color, dash in looks]


def _looks_of(order: Sequence[str]) -> dict[str, dict[str, Any]]:
    return dict(zip(order, _looks(len(order)), strict=True))


def _label_ends(axes: Axes, ends: Sequence[tuple[float, float, str, str]]) -> None:
    """Write each line's name to the right of its end, moved apart vertically where ends are close.

    A line that ends early gets no leader, which would look like a part of it.
    """
    heights, border = _spread([y for _, y, *_ in ends], gap=0.06), max(x for x, *_ in ends)
    for (x, y, name, color), height in zip(ends, heights, strict=True):
        leader = {"arrowstyle": "-", "color": color, "linewidth": 0.8, "shrinkA": 2, "relpos": (0, 0.5)}
        axes.annotate(
            name,
            (x, y),
            xytext=(1.03, height),
            textcoords=axes.get_yaxis_transform(),
            arrowprops=leader if abs(height - y) > 0.01 and x == border else None,
            color=color,
            size=10,
            va="center",
            annotation_clip=False,
        )


def _grid(count: int) -> tuple[float, int]:
    """Width (inches) of a figure of so many panels, and in how many columns they stand: three at most."""
    columns = min(count, 2 if count == 4 else 3)
    return {1: 6.4, 2: 7.8, 3: 10.4}[columns], columns


def _shifts(count: int) -> np.ndarray:
    """How far to the side each of so many points at one place goes, so that they do not hide one another."""
    return np.linspace(-0.5, 0.5, count) * min(0.6, 0.12 * (count - 1)) if count > 1 else np.zeros(1)


def _legend_below(figure: Figure, looks: Mapping[str, Mapping[str, Any]], thick: Collection[str], note: str) -> None:
    """One legend for all panels, row by row in the order of the looks, under a note; the figure grows by its height."""
    width, height = figure.get_size_inches()
    columns = max(1, min(len(looks), int(width / (0.085 * max(map(len, looks)) + 0.65))))
    figure.set_size_inches(width, height + 0.2 * math.ceil(len(looks) / columns) + 0.3)
    names = [name for i in range(columns) for name in list(looks)[i::columns]]  # matplotlib fills column by column
    lines = [Line2D([], [], **looks[name], linewidth=_THICK if name in thick else _THIN) for name in names]
    legend = figure.legend(
        lines, names, loc="outside lower center", ncols=columns, frameon=False, fontsize=9, labelcolor=_INK,
        handlelength=3, title=note, title_fontproperties={"size": 8},
    )  # fmt: skip
    legend.get_title().set_color(_GREY)


def _spread(values: Sequence[float], *, gap: float, bottom: float = 0.0, top: float = 1.0) -> list[float]:
    """The values moved at least `gap` apart and between `bottom` and `top`, below `bottom` if there is no room.

    A crowd stays centred on its mean where it can.
    """
    order = np.argsort(values, kind="stable")
    crowds: list[list[float]] = []
    for value in np.asarray(values, np.float64)[order]:
        crowds.append([float(value)])
        while len(crowds) > 1 and _bottom(crowds[-1], gap) - _top(crowds[-2], gap) < gap:
            crowds[-2:] = [crowds[-2] + crowds[-1]]
    placed = np.concatenate([_bottom(crowd, gap) + gap * np.arange(len(crowd)) for crowd in crowds])
    steps = gap * np.arange(len(placed))
    placed = np.maximum.accumulate(np.maximum(placed, bottom) - steps) + steps  # up from the bottom
    placed = np.minimum.accumulate((np.minimum(placed, top) - steps)[::-1])[::-1] + steps  # then down from the top
    result = np.empty_like(placed)
    result[order] = placed
    return result.tolist()


def _bottom(crowd: list[float], gap: float) -> float:
    return sum(crowd) / len(crowd) - gap * (len(crowd) - 1) / 2


def _top(crowd: list[float], gap: float) -> float:
    return sum(crowd) / len(crowd) + gap * (len(crowd) - 1) / 2


def _thousands(axes: Axes) -> None:
    """Counts along x: ticks at whole numbers, which no rounding of their labels moves."""
    axes.xaxis.set_major_locator(MaxNLocator(integer=True))
    axes.xaxis.set_major_formatter(lambda x, _: f"{x:,.0f}")


def _robot_axis(axes: Axes, rollout_length: int, control_dt: float) -> None:
    """A second x axis on top: rollouts, with the minutes of robot time they take."""

    def rollouts(n: ArrayLike) -> ArrayLike:
        return np.asarray(n) / rollout_length

    def transitions(n: ArrayLike) -> ArrayLike:
        return np.asarray(n) * rollout_length

    top = axes.secondary_xaxis("top", functions=(rollouts, transitions))
    minutes = rollout_length * control_dt / 60
    top.xaxis.set_major_locator(MaxNLocator(nbins=6, integer=True))  # labels of two lines, the lower ones long
    top.xaxis.set_major_formatter(lambda r, _: f"{r:,.0f}\n{_minutes(r * minutes)}" if r else "0")
    top.set_xlabel("rollouts, robot time", **_FONT)
    top.tick_params(colors=_INK, labelsize=9, color=_FAINT)
    top.spines["top"].set_color(_FAINT)


def _minutes(minutes: float) -> str:
    return f"{minutes:,.0f} min" if minutes >= 10 else f"{minutes:.1f} min"
