"""The z-depth of a pinhole view, pixel by pixel."""

import numpy as np

from pano_mvs.geometry import pixel_from_ray
from tests.oracles.range_filters import sample_range


def z_depth(ranges, view, max_step=0.05):
    result = np.full(view.size_hw, np.nan)
    for row, column in np.ndindex(view.size_hw):
        bearing = view.bearings_from_pixels((column + 0.5, row + 0.5))
        found = sample_range(ranges, pixel_from_ray(bearing, ranges.shape), max_step)
        result[row, column] = found * float(bearing @ view.view_from_cam[2])
    return result
