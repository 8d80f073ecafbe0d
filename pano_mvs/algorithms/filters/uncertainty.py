"""Standard deviations of ranges, from parallax and from the agreement between views.

A match is precise to some angle, and the parallax in the sources converts that angle into a relative error of the
range. The angle is not known, but it shows: where matches are poor, ranges of different views disagree, surfaces are
rough, and few pixels around are confirmed. `tools/benchmarks/uncertainty.py` fits the exponents to places with known
ranges, leaving out each place in turn.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import box_sum
from pano_mvs.algorithms.ranges.agreement import Comparison
from pano_mvs.core.arrays import FloatArray, Mask
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE

UNCONFIRMED_UNCERTAINTY = 0.15
"""Relative standard deviation of ranges that no other view confirms: weak, moved and filled ones."""

LEAST_UNCERTAINTY, MOST_UNCERTAINTY = 0.0005, 0.5

FACTOR = 1.953
EXPONENTS = {"motion": -0.85, "error": 0.69, "roughness": 0.3, "steps": 0.65, "confirmed": -1.56, "opposed": 0.45}
"""Fitted by `python -m tools benchmarks uncertainty`: of what `error_factors` returns."""


def probability_within(sigma: FloatArray, error: float) -> FloatArray:
    """Return the probability that a range with a relative standard deviation is within a relative error.

    Errors have long tails: half of them are below 0.3 σ. The form was fitted to errors of 2 %; where it says less than
    a half, more ranges are right than it says.
    """
    return np.asarray(error / (error + 0.3 * sigma))


def confirmed_uncertainty(
    consistent: Mask, ranges: NDArray[np.float32], comparison: Comparison, *, step: NDArray[np.float32]
) -> NDArray[np.float16]:
    """Return the relative standard deviation of ranges, (H, W); `UNCONFIRMED_UNCERTAINTY` where they are not confirmed.

    It is half of what 95 % of the errors are below: a product of powers of `error_factors`.

    `consistent`: (H, W) pixels that other views confirm. `ranges`: (H, W), finite where consistent. `comparison`: of
    each pixel with its sources. `step`: (H, W) ln(largest / smallest range) around the pixel.
    """
    sigma = np.ones(ranges.shape)
    for name, values in error_factors(consistent, ranges, comparison, step=step):
        sigma *= values ** EXPONENTS[name]
    sigma = np.clip(FACTOR * sigma, LEAST_UNCERTAINTY, MOST_UNCERTAINTY)
    return np.where(consistent, sigma, UNCONFIRMED_UNCERTAINTY).astype(np.float16)


def error_factors(
    consistent: Mask, ranges: NDArray[np.float32], comparison: Comparison, *, step: NDArray[np.float32]
) -> Iterator[tuple[str, FloatArray]]:
    """Yield what errors of confirmed ranges depend on, names and (H, W), all positive; one by one, to save memory.

    `motion`: M, the motion of the pixel in its sources per relative change of its range, in pixels. `error`: the rms
    reprojection error of the confirmed pixels within 4 pixels, weighted by their support, in pixels. `roughness`: the
    rms relative deviation of the confirmed ranges within 2 pixels from their means, times M, in pixels. `steps`: 1 + 5
    times the share of pixels within 8 pixels near which the range steps by a tenth, where a pixel may have the range of
    the other surface. `confirmed`: the share of pixels within 4 pixels that are confirmed. `opposed`: 1 + the number of
    sources that see through the pixel, or something before it.
    """
    near, rough, wide = (max(1, min(radius, len(ranges) // 2 - 1)) for radius in (4, 2, 8))
    px_per_rad = ranges.shape[1] / (2 * np.pi)
    motion = np.maximum(px_per_rad * np.sqrt(comparison.motion), 1e-6)
    yield "motion", motion
    # Smaller reprojection errors, and less roughness, are chance.
    error = box_sum(np.where(consistent, comparison.squared_error, 0), near)
    error /= np.maximum(box_sum(np.where(consistent, comparison.support, 0), near), 1e-9)
    yield "error", np.maximum(px_per_rad * np.sqrt(np.maximum(error, 0)), 0.02)
    del error
    # The rms relative deviation of 1/range from the mean around it, of the consistent pixels of a window.
    inverse = np.where(consistent, 1 / np.where(consistent, ranges, 1).astype(np.float64), 0)
    count = np.maximum(box_sum(consistent.astype(np.float64), rough), 1)
    mean = np.maximum(box_sum(inverse, rough) / count, 1e-12)
    deviation = box_sum(np.where(consistent, (inverse / mean - 1) ** 2, 0), rough) / count
    yield "roughness", np.maximum(np.sqrt(np.maximum(deviation, 0)) * motion, 0.01)
    del motion, inverse, count, mean, deviation
    yield "steps", 1 + 5 * _share(step > 0.1, wide)
    yield "confirmed", np.maximum(_share(consistent, near), 0.05)
    yield "opposed", (1 + comparison.contradicting + comparison.hiding).astype(np.float64)


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
