"""The floor below cameras: the lowest level surface among sparse points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.text import plural

# The floor: density along the logarithm of the depth below the cameras, which makes it independent of the unit.
_LOG_WIDTH = 0.03
_LOG_STEP = 0.005
_STEEPEST_SHARE = 0.25
_MIN_FLOOR_POINTS = 12


@dataclass(frozen=True)
class Floor:
    """The depth of the floor below the cameras; falsy, with the reason, if no floor was found."""

    depth: float  # median height of the cameras above the floor, scene units
    points: int = 0  # number of sparse points on the floor
    spread: float = 0.0  # median distance of these points from the floor, scene units
    reason: str = ""  # why no floor was found; else ""

    def __bool__(self) -> bool:
        return not self.reason


def floor_below(points: FloatArray, centers: FloatArray, up: FloatArray) -> Floor:
    """Return the lowest level surface that contains many points below the cameras.

    Args:
        points: (P, 3) in the world.
        centers: (N, 3) camera centres in the world, all at about the same height above one floor.
        up: (3,) unit vector away from gravity.
    """
    from scipy.ndimage import gaussian_filter1d  # slow to import

    heights = centers @ up
    depths = float(np.median(heights)) - points @ up
    lowest = float(np.median(heights) - heights.min())
    offsets = points - np.median(centers, axis=0)
    aside = np.linalg.norm(offsets - (offsets @ up)[:, None] * up, axis=1)
    below = depths[(depths > lowest) & (depths > 0) & (depths > _STEEPEST_SHARE * aside)]
    if len(below) < _MIN_FLOOR_POINTS:
        return Floor(
            0.0, reason=f"only {len(below)} sparse {plural(len(below), 'point lies', 'points lie')} below the cameras"
        )
    logs = np.log(below)
    counts = np.bincount(((logs - logs.min()) / _LOG_STEP).astype(np.int64))
    density = gaussian_filter1d(np.pad(counts.astype(np.float64), 1), _LOG_WIDTH / _LOG_STEP, mode="constant")
    peaks = 1 + np.flatnonzero((density[1:-1] >= density[:-2]) & (density[1:-1] > density[2:]))
    strong = peaks[density[peaks] >= _STEEPEST_SHARE * density.max()]
    depth_log = logs.min() + (strong[-1] - 0.5) * _LOG_STEP
    on_floor = below[np.abs(logs - depth_log) < 2 * _LOG_WIDTH]
    if len(on_floor) < _MIN_FLOOR_POINTS:
        return Floor(0.0, reason=f"no level surface below the cameras contains {_MIN_FLOOR_POINTS} sparse points")
    depth = float(np.median(on_floor))
    return Floor(depth, len(on_floor), float(np.median(np.abs(on_floor - depth))))
