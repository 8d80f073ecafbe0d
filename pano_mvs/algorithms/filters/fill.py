"""Fill holes of a range map from reliable pixels around them, unless they are too large."""

from __future__ import annotations

from typing import Annotated

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.data_term import MaxHoleDeg
from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.algorithms.panoramas import columns_per_step
from pano_mvs.core.arrays import Mask
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import pad_panorama, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE


def large_holes(valid: Mask, max_hole_deg: float) -> Mask:
    """Return the invalid pixels, (H, W), within a disc of more than `max_hole_deg` without any valid pixel.

    On the sphere, this is the morphological opening of the hole by a disc: a sky stays a hole right to its edge, except
    for corners narrower than the disc, whatever cracks and small holes are connected to it. (Neither the size of a
    connected hole nor the distance to its border could separate these.)

    `valid`: (H, W), the full sphere, even W. `max_hole_deg`: diameter of the largest disc; 0 returns no pixel.

    Raises:
        UsageError: if max_hole_deg is negative.
    """
    if max_hole_deg < 0:
        raise UsageError(f"max_hole_deg must not be negative, got {max_hole_deg}")
    if max_hole_deg == 0 or valid.all():
        return np.zeros_like(valid)
    if not valid.any():
        return np.ones_like(valid)
    rays = ray_grid((valid.shape[0], valid.shape[1]))
    reach = 2 * np.sin(np.radians(min(max_hole_deg, 359.0)) / 4)  # the chord of half the diameter
    core = np.zeros_like(valid)
    core[~valid] = _distances(rays, rim(valid), ~valid, reach=reach) > reach
    if not core.any():
        return core
    large = core.copy()
    near = ~valid & ~core
    large[near] = _distances(rays, rim(core), near, reach=reach) <= reach
    return large


def rim(inside: Mask) -> Mask:
    """Return border pixels of a set, including the pixel that is nearest to any pixel outside.

    These are the pixels with a neighbour outside, across the seam and the poles, and all pixels near the poles, where
    pixels far from each other in the grid are close on the sphere.
    """
    padded = pad_panorama(inside, 1)
    height, width = inside.shape
    surrounded = np.ones_like(inside)
    for row in range(3):
        for column in range(3):
            surrounded &= padded[row : row + height, column : column + width]
    near_pole = height // 16 + 1
    surrounded[:near_pole] = surrounded[-near_pole:] = False
    edge: Mask = inside & ~surrounded
    return edge


def _distances(rays: NDArray[np.float64], goals: Mask, starts: Mask, *, reach: float) -> NDArray[np.float64]:
    """Return the chord from each start to the nearest goal, (N,); inf if it is longer than `reach`."""
    tree = scipy.spatial.KDTree(rays[goals], balanced_tree=False, compact_nodes=False)
    return np.asarray(tree.query(rays[starts], distance_upper_bound=reach * (1 + 1e-12))[0], np.float64)


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
    # Neighbours with an inverse range larger than this times the background's belong to an occluder.
    inverse, distance = fill_holes(known, wanted, trusted, columns, min(max_distance_px, height), 1.25)
    filled = distance > 0
    ranges, confidence = range_map.range.copy(), range_map.confidence.copy()
    ranges[filled] = 1 / inverse[filled]
    low, high = FILLED_CONFIDENCE
    share = np.clip((distance[filled] - 1) / max_distance_px, 0, 1)
    confidence[filled] = np.rint(high - (high - low) * share)
    return with_ranges(range_map, ranges, confidence)
