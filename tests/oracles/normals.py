"""The weighted plane fit around each pixel, by numpy's least squares."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import ray_grid
from tests.oracles.range_filters import wrap


def normals(
    ranges: NDArray[np.float32], radius: int, max_step: float, columns_per_step: NDArray[np.int64]
) -> NDArray[np.float64]:
    height, width = ranges.shape
    rays = ray_grid(ranges.shape)
    result = np.full((height, width, 3), np.nan)
    for row, column in np.argwhere(np.isfinite(ranges)):
        equations, values = [], []
        for d_row in range(-radius, radius + 1):
            for d_column in range(-radius, radius + 1):
                other = wrap(row + d_row, column + d_column * columns_per_step[row], height, width)
                value = float(ranges[row, column]) / float(ranges[other])
                deviation = abs(value - 1) / (max_step * max(abs(d_row), abs(d_column), 1))
                if deviation < 1:
                    equations.append((1 - deviation**2) * rays[other])
                    values.append((1 - deviation**2) * value)
        if len(equations) >= 5:
            plane = np.linalg.lstsq(np.array(equations), np.array(values), rcond=None)[0]
            result[row, column] = -plane / np.linalg.norm(plane)
    return result
