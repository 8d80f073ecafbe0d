"""The z-depth of a pinhole view, pixel by pixel."""

import numpy as np

from pano_mvs.geometry import pixel_from_ray
from tests.oracles.range_filters import wrap


def z_depth(ranges, view, max_step=0.05):
    height, width = ranges.shape
    result = np.full(view.size_hw, np.nan)
    for row, column in np.ndindex(view.size_hw):
        bearing = view.bearings_from_pixels((column + 0.5, row + 0.5))
        x, y = pixel_from_ray(bearing, ranges.shape) - 0.5
        left, top = int(np.floor(x)), int(np.floor(y))
        share_x, share_y = x - left, y - top
        corners = [(top + i, left + j, (share_y, 1 - share_y)[i == 0] * (share_x, 1 - share_x)[j == 0])
                   for i in (0, 1) for j in (0, 1)]  # fmt: skip
        values = [float(ranges[wrap(i, j, height, width)]) for i, j, _ in corners]
        if np.isfinite(values).all() and max(values) <= min(values) * (1 + max_step):
            found = 1 / sum(weight / value for (_, _, weight), value in zip(corners, values, strict=True))
        else:
            found = ranges[wrap(int(np.floor(y + 0.5)), int(np.floor(x + 0.5)), height, width)]
        result[row, column] = found * float(bearing @ view.view_from_cam[2])
    return result
