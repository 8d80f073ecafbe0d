"""Draw the cost curve of a pixel: the costs of its neighbours, and below them the result of semi-global matching."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context, rcParamsDefault
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.cost_curve import CostCurve
from pano_mvs.io.images.preview import scale_ticks
from pano_mvs.session.inspection import Inspection

# In pixels: the image's width and margins, and the panels and the gap between them, from which its height follows.
_WIDTH, _LEFT, _RIGHT = 1040, 78, 1016
_TOP, _PANEL, _GAP, _AXIS, _LEGEND_ROW = 106, 300, 46, 64, 22
_DPI = 100
_INK, _FAINT = "#2d2d32", "#787880"
_DECISIVE, _RAW = "#1660a7", "#5a6473"
_SOURCES = ("#e2a05a", "#78b478", "#be8cbe", "#78bec8", "#d68c8c")
_WINNER, _RIVAL, _TRUTH = "#c83232", "#d2821e", "#148250"
_STYLE: Any = {  # matplotlib's type of the keys depends on its version
    "font.size": 9,
    "lines.linewidth": 1.6,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "axes.titlecolor": _FAINT,
    "axes.labelcolor": _FAINT,
    "axes.edgecolor": _FAINT,
    "axes.spines.left": False,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "grid.color": "#e8e8ec",
    "xtick.color": _FAINT,
    "ytick.color": _FAINT,
    "ytick.left": False,
}
_LEGEND_COLUMNS = 5
_TAG_WIDTH = 0.18  # largest width of the text at a mark, as a share of a panel


def write_curve_picture(path: Path, inspection: Inspection) -> None:
    """Write a PNG of a pixel's cost curve, with the winner, the runner-up and, if it is known, the true range."""
    curve = inspection.curve
    panels = [("cost before the decision, as a share of the largest possible", curve.raw)]
    if curve.aggregated is not None:
        panels.append(("after semi-global matching: mean cost of the eight paths", curve.aggregated))
    below = _AXIS + _LEGEND_ROW * math.ceil((len(inspection.sources) + 1) / _LEGEND_COLUMNS)
    height = _TOP + len(panels) * (_PANEL + _GAP) - _GAP + below
    with rc_context(rcParamsDefault), rc_context(_STYLE):  # without the user's own style
        figure = Figure((_WIDTH / _DPI, height / _DPI), dpi=_DPI)
        _add_title(figure, inspection, height)
        for idx, (title, costs) in enumerate(panels):
            bottom = below + (len(panels) - 1 - idx) * (_PANEL + _GAP)
            box = (_LEFT / _WIDTH, bottom / height, (_RIGHT - _LEFT) / _WIDTH, _PANEL / height)
            axes = figure.add_axes(box, title=title)
            if idx == 0:
                for source, source_costs in enumerate(curve.by_source):
                    axes.plot(source_costs, color=_SOURCES[source % len(_SOURCES)], linewidth=0.8)
            is_last = idx == len(panels) - 1
            axes.plot(costs, color=_DECISIVE if is_last else _RAW)
            drawn = np.concatenate([np.asarray(line.get_ydata(), np.float64) for line in axes.lines])
            highest = float(np.nanmax(drawn[~np.isinf(drawn)]))
            axes.set(xlim=(0, len(curve.ranges) - 1), ylim=(0, 1.1 * max(highest, 0.02)))
            axes.yaxis.set_major_formatter("{x:.2f}")
            values = scale_ticks(float(curve.ranges[0]), float(curve.ranges[-1]))
            places = [_place_of(value, curve.ranges) for value in values]
            labels, taken = [], -np.inf
            for value, place in zip(values, places, strict=True):
                x = place / (len(curve.ranges) - 1) * (_RIGHT - _LEFT)
                is_shown = is_last and x - taken > 44
                labels.append(f"{value:g}" if is_shown else "")
                taken = x if is_shown else taken
            axes.set_xticks(places, labels)
            if is_last:
                axes.set_xlabel("depth hypothesis, scene units")
            _add_marks(axes, inspection, costs)
        _add_legend(figure, inspection)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, format="png", metadata={"Software": None})  # whose version would change the bytes


def _add_marks(axes: Axes, inspection: Inspection, costs: NDArray[np.float64]) -> None:
    """Mark the winner, the next valley and the true range."""
    curve, truth = inspection.curve, inspection.true_range
    if np.isfinite(truth):
        place = _place_of(truth, curve.ranges)
        axes.axvline(place, color=_TRUTH, linewidth=1, dashes=(6, 6))
        _add_tag(axes, f"truth {truth:.4g}", (place, axes.get_ylim()[1]), color=_TRUTH, other=place)
    rival = curve.winner if curve.runner_up is None else curve.runner_up
    if curve.runner_up is not None:
        axes.plot(rival, costs[rival], "o", ms=8, mew=1.6, color=_RIVAL, markerfacecolor="white", clip_on=False)
        text = f"next valley {curve.ranges[rival]:.4g}"
        _add_tag(axes, text, (rival, costs[rival]), color=_RIVAL, other=curve.winner)
    winner = curve.winner, costs[curve.winner]
    axes.plot(*winner, "o", ms=9, color=_WINNER, markeredgecolor="white", clip_on=False)
    shown = curve.range if np.isfinite(curve.range) else curve.ranges[curve.winner]
    _add_tag(axes, f"winner {shown:.4g}", winner, color=_WINNER, other=rival)


