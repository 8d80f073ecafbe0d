"""Fill holes of a range map from reliable pixels around them."""

from __future__ import annotations

from typing import Annotated

import numpy as np

from pano_mvs.algorithms.filters.holes import large_holes
from pano_mvs.algorithms.filters.replacement import with_ranges
from pano_mvs.algorithms.filters.settings import MaxHoleDeg
from pano_mvs.algorithms.filters.sphere.steps import columns_per_step
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE

# Neighbours with an inverse range larger than this times the background's belong to an occluder.
_MAX_RATIO = 1.25


@checks_settings
def fill_from_neighbours(
    range_map: RangeMap,
    *,
    max_distance_px: Annotated[int, Setting("search distance, in pixels at the equator", ge=1)] = 48,
    min_confidence: Annotated[
        int, Setting("minimum confidence of pixels to fill from", ge=1, le=255)
    ] = CONSISTENT_CONFIDENCE[0],
    max_hole_deg: MaxHoleDeg = 20.0,
) -> RangeMap:
    """Fill invalid pixels with the range of the background surface.

    From each invalid pixel, eight paths run over the sphere (across the seam and the poles, as wide as high) to the
    first reliable pixel. A hole beside an edge is mostly an area that the nearer surface occludes in other views, so it
    belongs to the farther surface: the second largest of the ranges found is the background (Hirschmüller, "Stereo
    processing by semiglobal matching and mutual information", 2008, section 2.5.4), and ranges nearer than that by more
    than a quarter are ignored. The inverse ranges of the others are averaged with weights 1 / distance, which between
    two opposite pixels is linear interpolation, exact on a plane. Filled pixels are not used for other pixels.

    Args:
        range_map: (H, W) with even W, the full sphere.
        max_distance_px: maximum length of a path, in pixels at the equator; no path is longer than from pole to pole.
        min_confidence: minimum confidence of reliable pixels; 128 is consistent.
        max_hole_deg: holes that contain a larger disc stay invalid (`large_holes`), since a sky has no range; 0 fills
            all.

    Returns:
        The range map; filled pixels have a confidence from 63, next to a reliable pixel, down to 1.

    Raises:
        UsageError: if a setting is out of bounds.
    """
    height, width = range_map.range.shape
    from pano_mvs.algorithms.filters.kernels_fill import fill_holes  # compiles on import

    wanted = ~range_map.valid & ~large_holes(range_map.valid, max_hole_deg)
    trusted = range_map.valid & (range_map.confidence >= min_confidence)
    known = 1 / range_map.range.astype(np.float64)
    columns = columns_per_step((height, width), steps=8)
    inverse, distance = fill_holes(known, wanted, trusted, columns, min(max_distance_px, height), _MAX_RATIO)
    filled = distance > 0
    ranges, confidence = range_map.range.copy(), range_map.confidence.copy()
    ranges[filled] = 1 / inverse[filled]
    low, high = FILLED_CONFIDENCE
    share = np.clip((distance[filled] - 1) / max_distance_px, 0, 1)
    confidence[filled] = np.rint(high - (high - low) * share)
    return with_ranges(range_map, ranges, confidence)
