"""The pixels by which a range map is judged."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import pixel_solid_angle

Align = Literal["none", "median", "lsq"]


@dataclass(frozen=True, slots=True, eq=False)
class JudgedPixels:
    """The pixels of one view that have truth, in any order.

    Attributes:
        found: (N,) float64 estimated ranges in the truth's unit, NaN where there is no estimate.
        true: (N,) float64 true ranges, positive and finite.
        weight: (N,) float64 solid angles in steradians.
    """

    found: NDArray[np.float64]
    true: NDArray[np.float64]
    weight: NDArray[np.float64]

    @property
    def valid(self) -> NDArray[np.bool_]:
        """The pixels, (N,), that have an estimate."""
        return np.isfinite(self.found)

    def only_valid(self) -> JudgedPixels:
        """Return the pixels that have an estimate."""
        valid = self.valid
        if valid.all():
            return self
        return JudgedPixels(self.found[valid], self.true[valid], self.weight[valid])

    def scaled(self, scale: float) -> JudgedPixels:
        """Return the same pixels with all estimates multiplied by a factor."""
        return self if scale == 1 else JudgedPixels(scale * self.found, self.true, self.weight)

    def by_truth(self) -> JudgedPixels:
        """Return the same pixels from the nearest to the farthest."""
        order = np.argsort(self.true, kind="stable")
        return JudgedPixels(self.found[order], self.true[order], self.weight[order])


def has_range(ranges: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the pixels, of the same shape, that hold a range: a finite one above zero."""
    held: NDArray[np.bool_] = np.isfinite(ranges) & (ranges > 0)
    return held


def judged_pixels(
    estimated: NDArray[np.floating],
    truth: NDArray[np.floating],
    *,
    scale: float = 1.0,
    mask: NDArray[np.bool_] | None = None,
) -> JudgedPixels:
    """Return the pixels that have truth, with what was estimated of them.

    Args:
        estimated: (H, W) ranges in scene units; what is not finite or not positive is no estimate.
        truth: (H, W) true ranges; pixels with anything but a positive finite one are left out.
        scale: factor from scene units to the truth's unit.
        mask: (H, W), False leaves a pixel out.

    Raises:
        UsageError: if the shapes differ or the scale is not positive.
    """
    if estimated.shape != truth.shape or truth.ndim != 2 or (mask is not None and mask.shape != truth.shape):
        raise UsageError(f"estimated {estimated.shape}, truth {truth.shape} and mask must be (H, W) of one size")
    if not scale > 0:
        raise UsageError(f"the scale from scene units to the truth's must be positive, got {scale}")
    counted = has_range(truth)
    if mask is not None:
        counted &= mask
    found = estimated[counted].astype(np.float64)
    weight = np.broadcast_to(pixel_solid_angle((truth.shape[0], truth.shape[1]))[:, None], truth.shape)[counted]
    found[~has_range(found)] = np.nan
    found *= scale
    return JudgedPixels(found, truth[counted].astype(np.float64), weight)


def aligning_scale(pixels: JudgedPixels, align: Align) -> float:
    """Return the factor that fits the estimates to the truth; 1 for "none", and where no pixel has both.

    "median" is the weighted median of the truth over that of the estimates, "lsq" the factor s with the least sum of
    squares Σ Ω (s d − t)², s = Σ Ω d t / Σ Ω d², both over the pixels that have an estimate d of their truth t, each by
    its solid angle Ω. A fitted score is not one of the paper's protocol, in which the truth's ranges are never used.
    """
    both = pixels.only_valid()
    if align == "none" or not len(both.true):
        return 1.0
    if align == "median":
        return weighted_median(both.true, both.weight) / weighted_median(both.found, both.weight)
    return float(np.sum(both.weight * both.found * both.true) / np.sum(both.weight * both.found**2))


def weighted_median(values: NDArray[np.floating], weight: NDArray[np.float64]) -> float:
    """Return the smallest value at which half the weight is reached; NaN of nothing."""
    return weighted_quantile(values, weight, 0.5)


def weighted_quantile(values: NDArray[np.floating], weight: NDArray[np.float64], share: float) -> float:
    """Return the smallest value (N,) at which a share of the weight (N,) is reached; NaN of nothing."""
    if not len(values):
        return float("nan")
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weight[order])
    return float(values[order[np.searchsorted(reached, reached[-1] * share)]])
