"""Estimate translation scale factors: the length of a pair's translation in the unit of the model."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError

ScaleEstimator: TypeAlias = Literal["cauchy", "log_median", "kappa"]


def estimate_scale(ratios: FloatArray, weights: FloatArray, *, estimator: ScaleEstimator, kappa: float) -> float:
    """Estimate one scale factor from the ratios of single features.

    "kappa" is the paper's estimator: the ratio with most other ratios within κ (absolute). "log_median" is the median
    of the log-ratios. "cauchy" is their weighted centre under a Cauchy loss, by iterated reweighting from the median.

    Args:
        ratios: (M,) positive, M ≥ 1.
        weights: (M,) inverse variances of the log-ratios, up to a factor; only used by "cauchy".
        estimator: "kappa", "log_median" or "cauchy".
        kappa: the paper's κ.

    Raises:
        UsageError: if there is no ratio, or a ratio is not positive.
    """
    if len(ratios) == 0 or not np.all(ratios > 0):
        raise UsageError("a scale factor needs at least one ratio, all positive")
    if estimator == "kappa":
        ordered = np.sort(ratios)
        first, end = np.searchsorted(ordered, ordered - kappa), np.searchsorted(ordered, ordered + kappa, "right")
        neighbours = end - first
        # Of several ratios with equally many neighbours take the middle one, so that no end of the range is preferred.
        best = np.flatnonzero(neighbours == neighbours.max())
        return float(ordered[best[len(best) // 2]])
    logs = np.log(ratios)
    center = float(np.median(logs))
    return float(np.exp(center if estimator == "log_median" else _cauchy_center(logs, weights, center)))


def _cauchy_center(logs: FloatArray, weights: FloatArray, center: float) -> float:
    spread = np.sqrt(weights / _median(weights))
    for _ in range(20):
        deviations = (logs - center) * spread
        scale = max(1.4826 * _median(np.abs(deviations)), 1e-9)
        robust = weights / (1 + (deviations / (2 * scale)) ** 2)
        moved = float(np.sum(robust * logs) / np.sum(robust))
        if abs(moved - center) < 1e-7:
            break
        center = moved
    return center


def _median(values: FloatArray) -> float:
    """Return the median; for a few hundred values several times as fast as numpy's, and called very often here."""
    ordered = np.sort(values)
    return float(0.5 * (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]))
