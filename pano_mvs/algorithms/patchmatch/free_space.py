"""Correct unconfirmed ranges that contradict what the other views see.

A pixel at range r claims that there is a surface at its point, and nothing between that point and the camera. The
confirmed ranges of the other views test both: a view that sees something farther away through the point contradicts the
surface, and a confirmed point nearer on the pixel's ray contradicts the free space before it. Most contradictions are
beside a foreground, where few sources see the background and a sweep or a solver continues the foreground instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np

from pano_mvs.algorithms.filters.confidence import require_confidence
from pano_mvs.algorithms.filters.consistency import compare_with_sources
from pano_mvs.algorithms.filters.holes import large_holes
from pano_mvs.algorithms.filters.replacement import with_ranges
from pano_mvs.algorithms.filters.settings import MaxHoleDeg
from pano_mvs.algorithms.patchmatch.exchange import project_range_map
from pano_mvs.core.arrays import FloatImage, Mask
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE

# A source agrees with a pixel if its own point, seen from the reference, lies within this angle.
_SAME_RAY_DEG = 0.7


@checks_settings
def respect_free_space(
    range_map: RangeMap,
    pose: Rigid3,
    sources: Sequence[RangeMap],
    *,
    source_poses: Sequence[Rigid3],
    max_relative_error: Annotated[
        float, Setting("relative difference of ranges from which on they contradict each other", gt=0, le=0.5)
    ] = 0.05,
    max_hole_deg: MaxHoleDeg = 20.0,
) -> tuple[RangeMap, float, float]:
    """Replace unconfirmed ranges behind confirmed points of other views, and remove those that other views see through.

    Only confirmed pixels of the sources (confidence 128 or more) count as evidence, and only pixels that were seen but
    are not confirmed are changed. First, the confirmed points of the sources are projected into the reference. Where
    the nearest of them is nearer than a pixel's range by more than `max_relative_error`, the pixel takes its range.
    Then each source is asked for the ranges that remain (`compare_with_sources`): a pixel becomes invalid if more
    sources see through its point than agree with it. A later filter fills it from its surroundings.

    Args:
        range_map: (H, W) after `check_consistency`, the full sphere.
        pose: its cam_from_world.
        sources: range maps after the same check, in any order: the result does not depend on it.
        source_poses: cam_from_world of each.
        max_relative_error: smallest relative difference of ranges that contradict each other.
        max_hole_deg: no pixel is removed where a hole would contain a larger disc, which no filter fills
            (`large_holes`); 0: there is no limit.

    Returns:
        The range map, the share of valid pixels with a nearer range, and the share that became invalid. Replaced ranges
        are weak (confidence 64–127): that a point is visible from elsewhere does not confirm that it is visible here.

    Raises:
        UsageError: if sources and poses differ in number, or a setting is out of bounds.
    """
    if len(sources) != len(source_poses):
        raise UsageError(f"{len(sources)} source range maps but {len(source_poses)} poses: give one pose per source")
    confirmed = [require_confidence(source, min_confidence=CONSISTENT_CONFIDENCE[0]) for source in sources]
    moved = [other @ pose.inverse() for other in source_poses]
    weak = (range_map.confidence >= WEAK_CONFIDENCE[0]) & (range_map.confidence <= WEAK_CONFIDENCE[1])
    nearest = _nearest_points(confirmed, moved, range_map.range.shape)
    with np.errstate(invalid="ignore"):
        hidden = weak & (nearest < range_map.range * (1 - max_relative_error))
    ranges = np.where(hidden, nearest, range_map.range)
    seen_through = weak & _seen_through(
        np.where(weak, ranges, np.float32(np.nan)), confirmed, moved, max_relative_error=max_relative_error
    )
    seen_through &= ~large_holes(range_map.valid & ~seen_through, max_hole_deg)
    ranges[seen_through] = np.nan
    confidence = np.where(hidden, np.uint8(WEAK_CONFIDENCE[1]), range_map.confidence)
    confidence[seen_through] = 0
    valid = max(int(range_map.valid.sum()), 1)
    shares = float((hidden & ~seen_through).sum() / valid), float(seen_through.sum() / valid)
    return with_ranges(range_map, ranges, confidence), *shares


def _nearest_points(
    sources: Sequence[RangeMap], source_from_reference: Sequence[Rigid3], size_hw: tuple[int, int]
) -> FloatImage:
    """Return the nearest range at which a pixel of a source lands in each pixel, (H, W); inf where none lands."""
    nearest = np.full(size_hw, np.inf, np.float32)
    for source, moved in zip(sources, source_from_reference, strict=True):
        landed, _ = project_range_map(replace(source, normals_in_cam=None), moved, size_hw)
        nearest = np.fmin(nearest, landed)
    return nearest


def _seen_through(
    ranges: FloatImage,
    sources: Sequence[RangeMap],
    source_from_reference: Sequence[Rigid3],
    *,
    max_relative_error: float,
) -> Mask:
    """Return where more sources see through a point than agree with it, (H, W)."""
    comparison = compare_with_sources(
        ranges,
        sources,
        source_from_reference,
        # A source contradicts from twice this error on.
        max_relative_error=max_relative_error / 2,
        max_angle=np.radians(_SAME_RAY_DEG),
    )
    return np.asarray(comparison.contradicting > comparison.agreeing)
