"""Scores of range maps, pixel by pixel as their definitions read."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

from numpy.typing import NDArray

from pano_mvs.geometry import pixel_solid_angle


def pixels(
    estimated: NDArray[Any],
    truth: NDArray[Any],
    *,
    scale: float = 1.0,
    valid_only: bool = False,
    weighted: bool = False,
) -> Iterator[tuple[float | None, float, float]]:
    """(estimate or None, truth, weight) of every pixel that counts."""
    for row in range(truth.shape[0]):
        weight = float(pixel_solid_angle(truth.shape)[row]) if weighted else 1.0
        for column in range(truth.shape[1]):
            true, found = float(truth[row, column]), float(estimated[row, column]) * scale
            if not (math.isfinite(true) and true > 0):
                continue
            known = math.isfinite(found) and found > 0
            if known or not valid_only:
                yield (found if known else None), true, weight


def average(values: Sequence[tuple[float, float]]) -> float:
    """Mean of (value, weight) pairs."""
    total = sum(weight for _, weight in values)
    return sum(value * weight for value, weight in values) / total if total else float("nan")


def score(name: str, estimated: NDArray[Any], truth: NDArray[Any], *, peak: float = 10.0, scale: float = 1.0) -> float:
    """One score by its name in `score_view`."""
    valid_only, weighted = name.startswith("valid_"), "w_" in name[:8]
    base = name.removeprefix("valid_").removeprefix("w_")
    counted = list(pixels(estimated, truth, scale=scale, valid_only=valid_only, weighted=weighted))
    if base == "completeness":
        return average([(float(found is not None), weight) for found, _, weight in counted])
    if base == "psnr_db":
        mse = score(name.replace("psnr_db", "mse"), estimated, truth, peak=peak, scale=scale)
        return math.nan if math.isnan(mse) else math.inf if mse == 0 else -10 * math.log10(mse)
    if base == "rmse":
        return peak * math.sqrt(score(name.replace("rmse", "mse"), estimated, truth, peak=peak, scale=scale))
    return average([(of_pixel(base, found, true, peak), weight) for found, true, weight in counted])


def of_pixel(base: str, found: float | None, true: float, peak: float) -> float:
    """What one pixel adds to a mean."""
    error = true if found is None else abs(found - true)
    if base == "mse":
        return (error / peak) ** 2
    if base == "mae":
        return error
    if base == "abs_rel":
        return error / true
    if base.startswith("delta"):
        limit = {"delta_105": 1.05, "delta_125": 1.25, "delta_125_2": 1.25**2, "delta_125_3": 1.25**3}[base]
        return float(found is not None and max(found / true, true / found) < limit)
    if base.startswith("bad_abs_"):
        return float(found is None or error > float(base.removeprefix("bad_abs_")))
    assert base.startswith("bad_")
    return float(found is None or error / true > float(base.removeprefix("bad_")) / 100)
