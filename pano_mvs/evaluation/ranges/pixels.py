"""The pixels of one view that are scored, and weighted statistics over them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import pixel_solid_angle

Align = Literal["none", "median", "lsq"]


@dataclass(frozen=True, slots=True, eq=False)
class ScoredPixels:
    """The pixels of one view with ground truth, in any order.

    Attributes:
        found: (N,) estimated ranges in the truth's unit, NaN where there is no estimate.
        true: (N,) true ranges, positive and finite.
        weight: (N,) solid angles in steradians.
        confidence: (N,) the larger the more confident, or None.
    """

    found: FloatArray
    true: FloatArray
    weight: FloatArray
    confidence: NDArray[np.integer] | None = None

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
