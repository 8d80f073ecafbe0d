"""All scores of one range map, and those of constants in its place."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.evaluation.ranges.best_constant import best_constant_errors, best_constant_median
from pano_mvs.evaluation.ranges.errors import DEFAULT_BAD, BadLimit, range_errors
from pano_mvs.evaluation.ranges.pixels import (
    Align,
    ScoredPixels,
    aligning_scale,
    scored_pixels,
    weighted_mean,
    weighted_median,
)
from pano_mvs.evaluation.ranges.sparsification import sparsify

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
