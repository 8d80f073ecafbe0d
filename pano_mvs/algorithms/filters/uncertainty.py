"""Standard deviations of ranges, from parallax and from the agreement between views.

A match is precise to some angle, and the parallax in the sources converts that angle into a relative error of the
range. The angle is not known, but it shows: where matches are poor, ranges of different views disagree, and fewer
pixels are confirmed. The factors were fitted to renders with known ranges (three places) and checked on five others;
`tests/benchmarks/uncertainty.py` measures them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.sphere.box import box_sum
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

UNCONFIRMED_UNCERTAINTY = 0.15
"""Relative standard deviation of ranges that no other view confirms: weak, moved and filled ones."""

# The one factor that was fitted: errors per rms reprojection error. Views share errors, so it is larger than 1.
_SCALE = 2.2
_PRECISION_RADIUS, _SHARE_RADIUS = 4, 8
# Smaller reprojection errors are chance, and windows with fewer confirmed pixels are equally unreliable.
_MIN_ERROR_PX, _MIN_SHARE = 0.02, 0.1
# Near steps like this, in ln range, a pixel may have the range of the other surface.
_STEP, _STEP_WEIGHT = 0.1, 5.0
_LEAST, _MOST = 0.0005, 0.5


def confirmed_uncertainty(
    consistent: Mask,
    seen: Mask,
    *,
    support: FloatArray,
    squared_error: FloatArray,
    motion: FloatArray,
    step: NDArray[np.float32],
) -> NDArray[np.float16]:
    """Return the relative standard deviation of ranges, (H, W); `UNCONFIRMED_UNCERTAINTY` where they are not confirmed.

    σ = 2.2 e (1 + 5 d) / (p² M). M is the parallax: the motion of the pixel in its sources per relative change of its
    range. e is the rms reprojection error of the confirmed pixels within 4 pixels, weighted by their support. p is the
    confirmed share of the pixels within 8 pixels that were seen, and d the share of pixels at steps of the range.

    Args:
        consistent: (H, W) pixels that other views confirm.
        seen: (H, W) pixels that were seen, which include these.
        support: (H, W) sum of the supports of the sources.
        squared_error: (H, W) sum of supports times squared reprojection errors, in pixels².
        motion: (H, W) M in pixels.
        step: (H, W) ln(largest / smallest range) around the pixel.
    """
    near, wide = (max(1, min(radius, len(seen) // 2 - 1)) for radius in (_PRECISION_RADIUS, _SHARE_RADIUS))
    sigma = box_sum(np.where(consistent, squared_error, 0), near)
    sigma /= np.maximum(box_sum(np.where(consistent, support, 0), near), 1e-9)
    sigma = np.maximum(np.sqrt(np.maximum(sigma, 0)), _MIN_ERROR_PX)
    sigma /= _share(consistent, seen, wide) ** 2
    sigma *= 1 + _STEP_WEIGHT * _share(step > _STEP, np.ones_like(seen), wide, least=0)
    sigma *= _SCALE / np.maximum(motion, 1e-9)
    return np.where(consistent, np.clip(sigma, _LEAST, _MOST), UNCONFIRMED_UNCERTAINTY).astype(np.float16)


def _share(part: Mask, whole: Mask, radius: int, *, least: float = _MIN_SHARE) -> FloatArray:
    """Return the share of the pixels of a set within a window that are in a part of it."""
    share = box_sum(part.astype(np.float64), radius)
    share /= np.maximum(box_sum(whole.astype(np.float64), radius), 1)
    return np.asarray(np.maximum(share, least))


def replaced_uncertainty(
    before: RangeMap, ranges: NDArray[np.float32], confidence: NDArray[np.uint8]
) -> NDArray[np.float16] | None:
    """Return the relative standard deviation, (H, W), after ranges were replaced; None if it was not known before.

    A change of a confirmed range by a share δ adds to its uncertainty: hypot(σ, δ). Other changed ranges, and ranges of
    pixels that had none, are as uncertain as unconfirmed ones.

    Args:
        before: the range map with the ranges that were replaced.
        ranges: (H, W) the new ranges, NaN is invalid.
        confidence: (H, W) the new confidences.
    """
    if before.uncertainty is None:
        return None
    valid = np.isfinite(ranges)
    kept = valid & (ranges == before.range)
    with np.errstate(invalid="ignore"):
        moved = np.hypot(before.uncertainty.astype(np.float32), ranges / before.range - 1)
    moved = np.clip(moved, _LEAST, _MOST)
    confirmed = valid & (confidence >= CONSISTENT_CONFIDENCE[0]) & np.isfinite(moved)
    other = np.where(confirmed, moved, np.float32(UNCONFIRMED_UNCERTAINTY)).astype(np.float16)
    return np.where(kept, before.uncertainty, np.where(valid, other, np.float16(np.nan)))
