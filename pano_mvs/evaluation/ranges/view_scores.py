"""All that is said of one range map against the truth, and what constants score in its place."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.evaluation.ranges.best_constant import best_constant_errors, best_constant_median
from pano_mvs.evaluation.ranges.errors import DEFAULT_BAD, BadLimit, range_errors, weighted_mean
from pano_mvs.evaluation.ranges.pixels import Align, JudgedPixels, aligning_scale, judged_pixels, weighted_median
from pano_mvs.evaluation.ranges.sparsification import sparsify

PROTOCOLS = "", "w_", "valid_", "valid_w_"
"""Prefixes of scores: every pixel with truth, the same by solid angle, pixels with an estimate, the same likewise."""
BASELINES = "best", "median", "mean"


@dataclass(frozen=True, slots=True)
class ViewScores:
    """The scores of one range map, and of constants.

    Attributes:
        pixels: number of pixels with truth.
        scale: what the estimates were multiplied by.
        scores: name to value, as of `score_view`.
        constants: name of a baseline to what it scores under the same names. "best": each score by the constant that is
            best for it, chosen by the truth, as of `best_constant_errors`. "median", "mean": by that of the view's true
            ranges, unweighted. Each is judged on the very pixels of the score beside it.
    """

    pixels: int
    scale: float
    scores: Mapping[str, float]
    constants: Mapping[str, Mapping[str, float]]


@dataclass(frozen=True, slots=True)
class Judging:
    """How range maps are judged.

    Attributes:
        peak: the range that counts as 1 in mse, in the truth's unit.
        bad: limits of bad pixels.
        align: whether, and how, estimates are fitted to the truth before they are judged, as of `aligning_scale`.
        min_confidence: estimates below it count as none; they keep their part in the sparsification.
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
    judging: Judging | None = None,
) -> ViewScores:
    """Return the scores of a range map.

    Under each of the prefixes in `PROTOCOLS` stand mse, psnr_db, rmse, mae, abs_rel, the deltas and the bads of
    `range_errors`; completeness and w_completeness are the shares of pixels with an estimate; median_relative_error and
    w_median_relative_error are over those. Where there is confidence: sparsification_area, sparsification_oracle_area
    and ause, by solid angle as everywhere in the project, and plain_ause with all pixels equal.

    Args:
        estimated: (H, W) ranges in scene units; what is not finite or not positive is no estimate.
        truth: (H, W) true ranges; pixels with anything but a positive finite one are left out.
        confidence: (H, W), larger is surer.
        scale: factor from scene units to the truth's unit.
        mask: (H, W), False leaves a pixel out.
        judging: how; None: the defaults.

    Raises:
        UsageError: if shapes differ, the scale is not positive, or a least confidence is asked for without confidence.
    """
    judging = judging or Judging()
    kept = _confident(estimated, confidence, judging.min_confidence)
    found = _without_confidence(judged_pixels(kept, truth, scale=scale, mask=mask), scale, judging)
    if confidence is None:
        return found
    known = truth if mask is None else np.where(mask, truth, np.nan)
    ranked, unranked = _sparsification(estimated, confidence, known, found.scale)
    constants = {name: {**values, **unranked} for name, values in found.constants.items()}
    return ViewScores(found.pixels, found.scale, {**found.scores, **ranked}, constants)


def _without_confidence(pixels: JudgedPixels, scale: float, judging: Judging) -> ViewScores:
    fitted = aligning_scale(pixels, judging.align)
    # In the order of the truth: each of the constants sorts by it, which takes no time once it is so.
    groups = _groups(pixels.scaled(fitted).by_truth())
    constants = {"best": _best(groups, judging)} | {
        name: _scores(_constant(groups, value), judging)
        for name, value in (("median", np.median), ("mean", np.mean))
    }  # fmt: skip
    return ViewScores(len(pixels.true), scale * fitted, _scores(groups, judging), constants)


def pixel_scores(pixels: JudgedPixels, judging: Judging) -> dict[str, float]:
    """Return the scores of `score_view`, but for those of the confidence, of pixels as they are."""
    return _scores(_groups(pixels), judging)


