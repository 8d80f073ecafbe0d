"""Numbers as people read them, and the tables of scores."""

from __future__ import annotations

import math
import statistics
from collections.abc import Mapping, Sequence
from typing import Any

from pano_mvs.results.records import ScoresSummary

# The scores to show first; others follow in their stored order.
_FIRST = ("psnr_db", "w_mae", "w_delta_105", "median_relative_error", "completeness")
# Labels of scores; those of others are derived from their names.
_WORDS = {
    "psnr_db": "PSNR dB",
    "mae": "mean error",
    "w_mae": "mean error on the sphere",
    "abs_rel": "mean relative error",
    "delta_105": "within 5 %",
    "w_delta_105": "within 5 % on the sphere",
    "bad_5": "off by more than 5 %",
    "sparsification_area": "sparsification area",
    "sparsification_oracle_area": "sparsification area of an oracle",
    "ause": "area between the two (AUSE)",
    "of": "of panoramas with truth",
}
_CONSTANTS = "best_constant_", "constant_"
_BRACKETS = "In brackets: the score of a single constant range, the best one for each score."
_MIN_SHOWN = 0.0001
_UNITS = {"deg": "°", "rad": "rad", "px": "px", "s": "s", "db": "dB", "mb": "MB"}


def share(value: Any) -> str:
    """Return a fraction as a percentage, never rounded up to 100 %."""
    if not _is_number(value):
        return "–"
    percent = 100 * float(value)
    if 0 < percent < 0.05:
        return "< 0.1 %"
    digits = 0 if 10 <= percent < 99 or percent in (0, 100) else 1
    return f"{min(percent, 99.9) if percent < 100 else percent:.{digits}f} %"


def degrees(value: Any) -> str:
    """Return an angle in degrees with two significant digits."""
    return f"{significant(value)}°" if _is_number(value) else "–"


def significant(value: float, digits: int = 2) -> str:
    """Return a number with at least this number of significant digits, and never with an exponent."""
    if 0 < abs(value) < _MIN_SHOWN:
        return f"< {_MIN_SHOWN}"
    return f"{value:z.0f}" if abs(value) >= 10**digits - 0.5 else f"{value:z.{digits}g}"


def short(count: int) -> str:
    """Return a count in at most five characters, for an axis.

    >>> [short(count) for count in (0, 950, 1500, 20_000, 2_500_000)]
    ['0', '950', '1.5 k', '20 k', '2.5 M']
    """
    for size, letter in ((1_000_000, "M"), (1000, "k")):
        if count >= size:
            return f"{count / size:.3g} {letter}"
    return str(count)


def figure(value: Any) -> str:
    """Return a value with four significant digits and thousands separators."""
    if isinstance(value, bool) or value is None:
        return {True: "yes", False: "no", None: "–"}[value]
    if isinstance(value, int):
        return f"{value:,}".replace(",", "\u202f")
    if isinstance(value, float):
        if not math.isfinite(value):
            return "–"
        return figure(round(value)) if abs(value) >= 1000 else f"{value:z.4g}"
    if isinstance(value, list | tuple):
        return ", ".join(figure(item) for item in value)
    if isinstance(value, Mapping):
        return ", ".join(f"{words(str(key))} {figure(item)}" for key, item in value.items())
    return str(value)


def words(name: str) -> str:
    """Return the name of a figure in words: `median_pair_error_deg` is `median pair error, °`."""
    if name in _WORDS:
        return _WORDS[name]
    *parts, last = name.split("_")
    if parts[:1] == ["auc"] and last == "deg":
        return f"AUC at {'.'.join(parts[1:])}°"
    return f"{' '.join(parts)}, {_UNITS[last]}" if parts and last in _UNITS else name.replace("_", " ")


def score_tables(scores: ScoresSummary, *, only: Sequence[str] = ()) -> dict[str, Any]:
    """Return the scores of the poses as rows, and those of the views as a table with one column per metric.

    The score of a constant range map (`best_constant_…`) is added in brackets. `only`: the metrics; empty for all.
    """
    views = scores.views
    known = [metric for metric in _metrics(views) if not metric.startswith(_CONSTANTS)]
    columns = list(only or sorted(known, key=lambda metric: _FIRST.index(metric) if metric in _FIRST else len(_FIRST)))
    middle = {metric: median([view.get(metric) for view in views.values()]) for metric in _metrics(views)}
    return {
        "poses": list(scores.poses.items()),
        "columns": columns,
        "views": [(name, [_beside_constant(values, metric) for metric in columns]) for name, values in views.items()],
        "median": [_beside_constant(middle, metric) for metric in columns] if len(views) > 1 else [],
        "notes": [*([_BRACKETS] if len(_metrics(views)) > len(columns) else []), *scores.notes],
    }


def side_by_side(tables: Sequence[tuple[str, Mapping[str, Any]]]) -> dict[str, Any]:
    """Return a table with the medians of each branch in a row; empty if there is only one branch.

    Args:
        tables: (name of a branch, result of `score_tables`).
    """
    scored = [(name, table) for name, table in tables if table["views"]]
    if len(scored) < 2:
        return {"columns": [], "rows": []}
    columns = list(dict.fromkeys(column for _, table in scored for column in table["columns"]))
    rows = []
    for name, table in scored:
        values = dict(zip(table["columns"], table["median"] or table["views"][0][1], strict=True))
        rows.append((name, [values.get(column) for column in columns]))
    return {"columns": columns, "rows": rows}


def _metrics(views: Mapping[str, Mapping[str, Any]]) -> list[str]:
    return list(dict.fromkeys(metric for values in views.values() for metric in values))


def _beside_constant(values: Mapping[str, Any], metric: str) -> str:
    """Return a score, followed by that of a constant in brackets if known."""
    found = figure(values.get(metric))
    constant = values.get(f"best_constant_{metric}")
    return found if constant is None else f"{found} ({figure(constant)})"


def median(values: list[Any]) -> float | None:
    """Return the median of the finite values, or None."""
    numbers = [float(value) for value in values if _is_number(value)]
    return statistics.median(numbers) if numbers else None


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
