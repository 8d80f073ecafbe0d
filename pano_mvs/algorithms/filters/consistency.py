"""Keep of a range map what the neighbouring views confirm, and doubt the rest."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE

# Four neighbouring source pixels further apart than this are two surfaces: no value lies between them.
_MAX_SURFACE_STEP = 0.05


def check_consistency(
    reference: RangeMap,
    reference_pose: Rigid3,
    sources: Sequence[RangeMap],
    source_poses: Sequence[Rigid3],
    *,
    max_relative_error: float = 0.02,
    max_reprojection_px: float = 1.0,
    min_views: int = 1,
    remove_inconsistent: bool = False,
    min_contradictions: int = 2,
) -> RangeMap:
    """Return the reference's range map with its confidence set by what the sources confirm.

    Forward and backward: the point at range r along a pixel's ray is projected into a source, X' = R r F(u) + t. The
    source's own range s there must equal |X'| within `max_relative_error`, and the source's point at s, seen from the
    reference, must lie within `max_reprojection_px` of the pixel (Schönberger et al., "Pixelwise view selection for
    unstructured multi-view stereo", 2016, section 4.3, on the sphere). Where s is smaller something hides the point
    and the source has no say. Where s is larger by more than twice the limit the source sees through the point: it
    contradicts. Ranges of the sources that were filled, not seen, have no say either.

    Confidence of a pixel that was seen and that n ≥ `min_views` sources confirm, with mean relative error e:
    128 + ⌊127 (1 − 2⁻ⁿ) (1 − e / (2 max_relative_error))⌋. Otherwise it is weak and keeps its confidence clipped to
    64–127; filled pixels keep theirs.

    Args:
        reference: (H, W) range map, full sphere.
        reference_pose: its cam_from_world.
        sources: range maps, (H', W') each, in any order: the result does not depend on it.
        source_poses: cam_from_world of each.
        max_relative_error: largest |s − |X'|| / |X'|.
        max_reprojection_px: largest angle between pixel and reprojection, in pixels of the reference at the equator.
        min_views: number of sources that must confirm a pixel.
        remove_inconsistent: whether to invalidate pixels that no source confirms and `min_contradictions` contradict.
        min_contradictions: how many sources must contradict; no more than there are sources.

    Raises:
        UsageError: if sources and poses differ in number, or a limit is not positive.
    """
    if len(sources) != len(source_poses):
        raise UsageError(f"{len(sources)} source range maps but {len(source_poses)} poses: give one pose for each")
    if not (max_relative_error > 0 and max_reprojection_px > 0 and min_views >= 1 and min_contradictions >= 1):
        raise UsageError("the limits of the consistency check must be positive")
    limits = np.array(
        [max_relative_error, max_reprojection_px * 2 * np.pi / reference.range.shape[1], _MAX_SURFACE_STEP]
    )
    confirming, contradicting, error = _count_verdicts(reference, reference_pose, sources, source_poses, limits)
    grade = (1 - 0.5**confirming) * (1 - error / (2 * max_relative_error))
    low, high = CONSISTENT_CONFIDENCE
    graded = np.floor(low + (high - low) * grade).astype(np.uint8)
    weak = np.clip(reference.confidence, *WEAK_CONFIDENCE)
    seen = reference.confidence >= WEAK_CONFIDENCE[0]
    confidence = np.where(seen, np.where(confirming >= min_views, graded, weak), reference.confidence)
    ranges = reference.range
    if remove_inconsistent and sources:
        removed = (confirming == 0) & (contradicting >= min(min_contradictions, len(sources)))
        ranges = np.where(removed, np.float32(np.nan), ranges)
    confidence[np.isnan(ranges)] = 0
    return RangeMap(ranges, confidence)


def _count_verdicts(
    reference: RangeMap,
    reference_pose: Rigid3,
    sources: Sequence[RangeMap],
    source_poses: Sequence[Rigid3],
    limits: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return per pixel how many sources confirm, how many contradict, and the mean relative error of the former."""
    from pano_mvs.algorithms.filters.kernels_reprojection import AGREES, CONTRADICTS, judge_view  # compiles on import

    shape = reference.range.shape
    confirming, contradicting = np.zeros(shape, np.int64), np.zeros(shape, np.int64)
    total = np.zeros(shape)
    rays = ray_grid((shape[0], shape[1]))
    for source, pose in zip(sources, source_poses, strict=True):
        source_from_reference = pose @ reference_pose.inverse()
        verdicts, errors = judge_view(
            np.ascontiguousarray(reference.range),
            rays,
            np.ascontiguousarray(source_from_reference.rotation),
            np.ascontiguousarray(source_from_reference.translation),
            seen_ranges(source, min_confidence=WEAK_CONFIDENCE[0]),
            limits,
        )
        confirming += verdicts == AGREES
        contradicting += verdicts == CONTRADICTS
        # Rounded, so that the sum of a few does not depend on the order of the sources.
        total += np.where(verdicts == AGREES, np.rint(errors.astype(np.float64) * 2**40) / 2**40, 0.0)
    return confirming, contradicting, total / np.maximum(confirming, 1)


def seen_ranges(range_map: RangeMap, *, min_confidence: int) -> NDArray[np.float32]:
    """Return the ranges, (H, W) float32, NaN where the confidence is lower than `min_confidence`."""
    ranges: NDArray[np.float32] = np.where(range_map.confidence >= min_confidence, range_map.range, np.float32(np.nan))
    return np.ascontiguousarray(ranges)
