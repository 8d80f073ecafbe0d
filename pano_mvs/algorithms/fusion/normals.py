"""Estimate surface normals on a range map's grid."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.fusion.view import held_rays
from pano_mvs.algorithms.panoramas import columns_per_step
from pano_mvs.core.bands import for_bands
from pano_mvs.core.errors import UsageError
from pano_mvs.scene import RangeMap


def normals_from_range(
    range_map: RangeMap | NDArray[np.float32],
    *,
    given: NDArray[np.float32] | None = None,
    wanted: NDArray[np.bool_] | None = None,
    threads: int = 1,
) -> NDArray[np.float32]:
    """Return the unit normal of the surface at each pixel, towards the camera.

    A plane that does not contain the camera's centre is p · X = 1, so on a ray F the inverse range is 1/r = p · F:
    linear in p. p is the weighted least-squares fit over a window, and −p/|p| the normal. The window is measured on the
    sphere: it crosses the seam and the poles, and uses every ⌈1/cos φ⌋-th column, so that it is isotropic. A neighbour
    k steps away whose inverse range differs by more than k · 0.05 is on another surface and has no weight; nearer ones
    have Tukey's biweight of that ratio.

    `range_map`: a range map, or its ranges (H, W) with even W; NaN is invalid. `given`: (H, W, 3) known normals, NaN
    where unknown; None: all unknown. `wanted`: (H, W) pixels at which to fit a plane; None: all. `threads`: number of
    threads; the result does not depend on it.

    Returns:
        (H, W, 3) float32 in the camera frame; NaN if the range is invalid or fewer than 5 pixels of the window are on
        the same surface.

    Raises:
        UsageError: if the ranges are not (H, W) with even W and H ≥ 2.
    """
    from pano_mvs.algorithms.fusion.kernels_fuse import fit_normals  # compiles on import

    ranges = range_map.range if isinstance(range_map, RangeMap) else range_map
    radius = 2  # half the width of the window in pixels at the equator
    if ranges.ndim != 2 or ranges.shape[1] % 2 or ranges.shape[0] < radius:
        raise UsageError(f"normals need ranges (H, W) with even W and H ≥ {radius}, got {ranges.shape}")
    height, width = ranges.shape
    inverse = 1 / ranges.astype(np.float64)
    stretches = columns_per_step((height, width), steps=2 * radius + 1)
    rays = held_rays((height, width))
    at = np.ones((height, width), np.bool_) if wanted is None else wanted
    normals = np.full((height, width, 3), np.nan, np.float32) if given is None else given.astype(np.float32)

    def fit(first: int, rows: int) -> None:
        fit_normals((inverse, rays, at), stretches, radius, 0.05, (first, first + rows), normals)

    for_bands(fit, height, threads=threads)
    return normals
