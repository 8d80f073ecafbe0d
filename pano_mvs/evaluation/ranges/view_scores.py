"""All scores of one range map, and those of constants in its place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.evaluation.ranges.errors import DEFAULT_BAD, DELTAS, BadLimit, mse_scores, range_errors
from pano_mvs.evaluation.ranges.pixels import (
    Align,
    ScoredPixels,
    aligning_scale,
    scored_pixels,
    weighted_mean,
    weighted_median,
)
from pano_mvs.evaluation.ranges.sparsification import sparsify


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


PROTOCOLS = "", "w_", "valid_", "valid_w_"
"""Prefixes of scores: every pixel with truth, the same by solid angle, pixels with an estimate, the same by angle."""
BASELINES = "best", "median", "mean"


@dataclass(frozen=True, slots=True)
class ViewScores:
    """The scores of one range map, and of constants.

    Attributes:
        pixels: number of pixels with truth.
        scale: factor by which the estimates were multiplied.
        scores: name to value (see `score_view`).
        constants: name of a baseline to its scores by the same names. "best" is the best constant for each score (see
            `best_constant_errors`), "median" and "mean" are those of the view's true ranges, unweighted. Each is scored
            over the same pixels as the range map.
    """

    pixels: int
    scale: float
    scores: Mapping[str, float]
    constants: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True, slots=True)
class ScoreSettings:
    """How range maps are scored.

    Attributes:
        peak: the range that counts as 1 in mse, in the truth's unit.
        bad: limits of bad pixels.
        align: how estimates are fitted to the truth before they are scored (see `aligning_scale`).
        min_confidence: estimates below it count as missing, except in the sparsification.
    """

    peak: float = 10.0
    bad: Sequence[BadLimit] = DEFAULT_BAD
    align: Align = "none"
    min_confidence: int = 0

    def __post_init__(self) -> None:
        if not 0 < self.peak < float("inf"):
            raise UsageError(f"the peak must be a positive length, got {self.peak}")


def score_view(
    estimated: NDArray[np.floating],
    truth: NDArray[np.floating],
    *,
    confidence: NDArray[np.uint8] | None = None,
    scale: float = 1.0,
    mask: NDArray[np.bool_] | None = None,
    settings: ScoreSettings | None = None,
) -> ViewScores:
    """Return the scores of a range map.

    Each prefix of `PROTOCOLS` precedes mse, psnr_db, rmse, mae, abs_rel, the deltas and the bads of `range_errors`.
    completeness and w_completeness are the shares of pixels with an estimate; median_relative_error and
    w_median_relative_error are taken over those. With confidence there are sparsification_area,
    sparsification_oracle_area and ause, by solid angle, and plain_ause with equal weights.

    Args:
        estimated: (H, W) ranges in scene units; values that are not positive and finite count as missing.
        truth: (H, W) true ranges; pixels with anything but a positive finite one are ignored.
        confidence: (H, W), the larger the more confident.
        scale: factor from scene units to the truth's unit.
        mask: (H, W), False excludes a pixel.
        settings: how to score; by default those of `ScoreSettings`.

    Raises:
        UsageError: if shapes differ, the scale is not positive, or `min_confidence` is set without confidence.

    Example:
        >>> import numpy as np
        >>> truth = np.full((4, 8), 2.0)
        >>> found = score_view(truth * 1.1, truth)
        >>> round(found.scores["abs_rel"], 6), found.scores["completeness"]
        (0.1, 1.0)
    """
    settings = settings or ScoreSettings()
    pixels = scored_pixels(estimated, truth, confidence=confidence, scale=scale, mask=mask)
    confident = _confident(pixels, settings.min_confidence)
    fitted = aligning_scale(confident, settings.align)
    # Sorted by the truth once: each of the constants needs that order.
    groups = _groups(confident.scaled(fitted).at(np.argsort(pixels.true, kind="stable")))
    scores = _scores(groups, settings)
    true = pixels.true
    middles = {"median": np.median(true), "mean": true.mean()} if len(true) else {"median": np.nan, "mean": np.nan}
    constants = {"best": _best(groups, settings)} | {
        name: _scores(_constant(groups, float(constant)), settings) for name, constant in middles.items()
    }
    if confidence is not None:
        curve = sparsify(pixels.scaled(fitted))
        plain = sparsify(pixels.scaled(fitted), by_solid_angle=False)
        areas = {"sparsification_area": curve.area, "sparsification_oracle_area": curve.oracle_area}
        scores |= areas | {"ause": curve.ause, "plain_ause": plain.ause}
        for values in constants.values():  # a constant confidence
            values |= areas | {
                "sparsification_area": curve.unranked_area,
                "ause": curve.unranked_area - curve.oracle_area,
                "plain_ause": plain.unranked_area - plain.oracle_area,
            }
    return ViewScores(len(pixels.true), scale * fitted, scores, constants)


def mean_scores(views: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of each score over the views in which it is not NaN (NaN: no pixel to score)."""
    names = dict.fromkeys(name for view in views for name in view)
    values = {name: [view[name] for view in views if name in view and not np.isnan(view[name])] for name in names}
    return {name: float(np.mean(found)) if found else float("nan") for name, found in values.items()}


