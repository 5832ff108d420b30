"""Impure: writes figures as PNG files: learning curves, what pretraining left behind, what a gap is.

Each function returns the path it wrote. No panel has more than `MOST` curves. A method has one colour in all figures,
see `COLOURS`; the first six are those of Okabe and Ito (safe for colour-blind readers).
"""

import colorsys
import itertools
import math
import textwrap
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter, MaxNLocator
from numpy.typing import ArrayLike

from sgft_jax.analysis import tables
from sgft_jax.analysis.curves import Curve, by_prior, spread
from sgft_jax.math.stats import ENOUGH, Interval, iqm

PALETTE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")
MOST = 6
_MORE = """
    #78b41e #5a0087 #4b3c00 #d2004b #b487ff #005a00 #ff9687 #780f00 #005ad2 #b40087 #c3b469 #5a1e4b #965a4b #966900
    #ff78e1 #00c35a #4bc3c3 #0f4b2d #875aa5 #007878 #87003c #0000ff #a5ff00 #ff00ff"""
_METHODS = """
    guarded sgft-sac sac mbpo tdmpc2 sgft-mpc sysid recurrent sgft-relabel h2oplus rebrac darc iql rlpd sgft-tdmpc2 sgft
    pbrs pbrs-branch sac-online sac-reset frozen-critic sgft-tdmpc2-code sgft-parts h2o h2oplus-edac cql edac
    posterior wsrl asymmetric"""
COLOURS: dict[str, str] = dict(zip(_METHODS.split(), (*PALETTE, *_MORE.split()), strict=True))  # all far apart


_INK, _GREY, _FAINT = "#333333", "#777777", "#B0B0B0"
_FONT = {"size": 10, "color": _INK}


@dataclass(frozen=True, eq=False)
class Panel:
    """One quantity over time.

    time: [N] seconds. lines: {name: [N]}; dotted: others of the same names. nan leaves a gap. held: whether a value
    stays until the next one.
    """

    name: str
    unit: str
    time: np.ndarray
    lines: Mapping[str, np.ndarray]
    dotted: Mapping[str, np.ndarray] = field(default_factory=dict)
    held: bool = False


def learning_curves(path: Path, panels: Mapping[str, Sequence[Curve]], *, title: str) -> Path:
    """Scores over real rollouts or over updates, a panel for each entry, by its words: IQM over members with its band.

    A panel with more than `MOST` curves becomes several; each shows the others in grey behind its own.
    """
    parts = [(entry, *part) for entry, curves in panels.items() if curves for part in _split(entry, curves)]
    columns = min(len(parts), 2)
    figure, grid = _figure(5.6 * columns, 3.1 * math.ceil(len(parts) / columns) + 0.4, columns, len(parts))
    drawn = [curve for _, _, curves, _ in parts for curve in curves]
    by_name = colours(drawn)
    first: dict[str, Axes] = {}  # of the panels of an entry, which have one y axis
    for axes, (entry, words, curves, others) in zip(grid, parts, strict=True):
        if first.setdefault(entry, axes) is not axes:
            axes.sharey(first[entry])
        for curve in others:
            axes.plot(curve.x, iqm(curve.values), color=_FAINT, linewidth=0.8, zorder=1)
        for curve in curves:
            _draw_curve(axes, curve, by_name[curve.name])
        _dress(axes, words, [*curves, *others])
        axes.set_xlabel(_unit(panels[entry]), **{**_FONT, "size": 9})
    figure.supxlabel(_note(drawn), size=8, color=_GREY)
    return _save(figure, path, title)


def _unit(curves: Sequence[Curve]) -> str:
    """What the x axis says."""
    longest = max(curves, key=lambda curve: curve.x[-1])
    if longest.unit == "updates":
        return "updates"
    if np.isnan(longest.minutes[-1]):  # of several tasks, whose rollouts differ in length
        return "real rollouts"
    count = max(int(longest.x[-1]), 1)
    seconds, steps = 60 * float(longest.minutes[-1]) / count, int(longest.transitions[-1]) // count
    if not np.array_equal(longest.transitions, steps * longest.x):  # evaluations have cost transitions, too
        return "real rollouts"
    return f"real rollouts of {steps} transitions, {seconds:.3g} s"