def _add_tag(axes: Axes, text: str, place: tuple[float, float], *, color: str, other: float) -> None:
    """Label a mark on the side away from a nearby mark, below it, or above it at the bottom of the plot."""
    count, highest = axes.get_xlim()[1], axes.get_ylim()[1]
    x, y, other = place[0] / count, place[1] / highest, other / count
    leftwards = x > 0.75 or (x < other < x + 2 * _TAG_WIDTH and x > _TAG_WIDTH)
    axes.annotate(
        text,
        place,
        (-12 if leftwards else 12, -14 if y > 0.08 else 14),
        textcoords="offset pixels",
        ha="right" if leftwards else "left",
        va="center",
        color=color,
        bbox={"facecolor": "white", "edgecolor": "none", "pad": 1},
    )


def _place_of(value: float, ranges: NDArray[np.float64]) -> float:
    """Return the position of a range among the hypotheses, clamped to both ends."""
    return float(np.interp(value, ranges, np.arange(len(ranges))))


def _add_title(figure: Figure, found: Inspection, height: int) -> None:
    settings, curve = found.settings, found.curve
    title = _drawable(f"{found.image}, pixel ({found.column}, {found.row})")
    figure.text(24 / _WIDTH, 1 - 34 / height, title, color=_INK, fontsize=13, parse_math=False)
    sure = f"confidence {curve.confidence}" if curve.confidence else "no range"
    details = (
        f"{found.sweep}: {settings.cost}, window {settings.window}, {settings.combination}, {settings.aggregation}, "
        f"{settings.planes} planes ({settings.spacing}); {sure}, unique by {100 * curve.uniqueness:.0f} %"
    )
    figure.text(24 / _WIDTH, 1 - 62 / height, _drawable(details), color=_FAINT, parse_math=False)


def _add_legend(figure: Figure, found: Inspection) -> None:
    names = [source.name.rsplit("/", 1)[-1] for source in found.sources]
    lines = figure.axes[0].lines[: len(names) + 1]
    place = (_LEFT / _WIDTH, 0)
    legend = figure.legend(
        lines, ["…"] * len(lines), loc="lower left", bbox_to_anchor=place, ncols=_LEGEND_COLUMNS, frameon=False
    )  # as labels, names that begin with _ would be left out
    for text, name in zip(legend.get_texts(), [*names, f"combined ({found.settings.combination})"], strict=True):
        text.set(text=_drawable(name), parse_math=False, color=_INK)


def _drawable(text: str) -> str:
    """Return a text with ? instead of characters that the font may lack."""
    return "".join(letter if letter.isprintable() and letter <= "ÿ" else "?" for letter in text)


_ROWS = 8
_MARGIN = 6
# Eighths of a character if the terminal supports them, otherwise whole characters.
_EIGHTHS, _WHOLE = " ▁▂▃▄▅▆▇█", " #"
_SIGNS = {"winner": "▲", "next valley": "△", "truth": "◆"}
_PLAIN_SIGNS = {"winner": "^", "next valley": "o", "truth": "T"}


def curve_text(curve: CostCurve, *, true_range: float = np.nan, width: int = 100, plain: bool = False) -> list[str]:
    """Return the lines of a plot with a bar for the cost of each depth hypothesis, near on the left.

    Costs after semi-global matching are drawn below the original costs. If there are more ranges than columns,
    a bar shows the minimum of several ranges.
    """
    group = -(-len(curve.ranges) // max(8, width - _MARGIN))
    signs, steps = (_PLAIN_SIGNS, _WHOLE) if plain else (_SIGNS, _EIGHTHS)
    lines = ["cost, combined from the neighbours:", *_plot(curve.raw, group, steps)]
    if curve.aggregated is not None:
        lines += ["after semi-global matching:", *_plot(curve.aggregated, group, steps)]
    marks = {"winner": curve.winner}
    if curve.runner_up is not None:
        marks["next valley"] = curve.runner_up
    if np.isfinite(true_range):
        marks["truth"] = int(np.abs(np.log(curve.ranges / true_range)).argmin())
    bars = -(-len(curve.ranges) // group)
    row = [" "] * bars
    for name in reversed(list(marks)):
        row[marks[name] // group] = signs[name]
    lines += [" " * _MARGIN + "".join(row).rstrip(), " " * _MARGIN + _scale(curve.ranges, group, bars)]
    lines.append(" " * _MARGIN + "   ".join(f"{signs[name]} {name}" for name in marks))
    return lines


def _plot(costs: NDArray[np.float64], group: int, steps: str) -> list[str]:
    padded = np.pad(costs, (0, -len(costs) % group), mode="edge")
    cheapest: NDArray[np.float64] = padded.reshape(-1, group).min(axis=1)
    top = max(float(cheapest.max()), 1e-6)
    labels = {0: f"{top:5.2f} ", _ROWS // 2: f"{top / 2:5.2f} "}
    return [labels.get(row, " " * _MARGIN) + "".join(bars) for row, bars in enumerate(_bars(cheapest / top, steps))]


def _bars(heights: NDArray[np.float64], steps: str) -> NDArray[np.str_]:
    """Return bars of heights 0 to 1 as characters, (rows, bars)."""
    fine = len(steps) - 1
    filled = np.rint(heights * _ROWS * fine).astype(int)
    from_bottom = np.clip(filled[None, :] - fine * np.arange(_ROWS)[:, None], 0, fine)
    return np.array(list(steps))[from_bottom[::-1]]


def _scale(ranges: Sequence[float] | NDArray[np.float64], group: int, bars: int) -> str:
    """Return as many range labels below the bars as fit."""
    line = ""
    for bar in range(0, bars, 16):
        line = line.ljust(bar) + f"{ranges[bar * group]:.3g}"
    last = f"{ranges[-1]:.3g}"
    return line[: max(0, bars - len(last) - 1)].ljust(bars - len(last)) + last