def _confident(pixels: ScoredPixels, least: int) -> ScoredPixels:
    """Return the pixels without the estimates whose confidence is below a limit."""
    if least <= 0:
        return pixels
    if pixels.confidence is None:
        raise UsageError("a minimum confidence is set, but there is no confidence map")
    return replace(pixels, found=np.where(pixels.confidence >= least, pixels.found, np.nan))


def _groups(pixels: ScoredPixels) -> dict[str, ScoredPixels]:
    """Return the pixels of each protocol with their weights there, by its prefix."""
    groups = {}
    for prefix, group in (("", pixels), ("valid_", pixels.only_valid())):
        groups[prefix] = replace(group, weight=np.broadcast_to(1.0, group.true.shape))
        groups[f"{prefix}w_"] = group
    return {prefix: groups[prefix] for prefix in PROTOCOLS}


def _constant(groups: Mapping[str, ScoredPixels], constant: float) -> dict[str, ScoredPixels]:
    """Return the pixels of each protocol with a constant as estimate."""
    return {
        prefix: replace(group, found=np.broadcast_to(constant, group.true.shape)) for prefix, group in groups.items()
    }


def _scores(groups: Mapping[str, ScoredPixels], settings: ScoreSettings) -> dict[str, float]:
    scores: dict[str, float] = {}
    for prefix, group in groups.items():
        averages = range_errors(group.found, group.true, group.weight, peak=settings.peak, bad=settings.bad)
        scores |= {f"{prefix}{name}": value for name, value in averages.items()}
    seen = groups["valid_w_"]
    relative = np.abs(seen.found - seen.true) / seen.true
    return scores | {
        "completeness": weighted_mean(groups[""].valid, groups[""].weight),
        "w_completeness": weighted_mean(groups["w_"].valid, groups["w_"].weight),
        "median_relative_error": float(np.median(relative)) if len(relative) else float("nan"),
        "w_median_relative_error": weighted_median(relative, seen.weight),
    }


def _best(groups: Mapping[str, ScoredPixels], settings: ScoreSettings) -> dict[str, float]:
    best: dict[str, float] = {}
    for prefix, group in groups.items():
        averages = best_constant_errors(group.true, group.weight, peak=settings.peak, bad=settings.bad)
        best |= {f"{prefix}{name}": value for name, value in averages.items()}
    complete = 1.0 if len(groups[""].true) else float("nan")
    return best | {
        "completeness": complete,
        "w_completeness": complete,
        "median_relative_error": best_constant_median(groups["valid_"].true, groups["valid_"].weight),
        "w_median_relative_error": best_constant_median(groups["valid_w_"].true, groups["valid_w_"].weight),
    }