def _split(words: str, curves: Sequence[Curve]) -> list[tuple[str, Sequence[Curve], list[Curve]]]:
    """(words, curves, others in grey) of each panel: families together, at most `MOST` curves in each."""
    if len(curves) <= MOST:
        return [(words, curves, [])]
    ordered = sorted(curves, key=lambda curve: curve.family)
    count = math.ceil(len(curves) / MOST)
    parts = [[ordered[i] for i in indices] for indices in np.array_split(np.arange(len(ordered)), count)]
    return [
        (f"{words}, {i + 1} of {count}", part, [curve for other in parts if other is not part for curve in other])
        for i, part in enumerate(parts)
    ]


def colours(curves: Iterable[Curve]) -> dict[str, str]:
    """The colour of each name in one figure, no two the same: that of its method, `COLOURS`, or else a spare one.

    Spare are those of further variants of a method and of methods that do not come with the library.
    """
    chosen: dict[str, str] = {}
    spare = _spare()
    for method, name in sorted({(curve.method, curve.name) for curve in curves}):
        colour = COLOURS.get(method)
        chosen[name] = next(spare) if colour is None or colour in chosen.values() else colour
    return chosen


def _spare() -> Iterator[str]:
    """Colours without end, neighbours far apart: hues turn by the golden ratio."""
    for i in itertools.count():
        yield to_hex(colorsys.hls_to_rgb((0.88 + 0.618034 * i) % 1, (0.35, 0.5, 0.62)[i % 3], 0.6))


def _draw_curve(axes: Axes, curve: Curve, colour: str) -> None:
    band = spread(curve, curve.values)
    if np.isfinite(band.low).all():
        axes.fill_between(curve.x, band.low, band.high, color=colour, alpha=0.13, linewidth=0)
    marks = {"marker": "o", "markersize": 2.5} if len(curve.x) < 25 else {}
    axes.plot(curve.x, band.estimate, color=colour, linewidth=1.8, label=curve.name, clip_on=False, **marks)


def _dress(axes: Axes, words: str, curves: Sequence[Curve]) -> None:
    """Names, limits and a legend beside the panel, from the curve that ends highest to the one that ends lowest."""
    _name(axes, words)
    axes.set_xlim(0, max(int(curve.x[-1]) for curve in curves) or 1)
    axes.xaxis.set_major_locator(MaxNLocator(integer=True, nbins=6))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.set_ylabel(curves[0].score, **_FONT)
    if curves[0].score == "success":
        axes.set_ylim(-0.03, 1.03)
    named = [line for line in axes.get_lines() if not str(line.get_label()).startswith("_")]
    ordered = sorted(named, key=lambda line: float(np.asarray(line.get_ydata())[-1]))[::-1]
    _legend(axes, handles=ordered, fontsize=9, handlelength=1.4)


def _legend(axes: Axes, **look: Any) -> None:
    """A legend beside the panel."""
    axes.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False, labelcolor=_INK, **look)


def _note(curves: Sequence[Curve]) -> str:
    """What the curves and bands are."""
    sizes = sorted({len(curve.seeds) for curve in curves})
    if sizes[-1] == 1:
        return "one seed"
    seeds = str(sizes[0]) if len(sizes) == 1 else f"{sizes[0]} to {sizes[-1]}"
    drawn = "priors, then seeds" if all(map(by_prior, curves)) else "seeds"
    band = f"; band: 95 % bootstrap interval, drawing {drawn}" if sizes[-1] >= ENOUGH else ""
    return f"line: interquartile mean of {seeds} seeds{band}"


