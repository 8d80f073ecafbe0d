"""Draw a cost curve with text characters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.cost_curve import CostCurve

_ROWS = 8
_MARGIN = 6
_LABEL_STEP = 16
# Eighths of a character if the terminal supports them, otherwise whole characters.
_EIGHTHS, _WHOLE = " ▁▂▃▄▅▆▇█", " #"
_SIGNS = {"winner": "▲", "next valley": "△", "truth": "◆"}
_PLAIN_SIGNS = {"winner": "^", "next valley": "o", "truth": "T"}


def curve_text(curve: CostCurve, *, true_range: float = np.nan, width: int = 100, plain: bool = False) -> list[str]:
    """Return the lines of a plot with a bar for the cost of each depth hypothesis, near on the left.

    Costs after semi-global matching are drawn below the original costs. If there are more ranges than columns,
    a bar shows the minimum of several ranges.

    Args:
        curve: of a pixel.
        true_range: marked below; NaN if unknown.
        width: characters in a line.
        plain: whether to use ASCII alone.
    """
    group = -(-len(curve.ranges) // max(8, width - _MARGIN))
    signs, steps = (_PLAIN_SIGNS, _WHOLE) if plain else (_SIGNS, _EIGHTHS)
    lines = ["cost, combined from the neighbours:", *_plot(curve.raw, group, steps)]
    if curve.aggregated is not None:
        lines += ["after semi-global matching:", *_plot(curve.aggregated, group, steps)]
    marks = _marks(curve, true_range)
    bars = -(-len(curve.ranges) // group)
    row = [" "] * bars
    for name in reversed(list(marks)):
        row[marks[name] // group] = signs[name]
    lines += [" " * _MARGIN + "".join(row).rstrip(), " " * _MARGIN + _scale(curve.ranges, group, bars)]
    lines.append(" " * _MARGIN + "   ".join(f"{signs[name]} {name}" for name in marks))
    return lines


def _plot(costs: NDArray[np.float64], group: int, steps: str) -> list[str]:
    cheapest = _cheapest(costs, group)
    top = max(float(cheapest.max()), 1e-6)
    labels = {0: f"{top:5.2f} ", _ROWS // 2: f"{top / 2:5.2f} "}
    return [labels.get(row, " " * _MARGIN) + "".join(bars) for row, bars in enumerate(_bars(cheapest / top, steps))]


def _cheapest(costs: NDArray[np.float64], group: int) -> NDArray[np.float64]:
    padded = np.pad(costs, (0, -len(costs) % group), mode="edge")
    cheapest: NDArray[np.float64] = padded.reshape(-1, group).min(axis=1)
    return cheapest


def _bars(heights: NDArray[np.float64], steps: str) -> NDArray[np.str_]:
    """Return bars of heights 0 to 1 as characters, (rows, bars)."""
    fine = len(steps) - 1
    filled = np.rint(heights * _ROWS * fine).astype(int)
    from_bottom = np.clip(filled[None, :] - fine * np.arange(_ROWS)[:, None], 0, fine)
    return np.array(list(steps))[from_bottom[::-1]]


def _marks(curve: CostCurve, true_range: float) -> Mapping[str, int]:
    marks = {"winner": curve.winner}
    if curve.runner_up is not None:
        marks["next valley"] = curve.runner_up
    if np.isfinite(true_range):
        marks["truth"] = int(np.abs(np.log(curve.ranges / true_range)).argmin())
    return marks


def _scale(ranges: Sequence[float] | NDArray[np.float64], group: int, bars: int) -> str:
    """Return as many range labels below the bars as fit."""
    line = ""
    for bar in range(0, bars, _LABEL_STEP):
        line = line.ljust(bar) + f"{ranges[bar * group]:.3g}"
    last = f"{ranges[-1]:.3g}"
    return line[: max(0, bars - len(last) - 1)].ljust(bars - len(last)) + last
