"""All scores of one range map, and those of constants in its place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import pixel_solid_angle

DELTAS = {"delta_105": 1.05, "delta_125": 1.25, "delta_125_2": 1.25**2, "delta_125_3": 1.25**3}
"""Name of a score to the largest ratio of estimate and truth, either way round, of a correct pixel."""


@dataclass(frozen=True, slots=True)
class BadLimit:
    """An error above which a pixel is bad."""

    value: float
    relative: bool = True

    @property
    def name(self) -> str:
        """`bad_5` for 5 % of the truth, `bad_abs_0.1` for a tenth of the truth's unit."""
        return f"bad_{100 * self.value:g}" if self.relative else f"bad_abs_{self.value:g}"

    @classmethod
    def from_text(cls, text: str) -> BadLimit:
        """Return the limit written as "5%" or, in the truth's unit, as "0.1"."""
        relative = text.strip().endswith("%")
        try:
            value = float(text.strip().removesuffix("%")) / (100 if relative else 1)
        except ValueError:
            value = float("nan")
        if not 0 < value < float("inf"):
            raise UsageError(f"'{text}' is not a limit for bad pixels: write a share (5%) or a length (0.1)")
        return cls(value, relative)


DEFAULT_BAD = (BadLimit(0.05),)


def range_errors(
    found: NDArray[np.float64],
    true: NDArray[np.float64],
    weight: NDArray[np.float64],
    *,
    peak: float = 10.0,
    bad: Sequence[BadLimit] = DEFAULT_BAD,
) -> dict[str, float]:
    """Return the weighted averages of the errors of pixels; NaN of no pixels.

    With e = |found − true|: mse is the mean of (e / peak)², psnr_db −10 log10 of it, rmse its root times the peak, mae
    the mean of e, and abs_rel the mean of e / true. A delta is the share of pixels with max(found / true, true / found)
    below its limit, a bad the share with e / true (or e) above its limit.

    Args:
        found: (N,) estimates; where NaN, e is the truth itself, and the pixel is bad and fails every delta.
        true: (N,) true ranges, positive.
        weight: (N,) weight of each pixel.
        peak: the range that counts as 1 in mse, in the truth's unit.
        bad: limits of bad pixels.
    """
    valid = np.isfinite(found)
    error = np.where(valid, np.abs(found - true), true)
    relative = error / true
    ratio = np.full_like(true, np.inf)
    np.divide(np.maximum(found, true), np.minimum(found, true), out=ratio, where=valid & (found > 0))
    averages = mse_scores(weighted_mean((error / peak) ** 2, weight), peak)
    averages |= {"mae": weighted_mean(error, weight), "abs_rel": weighted_mean(relative, weight)}
    averages |= {name: weighted_mean(ratio < limit, weight) for name, limit in DELTAS.items()}
    for limit in bad:
        beyond = (relative if limit.relative else error) > limit.value
        averages[limit.name] = weighted_mean(beyond | ~valid, weight)
    return averages


def mse_scores(mse: float, peak: float) -> dict[str, float]:
    """Return a mean of squared errors, in units of the squared peak, as mse, psnr_db and rmse."""
    with np.errstate(divide="ignore"):
        return {"mse": mse, "psnr_db": float(-10 * np.log10(mse)), "rmse": float(peak * np.sqrt(mse))}


Align = Literal["none", "median", "lsq"]