def pretraining(
    path: Path, curve: Sequence[ArrayLike], promises: Sequence[ArrayLike], errors: Sequence[ArrayLike], *, title: str
) -> Path:
    """Panels: success and return while training, V_sim against what happened, model error by horizon if there is one.

    curve: steps in the environment, success and return [n_evaluations]. promises: [n] V_sim of a state, and the
    discounted return that followed. errors: [horizon] mean normalised error of the model's open-loop prediction 1, 2,
    ... steps ahead, and the same for predicting that nothing changes; [0] where the model predicts no observations.
    """
    steps, *scores = map(np.asarray, curve)
    model, still = map(np.asarray, errors)
    columns = 4 if model.size else 3
    figure, panels = _figure(3.0 * columns, 3.2, columns)
    for axes, values, name in zip(panels, scores, ("success rate", "return"), strict=False):
        axes.plot(steps / 1e6, values, color=PALETTE[0], linewidth=2)
        _name(axes, name, "env steps (millions)")
        axes.set_xlim(left=0)
    panels[0].set_ylim(-0.03, 1.03)
    _value_panel(panels[2], *map(np.asarray, promises))
    if model.size:
        axes, horizon = panels[3], np.arange(1, len(model) + 1)
        axes.plot(horizon, model, color=PALETTE[0], linewidth=2, marker="o", markersize=3)
        axes.plot(horizon, still, color=_FAINT, linewidth=2)
        look: dict[str, Any] = {"textcoords": "offset points", "ha": "right", "size": 9, "color": _GREY}
        axes.annotate("if nothing moved", (len(model), float(still[-1])), (-14, 0), **look)
        axes.set_ylim(bottom=0)
        _name(axes, "model error, standard deviations", "steps ahead")
    return _save(figure, path, title)


