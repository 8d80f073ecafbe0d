"""Compiled: z-depth of a pinhole view from the range map of a panorama."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.kernels_reprojection import sample_range
from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import pixel_from_ray

FloatArray = NDArray[np.float64]


@kernel
def z_depth_rows(
    first: int,
    rows: int,
    ranges: NDArray[np.float32],
    view: tuple[FloatArray, float, float, float],
    max_step: float,
    z_depth: NDArray[np.float32],
) -> None:
    """Write the z-depths of some rows of a view.

    Args:
        first: the first row.
        rows: number of rows.
        ranges: (H, W) float32 of the panorama, NaN invalid.
        view: (rotation view_from_cam (3, 3), focal length in px, principal point x, y).
        max_step: as in `sample_range`.
        z_depth: (h, w) float32, written.
    """
    rotation, focal, center_x, center_y = view
    height, width = ranges.shape
    for row in range(first, first + rows):
        b = (row + 0.5 - center_y) / focal
        for column in range(z_depth.shape[1]):
            a = (column + 0.5 - center_x) / focal
            ray_x = rotation[0, 0] * a + rotation[1, 0] * b + rotation[2, 0]
            ray_y = rotation[0, 1] * a + rotation[1, 1] * b + rotation[2, 1]
            ray_z = rotation[0, 2] * a + rotation[1, 2] * b + rotation[2, 2]
            x, y = pixel_from_ray(ray_x, ray_y, ray_z, height, width)
            z_depth[row, column] = sample_range(ranges, x, y, max_step) / math.sqrt(1 + a * a + b * b)