@dataclass(frozen=True, slots=True, eq=False)
class ScoredPixels:
    """The pixels of one view with ground truth, in any order."""

    found: FloatArray  # (N,) estimated ranges in the truth's unit, NaN where there is no estimate
    true: FloatArray  # (N,) true ranges, positive and finite
    weight: FloatArray  # (N,) solid angles in steradians
    confidence: NDArray[np.integer] | None = None  # (N,) the larger the more confident, or None

    @property
    def valid(self) -> NDArray[np.bool_]:
        """The pixels, (N,), with an estimate."""
        return np.isfinite(self.found)

    def at(self, chosen: NDArray[Any]) -> ScoredPixels:
        """Return the pixels at an index array or mask."""
        confidence = None if self.confidence is None else self.confidence[chosen]
        return ScoredPixels(self.found[chosen], self.true[chosen], self.weight[chosen], confidence)

    def only_valid(self) -> ScoredPixels:
        """Return the pixels with an estimate."""
        valid = self.valid
        return self if valid.all() else self.at(valid)

    def scaled(self, scale: float) -> ScoredPixels:
        """Return the pixels with all estimates multiplied by a factor."""
        return self if scale == 1 else replace(self, found=scale * self.found)


def has_range(ranges: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the pixels, of the same shape, that hold a finite range above zero."""
    held: NDArray[np.bool_] = np.isfinite(ranges) & (ranges > 0)
    return held


def scored_pixels(
    estimated: NDArray[np.floating],
    truth: NDArray[np.floating],
    *,
    confidence: NDArray[np.integer] | None = None,
    scale: float = 1.0,
    mask: NDArray[np.bool_] | None = None,
) -> ScoredPixels:
    """Return the pixels with ground truth and their estimates.

    Args:
        estimated: (H, W) ranges in scene units; values that are not positive and finite count as missing.
        truth: (H, W) true ranges; pixels with anything but a positive finite one are ignored.
        confidence: (H, W), the larger the more confident.
        scale: factor from scene units to the truth's unit.
        mask: (H, W), False excludes a pixel.

    Raises:
        UsageError: if the shapes differ or the scale is not positive.
    """
    others = [array.shape for array in (truth, confidence, mask) if array is not None]
    if truth.ndim != 2 or any(shape != estimated.shape for shape in others):
        raise UsageError(
            f"estimated {estimated.shape}, truth {truth.shape}, confidence and mask must be (H, W) of one size"
        )
    if not scale > 0:
        raise UsageError(f"the scale from scene units to the truth's must be positive, got {scale}")
    counted = has_range(truth)
    if mask is not None:
        counted &= mask
    found = estimated[counted].astype(np.float64)
    found[~has_range(found)] = np.nan
    weight = np.broadcast_to(pixel_solid_angle((truth.shape[0], truth.shape[1]))[:, None], truth.shape)[counted]
    of_pixels = None if confidence is None else confidence[counted]
    return ScoredPixels(found * scale, truth[counted].astype(np.float64), weight, of_pixels)


def aligning_scale(pixels: ScoredPixels, align: Align) -> float:
    """Return the factor that fits the estimates to the truth; 1 for "none", and without estimates.

    "median" is the weighted median of the truth over that of the estimates. "lsq" is the factor s with the least sum of
    squares Σ Ω (s d − t)², s = Σ Ω d t / Σ Ω d². Both use the pixels with an estimate d of their truth t, weighted by
    their solid angle Ω. Fitted scores do not follow the paper's protocol, which never uses the true ranges.
    """
    both = pixels.only_valid()
    if align == "none" or not len(both.true):
        return 1.0
    if align == "median":
        return weighted_median(both.true, both.weight) / weighted_median(both.found, both.weight)
    return float(np.sum(both.weight * both.found * both.true) / np.sum(both.weight * both.found**2))


def weighted_mean(values: FloatArray | NDArray[np.bool_], weight: FloatArray) -> float:
    """Return the weighted mean; NaN of no values."""
    total = float(weight.sum())
    return float((values * weight).sum()) / total if total > 0 else float("nan")


def weighted_median(values: NDArray[np.floating], weight: FloatArray) -> float:
    """Return the smallest value at which half the weight is reached; NaN of no values."""
    return weighted_quantile(values, weight, 0.5)


def weighted_quantile(values: NDArray[np.floating], weight: FloatArray, share: float) -> float:
    """Return the smallest of the values (N,) at which a share of the weight (N,) is reached; NaN of no values."""
    if not len(values):
        return float("nan")
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(reached, reached[-1] * share)]])


class Sparsification(NamedTuple):
    """Areas under the mean error of the most confident pixels against the share of pixels that is kept.

    Pixels of the same confidence are kept or left out together; between two confidences the curve is that of a random
    order. Errors are |error| / truth, at most 1.
    """

    area: float
    oracle_area: float  # if the pixels were ordered by their true errors
    unranked_area: float  # if all pixels had the same confidence: the mean error

    @property
    def ause(self) -> float:
        """Area between the two curves: 0 if confidence orders the pixels like their errors; less is better."""
        return self.area - self.oracle_area


def sparsify(pixels: ScoredPixels, *, by_solid_angle: bool = True) -> Sparsification:
    """Return the sparsification of a range map; NaN if no pixel has an estimate.

    E. Ilg et al., "Uncertainty estimates and multi-hypotheses networks for optical flow", ECCV 2018, section 5.1.
    """
    both = pixels.only_valid()
    if both.confidence is None:
        raise UsageError("sparsification needs the confidence of the pixels")
    weight = both.weight if by_solid_angle else np.ones_like(both.weight)
    if len(weight) == 0:
        return Sparsification(float("nan"), float("nan"), float("nan"))
    # Larger relative errors count as this one; otherwise a few far pixels would decide the area.
    error = np.minimum(np.abs(both.found - both.true) / both.true, 1.0)
    area, unranked_area = _areas(both.confidence.astype(np.float64), error, weight)
    return Sparsification(area, _areas(-error, error, weight)[0], unranked_area)


def _areas(
    sureness: NDArray[np.float64], error: NDArray[np.float64], weight: NDArray[np.float64]
) -> tuple[float, float]:
    """Return the area under the curve of an order, and the mean error."""
    levels, level = np.unique(-sureness, return_inverse=True)
    added = np.bincount(level, weight, len(levels)) / weight.sum()
    lost = np.bincount(level, weight * error, len(levels)) / weight.sum()
    kept, total = np.cumsum(added), np.cumsum(lost)
    before, total_before = kept - added, total - lost
    # Within a level of mean error m the curve is (E + m x) / (k + x), whose integral over x from 0 to a is
    # m a + (E − m k) ln(1 + a / k).
    mean = lost / added
    growth = np.log1p(np.divide(added, before, out=np.zeros_like(added), where=before > 0))
    area = float(np.sum(mean * added + (total_before - mean * before) * growth))
    return area, float(total[-1] / kept[-1])


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
    """The scores of one range map, and of constants."""

    pixels: int  # number of pixels with truth
    scale: float  # factor by which the estimates were multiplied
    scores: Mapping[str, float]  # name to value (see `score_view`)
    # name of a baseline to its scores by the same names. "best" is the best constant for each score (see
    # `best_constant_errors`), "median" and "mean" are those of the view's true ranges, unweighted. Each is scored over
    # the same pixels as the range map.
    constants: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True, slots=True)
class ScoreSettings:
    """How range maps are scored."""

    peak: float = 10.0  # the range that counts as 1 in mse, in the truth's unit
    bad: Sequence[BadLimit] = DEFAULT_BAD  # limits of bad pixels
    align: Align = "none"  # how estimates are fitted to the truth before they are scored (see `aligning_scale`)
    min_confidence: int = 0  # estimates below it count as missing, except in the sparsification

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
    """Return the scores of a range map; see `scored_pixels` for the maps and the scale.

    Each prefix of `PROTOCOLS` precedes mse, psnr_db, rmse, mae, abs_rel, the deltas and the bads of `range_errors`.
    completeness and w_completeness are the shares of pixels with an estimate; median_relative_error and
    w_median_relative_error are taken over those. With confidence there are sparsification_area,
    sparsification_oracle_area and ause, by solid angle, and plain_ause with equal weights.

    Args:
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
