"""The z-depth of a pinhole view, pixel by pixel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import PinholeView, pixel_from_ray
from tests.oracles.range_filters import sample_range


def z_depth(ranges: NDArray[np.float32], view: PinholeView, max_step: float = 0.05) -> NDArray[np.float64]:
    result = np.full(view.size_hw, np.nan)
    for row, column in np.ndindex(view.size_hw):
        bearing = view.bearings_from_pixels((column + 0.5, row + 0.5))
        found = sample_range(ranges, pixel_from_ray(bearing, ranges.shape), max_step)
        result[row, column] = found * float(bearing @ view.view_from_cam[2])
    return result