def rollouts(path: Path, panels: Sequence[Panel], episodes: Mapping[str, float], *, title: str) -> Path:
    """Episodes over time, one after another: a panel for each quantity, all with one time axis.

    episodes: by words, the time in seconds at which each ends.
    """
    figure, drawn = _figure(9.6, 1.15 * len(panels) + 0.9, 1, len(panels))
    ends = list(episodes.values())
    for axes, panel in zip(drawn, panels, strict=True):
        style: dict[str, Any] = {"drawstyle": "steps-post"} if panel.held else {}
        for i, (name, values) in enumerate(panel.lines.items()):
            look = {"color": PALETTE[i % MOST], "linestyle": "-" if i < MOST else "--", **style}
            axes.plot(panel.time, values, linewidth=1.4, label=name, **look)
            if name in panel.dotted:
                axes.plot(panel.time, panel.dotted[name], linewidth=1.0, **{**look, "linestyle": ":"})
        for end in ends[:-1]:
            axes.axvline(end, color=_GREY, linewidth=1)
        _name(axes, panel.name)
        axes.set_ylabel(panel.unit, **{**_FONT, "size": 9})
        axes.set_xlim(0, ends[-1])
        axes.tick_params(labelbottom=axes is drawn[-1])
        if len(panel.lines) > 1:
            _legend(axes, fontsize=8, handlelength=1.2, ncols=1 + (len(panel.lines) - 1) // 6)
    for words, begin, end in zip(episodes, [0.0, *ends], ends, strict=False):
        middle = (begin + end) / 2, 1.2
        drawn[0].text(*middle, words, transform=drawn[0].get_xaxis_transform(), ha="center", size=9, color=_GREY)
    drawn[-1].set_xlabel("seconds", **_FONT)
    return _save(figure, path, title)


def effects(path: Path, intervals: Mapping[str, Mapping[str, Mapping[str, Interval]]], *, label: str) -> Path:
    """A panel for each place: every effect as a dot with its interval, one colour for each measure.

    intervals: by place, measure and name of the effect, as of `experiments.studies.factorial`. label: of the x-axis.
    """
    columns = min(len(intervals), 2)
    rows = math.ceil(len(intervals) / columns)
    figure, panels = _figure(5.2 * columns, 4.2 * rows + 0.2, columns, len(intervals))
    for axes, (place, measures) in zip(panels, intervals.items(), strict=True):
        for i, (measure, bands) in enumerate(measures.items()):
            heights = np.arange(len(bands)) + 0.22 * (i - (len(measures) - 1) / 2)
            estimate, low, high = (np.array([float(x) for x in bounds]) for bounds in zip(*bands.values(), strict=True))
            axes.hlines(heights, low, high, color=PALETTE[i], linewidth=1.5)
            axes.plot(estimate, heights, "o", color=PALETTE[i], markersize=4, label=measure)
        names = list(next(iter(measures.values())))
        axes.set_yticks(np.arange(len(names)), names)
        axes.invert_yaxis()
        axes.axvline(0.0, color=_GREY, linewidth=1)
        _name(axes, place, label)
    panels[0].legend(frameon=False, fontsize=8, labelcolor=_INK)
    return _save(figure, path, "effect of each part, mean over all others")


def shrinking(
    path: Path,
    after: Sequence[int],
    names: Sequence[str],
    intervals: np.ndarray,
    truth: np.ndarray | None,
    *,
    title: str,
) -> Path:
    """How intervals shrink around the truth: a panel for each unknown, a bar for each number of rollouts.

    intervals: [n, k, 2] `after` so many rollouts [n], the first before any. truth: [k], None where nobody knows it.
    """
    columns = min(len(names), 3)
    figure, panels = _figure(3.4 * columns, 1.6 * math.ceil(len(names) / columns) + 0.6, columns, len(names))
    heights = np.arange(len(intervals))
    for i, (axes, name) in enumerate(zip(panels, names, strict=True)):
        axes.hlines(heights, *intervals[:, i].T, color=[_FAINT, *[PALETTE[0]] * (len(heights) - 1)], linewidth=5)
        if truth is not None:
            axes.axvline(truth[i], color=PALETTE[1], linewidth=1.5)
        axes.set_yticks(heights, [tables.rollouts(n) for n in after])
        axes.set_ylim(len(heights) - 0.5, -0.5)
        axes.tick_params(labelleft=i % columns == 0)
        axes.locator_params(axis="x", nbins=5)
        _name(axes, name)
    return _save(figure, path, title)


def landscape(
    path: Path, x: np.ndarray, y: np.ndarray, values: np.ndarray, points: Mapping[str, np.ndarray], *, title: str
) -> Path:
    """A value [y, x] over places in m, and points [n, 2] by what they are."""
    figure, (axes,) = _figure(7.0, 5.4, 1)
    axes.grid(visible=False)
    mesh = axes.pcolormesh(x, y, values, cmap="Greens", shading="gouraud", zorder=-1)
    figure.colorbar(mesh, ax=axes, shrink=0.8).outline.set_visible(False)
    for (name, places), colour in zip(points.items(), (PALETTE[1], PALETTE[0], _INK), strict=False):
        axes.plot(*places.T, "o", color=colour, markersize=6 if len(places) == 1 else 4, label=name, clip_on=True)
    axes.set(xlim=(x[0], x[-1]), ylim=(y[0], y[-1]), aspect="equal", ylabel="y, m")
    _name(axes, "", "x, m")
    axes.legend(frameon=True, fontsize=9, labelcolor=_INK)
    return _save(figure, path, title)


def _name(axes: Axes, title: str, x: str = "") -> None:
    """What a panel shows, and what its x axis is."""
    axes.set_title(title, **_FONT, loc="left")
    axes.set_xlabel(x, **_FONT)


def _value_panel(axes: Axes, value: np.ndarray, monte_carlo: np.ndarray) -> None:
    both = np.concatenate([value, monte_carlo])
    margin = 0.05 * (np.ptp(both) or 1.0)
    limits = (both.min() - margin, both.max() + margin)
    axes.plot(limits, limits, color=_FAINT, linewidth=1, zorder=0)
    axes.scatter(monte_carlo, value, s=6, color=PALETTE[0], alpha=min(1.0, 60 / len(value) ** 0.75), linewidths=0)
    axes.set(xlim=limits, ylim=limits)
    _name(axes, "V_sim against discounted return", "return that followed")
    bias, error = float((value - monte_carlo).mean()), float(np.sqrt(((value - monte_carlo) ** 2).mean()))
    axes.text(0.04, 0.95, f"bias {bias:+.2g}\nRMSE {error:.2g}", transform=axes.transAxes, va="top", size=9, color=_INK)


# ---------------------------------------------------------------- the look


def _figure(width: float, height: float, columns: int, count: int | None = None) -> tuple[Figure, Sequence[Axes]]:
    """A figure without pyplot (no global state, no window), axes without frame. count: of panels; default one row."""
    figure = Figure(figsize=(width, height), dpi=120, layout="constrained")
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


def _save(figure: Figure, path: Path, title: str) -> Path:
    """With its title, in as many lines as the width needs."""
    letters = int(9 * figure.get_figwidth())  # of this size that fit, nine an inch
    figure.suptitle(textwrap.fill(title, letters), x=0.01, ha="left", size=12, weight="bold", color=_INK)
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, facecolor="white")
    return path
