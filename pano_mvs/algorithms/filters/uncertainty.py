"""Standard deviations of ranges, from parallax and from the agreement between views.

A match is precise to some angle, and the parallax in the sources converts that angle into a relative error of the
range. The angle is not known, but it shows: where matches are poor, ranges of different views disagree, and surfaces
are rough. The factors were fitted to synthetic places with known ranges, leaving out each place in turn, and checked
on rendered ones; `tools/benchmarks/uncertainty.py` measures them.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import box_sum
from pano_mvs.core.arrays import FloatArray, Mask
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

UNCONFIRMED_UNCERTAINTY = 0.15
"""Relative standard deviation of ranges that no other view confirms: weak, moved and filled ones."""

# The one factor that was fitted: errors per rms reprojection error. Views share errors, so it is larger than 1.
_SCALE = 5.4
_PRECISION_RADIUS, _ROUGH_RADIUS, _STEP_RADIUS = 4, 2, 8
# Smaller reprojection errors, and less roughness, are chance; both in pixels.
_MIN_ERROR_PX, _MIN_ROUGH_PX = 0.02, 0.01
# Near steps like this, in ln range, a pixel may have the range of the other surface.
_STEP, _STEP_WEIGHT, _STEP_POWER = 0.1, 5.0, 1 / 3
LEAST_UNCERTAINTY, MOST_UNCERTAINTY = 0.0005, 0.5


def confirmed_uncertainty(
    consistent: Mask,
    ranges: NDArray[np.float32],
    *,
    support: FloatArray,
    squared_error: FloatArray,
    motion: FloatArray,
    step: NDArray[np.float32],
) -> NDArray[np.float16]:
    """Return the relative standard deviation of ranges, (H, W); `UNCONFIRMED_UNCERTAINTY` where they are not confirmed.

    σ = 5.4 e (ρ M)^¼ (1 + 5 d)^⅓ / M. M is the parallax: the motion of the pixel in its sources per relative change of
    its range. e is the rms reprojection error of the confirmed pixels within 4 pixels, weighted by their support. ρ is
    the roughness of the surface: the rms relative deviation of the confirmed ranges within 2 pixels from their means,
    so that ρ M is in pixels. d is the share of pixels at steps of the range within 8 pixels.

    `consistent`: (H, W) pixels that other views confirm. `ranges`: (H, W), finite where consistent. `support`: (H, W)
    sum of the supports of the sources. `squared_error`: (H, W) sum of supports times squared reprojection errors, in
    pixels². `motion`: (H, W) M in pixels. `step`: (H, W) ln(largest / smallest range) around the pixel.
    """
    near, rough, wide = (
        max(1, min(radius, len(ranges) // 2 - 1)) for radius in (_PRECISION_RADIUS, _ROUGH_RADIUS, _STEP_RADIUS)
    )
    sigma = box_sum(np.where(consistent, squared_error, 0), near)
    sigma /= np.maximum(box_sum(np.where(consistent, support, 0), near), 1e-9)
    sigma = np.maximum(np.sqrt(np.maximum(sigma, 0)), _MIN_ERROR_PX)
    motion = np.maximum(motion, 1e-9)
    # The rms relative deviation of 1/range from the mean around it, of the consistent pixels of a window.
    inverse = np.where(consistent, 1 / np.where(consistent, ranges, 1).astype(np.float64), 0)
    count = np.maximum(box_sum(consistent.astype(np.float64), rough), 1)
    mean = np.maximum(box_sum(inverse, rough) / count, 1e-12)
    deviation = box_sum(np.where(consistent, (inverse / mean - 1) ** 2, 0), rough) / count
    sigma *= np.maximum(np.sqrt(np.maximum(deviation, 0)) * motion, _MIN_ROUGH_PX) ** 0.25  # errors grow slowly with it
    sigma *= (1 + _STEP_WEIGHT * _share(step > _STEP, wide)) ** _STEP_POWER
    sigma *= _SCALE / motion
    return np.where(consistent, np.clip(sigma, LEAST_UNCERTAINTY, MOST_UNCERTAINTY), UNCONFIRMED_UNCERTAINTY).astype(
        np.float16
    )


def _share(part: Mask, radius: int) -> FloatArray:
    """Return the share of the pixels of a window that are in a part of it."""
    share = box_sum(part.astype(np.float64), radius)
    return np.asarray(share / box_sum(np.ones(part.shape), radius))


def replaced_uncertainty(
    before: RangeMap, ranges: NDArray[np.float32], confidence: NDArray[np.uint8]
) -> NDArray[np.float16] | None:
    """Return the relative standard deviation, (H, W), after ranges were replaced; None if it was not known before.

    A change of a confirmed range by a share δ adds to its uncertainty: hypot(σ, δ). Other changed ranges, and ranges of
    pixels that had none, are as uncertain as unconfirmed ones.

    `before`: the range map with the ranges that were replaced. `ranges`: (H, W) the new ranges, NaN is invalid.
    `confidence`: (H, W) the new confidences.
    """
    if before.uncertainty is None:
        return None
    valid = np.isfinite(ranges)
    changed = valid & (ranges != before.range)
    with np.errstate(invalid="ignore"):
        share = ranges[changed] / before.range[changed] - 1
        moved = np.hypot(before.uncertainty[changed].astype(np.float32), share)
    moved = np.clip(moved, LEAST_UNCERTAINTY, MOST_UNCERTAINTY)
    confirmed = (confidence[changed] >= CONSISTENT_CONFIDENCE[0]) & np.isfinite(moved)
    found = np.where(valid, before.uncertainty, np.float16(np.nan))
    found[changed] = np.where(confirmed, moved, np.float32(UNCONFIRMED_UNCERTAINTY)).astype(np.float16)
    return found


def with_ranges(
    range_map: RangeMap, ranges: NDArray[np.float32], confidence: NDArray[np.uint8] | None = None
) -> RangeMap:
    """Return a range map with other ranges (H, W), and other confidences if given.

    Normals are kept where the range did not change; for the uncertainty see `replaced_uncertainty`. The sky gets no
    range.
    """
    confidence = range_map.confidence if confidence is None else confidence
    if range_map.sky is not None:
        ranges = np.where(range_map.sky, np.float32(np.nan), ranges)
        confidence = np.where(range_map.sky, np.uint8(0), confidence)
    normals = range_map.normals_in_cam
    if normals is not None:
        normals = normals.copy()
        normals[ranges != range_map.range] = np.nan
    uncertainty = replaced_uncertainty(range_map, ranges, confidence)
    return RangeMap(ranges, confidence, normals, uncertainty, range_map.sky)
