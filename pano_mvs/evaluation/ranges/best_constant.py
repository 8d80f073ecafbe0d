"""The best score that a constant range map reaches: each score has its own best constant."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.evaluation.ranges.errors import DEFAULT_BAD, DELTAS, BadLimit, mse_scores
from pano_mvs.evaluation.ranges.pixels import weighted_mean, weighted_median


@dataclass(frozen=True, slots=True, eq=False)
class _Sorted:
    """True ranges in rising order, and the weight before each and in all."""

    true: NDArray[np.float64]
    reached: NDArray[np.float64]

    def best_share(self, ends: NDArray[np.intp]) -> float:
        """Return the largest share of the weight in a window that begins at a pixel and ends before `ends`."""
        inside = self.reached[ends] - self.reached[:-1]
        return float(min(inside.max() / self.reached[-1], 1.0))


def best_constant_errors(
    true: NDArray[np.float64],
    weight: NDArray[np.float64],
    *,
    peak: float = 10.0,
    bad: Sequence[BadLimit] = DEFAULT_BAD,
) -> dict[str, float]:
    """Return the best value that any constant reaches in each score of `range_errors`; NaN of no pixels.

    The best constants are: for mse, psnr_db and rmse the weighted mean of the truth; for mae its weighted median; for
    abs_rel its median weighted by weight / truth; for a delta t the c with the most weight in c / t < true < c t, the
    best window of ratio t² in the sorted truth; for a bad b likewise with true in [c / (1 + b), c / (1 − b)], or in
    [c − b, c + b] for a length.

    Args:
        true: (N,) true ranges, positive.
        weight: (N,) weight of each pixel.
        peak: as in `range_errors`.
        bad: limits of bad pixels.
    """
    names = [*mse_scores(1.0, peak), "mae", "abs_rel", *DELTAS, *(limit.name for limit in bad)]
    if not len(true):
        return dict.fromkeys(names, float("nan"))
    ranges, weight = _in_order(true, weight)
    line = _Sorted(ranges, np.concatenate([[0.0], np.cumsum(weight)]))
    best = mse_scores(weighted_mean(((ranges - weighted_mean(ranges, weight)) / peak) ** 2, weight), peak)
    best["mae"] = weighted_mean(np.abs(ranges - weighted_median(ranges, weight)), weight)
    best["abs_rel"] = weighted_mean(np.abs(weighted_median(ranges, weight / ranges) / ranges - 1), weight)
    for name, ratio in DELTAS.items():
        best[name] = line.best_share(np.searchsorted(ranges, ranges * ratio**2, "left"))
    return best | {limit.name: 1 - line.best_share(_bad_ends(ranges, limit)) for limit in bad}


def best_constant_median(true: NDArray[np.float64], weight: NDArray[np.float64]) -> float:
    """Return the least weighted median of |c − true| / true that any constant c reaches; NaN of no pixels.

    A median of m requires half the weight in [c / (1 + m), c / (1 − m)]. Of all windows with that weight, the one with
    the least ratio r of its ends gives m = (r − 1) / (r + 1).
    """
    if not len(true):
        return float("nan")
    ranges, weight = _in_order(true, weight)
    reached = np.cumsum(weight)
    before = np.concatenate([[0.0], reached[:-1]])
    last = np.searchsorted(reached, before + reached[-1] / 2 * (1 - 1e-12))
    full = last < len(ranges)
    ratio = float((ranges[last[full]] / ranges[full]).min())
    return (ratio - 1) / (ratio + 1)


def _in_order(
    true: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return true ranges in rising order with their weights: the same arrays if they are sorted already."""
    if np.all(true[1:] >= true[:-1]):
        return true, weight
    order = np.argsort(true, kind="stable")
    return true[order], weight[order]


def _bad_ends(ranges: NDArray[np.float64], limit: BadLimit) -> NDArray[np.intp]:
    """Return, for each sorted range, the position of the first range that no constant covers together with it."""
    if not limit.relative:
        return np.searchsorted(ranges, ranges + 2 * limit.value, "right")
    if limit.value >= 1:  # c − true is at most c: the smallest range as constant is within 100 % of all
        return np.full(len(ranges), len(ranges), np.intp)
    return np.searchsorted(ranges, ranges * (1 + limit.value) / (1 - limit.value), "right")