def mean_scores(views: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the mean of each score over views, without those in which it is NaN (nothing to judge)."""
    names = dict.fromkeys(name for view in views for name in view)
    values = {name: [view[name] for view in views if name in view and not np.isnan(view[name])] for name in names}
    return {name: float(np.mean(found)) if found else float("nan") for name, found in values.items()}


def _confident(
    estimated: NDArray[np.floating], confidence: NDArray[np.uint8] | None, least: int
) -> NDArray[np.floating]:
    if confidence is not None and confidence.shape != estimated.shape:
        raise UsageError(f"ranges {estimated.shape} and confidence {confidence.shape} must be of one size")
    if least <= 0:
        return estimated
    if confidence is None:
        raise UsageError("there is no confidence: no least one can be asked for")
    return np.where(confidence >= least, estimated, np.nan)


def _groups(pixels: JudgedPixels) -> dict[str, JudgedPixels]:
    """Return the pixels of each protocol with what they count there, by its prefix."""
    weighted = {"w_": pixels, "valid_w_": pixels.only_valid()}
    equal = {
        prefix.removesuffix("w_"): JudgedPixels(group.found, group.true, np.broadcast_to(1.0, group.true.shape))
        for prefix, group in weighted.items()
    }
    return {prefix: (equal | weighted)[prefix] for prefix in PROTOCOLS}


def _constant(
    groups: Mapping[str, JudgedPixels], value: Callable[[NDArray[np.float64]], np.floating]
) -> dict[str, JudgedPixels]:
    """Return the pixels of each protocol as estimated by one constant, a value of all true ranges of the view."""
    true = groups[""].true
    constant = float(value(true)) if len(true) else float("nan")
    return {
        prefix: JudgedPixels(np.broadcast_to(constant, group.true.shape), group.true, group.weight)
        for prefix, group in groups.items()
    }


def _scores(groups: Mapping[str, JudgedPixels], judging: Judging) -> dict[str, float]:
    scores: dict[str, float] = {}
    for prefix, group in groups.items():
        averages = range_errors(group.found, group.true, group.weight, peak=judging.peak, bad=judging.bad)
        scores |= {f"{prefix}{name}": value for name, value in averages.items()}
    seen = groups["valid_w_"]
    relative = np.abs(seen.found - seen.true) / seen.true
    return scores | {
        "completeness": weighted_mean(groups[""].valid, groups[""].weight),
        "w_completeness": weighted_mean(groups["w_"].valid, groups["w_"].weight),
        "median_relative_error": float(np.median(relative)) if len(relative) else float("nan"),
        "w_median_relative_error": weighted_median(relative, seen.weight),
    }


def _best(groups: Mapping[str, JudgedPixels], judging: Judging) -> dict[str, float]:
    best: dict[str, float] = {}
    for prefix, group in groups.items():
        averages = best_constant_errors(group.true, group.weight, peak=judging.peak, bad=judging.bad)
        best |= {f"{prefix}{name}": value for name, value in averages.items()}
    complete = 1.0 if len(groups[""].true) else float("nan")
    return best | {
        "completeness": complete,
        "w_completeness": complete,
        "median_relative_error": best_constant_median(groups["valid_"].true, groups["valid_"].weight),
        "w_median_relative_error": best_constant_median(groups["valid_w_"].true, groups["valid_w_"].weight),
    }


def _sparsification(
    estimated: NDArray[np.floating], confidence: NDArray[np.uint8], truth: NDArray[np.floating], scale: float
) -> tuple[dict[str, float], dict[str, float]]:
    """Return the scores of a confidence, and what any constant one scores in its place."""
    curve = sparsify(estimated, confidence, truth, scale=scale)
    plain = sparsify(estimated, confidence, truth, scale=scale, by_solid_angle=False)
    return (
        {"sparsification_area": curve.area, "sparsification_oracle_area": curve.oracle_area,
         "ause": curve.ause, "plain_ause": plain.ause},
        {"sparsification_area": curve.unranked_area, "sparsification_oracle_area": curve.oracle_area,
         "ause": curve.unranked_area - curve.oracle_area, "plain_ause": plain.unranked_area - plain.oracle_area},
    )  # fmt: skip
