"""Whether a view sees a point, by its range map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, angle_between, pixel_from_ray
from pano_mvs.scene import RangeMap
from tests.oracles.range_filters import sample_range


def sees(
    point: NDArray[np.float64],
    home: NDArray[np.float64],
    pose: Rigid3,
    range_map: RangeMap,
    max_error: float,
    min_confidence: int,
    max_step: float = 0.05,
) -> tuple[NDArray[np.float64], float] | None:
    """The unit ray to the point, and the angle at `home` between it and where the view puts it; None if unseen."""
    in_cam = pose.apply(point)
    distance = np.linalg.norm(in_cam)
    pixel = pixel_from_ray(in_cam, range_map.range.shape)
    found = sample_range(range_map.range, pixel, max_step)
    column, row = np.floor(pixel).astype(int)
    if not abs(found - distance) <= max_error * distance or range_map.confidence[row, column] < min_confidence:
        return None
    there = pose.inverse().apply(in_cam / distance * found)
    angle = float(angle_between(point - home, there - home))
    return (in_cam / distance, angle) if angle <= 2 * np.pi / range_map.range.shape[1] else None
