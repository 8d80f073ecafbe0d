"""Errors of range maps, without the plugin that scores them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import pixel_solid_angle


@dataclass(frozen=True)
class RangeErrors:
    """Errors of one range map at the pixels with truth, where a missing range counts as 0."""

    psnr_db: float  # over the pixels, of a peak of 10 units
    mae: float  # by solid angle
    near: float  # the share of the solid angle with errors within a ratio of 1.05
    completeness: float  # the share of pixels that have a range
    median: float  # of the relative errors of those


def errors_of_ranges(estimated: NDArray[np.floating], truth: NDArray[np.floating]) -> RangeErrors:
    """Return the errors of ranges (H, W), NaN where there is none, against true ones (H, W), in the same unit."""
    known = np.isfinite(truth)
    weight = np.broadcast_to(pixel_solid_angle((truth.shape[0], truth.shape[1]))[:, None], truth.shape)[known]
    found, true = estimated[known].astype(np.float64), truth[known].astype(np.float64)
    has = np.isfinite(found)
    error = np.where(has, np.abs(found - true), true)
    with np.errstate(invalid="ignore"):
        near = np.maximum(found, true) < 1.05 * np.minimum(found, true)
    return RangeErrors(
        psnr_db=float(-10 * np.log10(np.mean((error / 10) ** 2))),
        mae=float(np.average(error, weights=weight)),
        near=float(np.average(near, weights=weight)),
        completeness=float(has.mean()),
        median=float(np.median(error[has] / true[has])),
    )
