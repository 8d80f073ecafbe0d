"""Find holes of a range map that are too large to be filled from their borders."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from pano_mvs.core.arrays import Mask
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import pad_panorama, ray_grid


def large_holes(valid: Mask, max_hole_deg: float) -> Mask:
    """Return the invalid pixels, (H, W), within a disc of more than `max_hole_deg` without any valid pixel.

    On the sphere, this is the morphological opening of the hole by a disc: a sky stays a hole right to its edge, except
    for corners narrower than the disc, whatever cracks and small holes are connected to it. (Neither the size of a
    connected hole nor the distance to its border could separate these.)

    Args:
        valid: (H, W), the full sphere, even W.
        max_hole_deg: diameter of the largest disc; 0 returns no pixel.

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
    tree = KDTree(rays[goals], balanced_tree=False, compact_nodes=False)
    return np.asarray(tree.query(rays[starts], distance_upper_bound=reach * (1 + 1e-12))[0], np.float64)
