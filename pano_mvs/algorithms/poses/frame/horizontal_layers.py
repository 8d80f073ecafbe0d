"""Level surfaces among sparse points: floors, tables and ceilings are layers along the vertical."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pano_mvs.algorithms.poses.frame.vertical_lines import directions_around
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import angle_between

# Search around a given up direction: half width and step in degrees, layer thickness relative to the typical range.
_ROUNDS = ((20.0, 2.0, 0.04), (2.0, 0.5, 0.02), (0.5, 0.1, 0.01))
_MIN_POINTS = 100
_PARTS = 4
_CONTRAST_HALF_DEG, _CONTRAST_STEP_DEG = 8.0, 1.0
_BINS_PER_WIDTH = 2.0


@dataclass(frozen=True, eq=False)
class Layers:
    """The direction along which points lie in the sharpest layers; falsy, with the reason, if there is none."""

    up: FloatArray  # (3,) unit vector
    contrast: float  # sharpness of the layers relative to the median direction within 8°
    reason: str = ""  # why there is none; else ""
    uncertainty_deg: float = float("nan")  # standard deviation of the direction, from four parts of the points

    def __bool__(self) -> bool:
        return not self.reason


def sharpest_up(points: FloatArray, centers: FloatArray, up: FloatArray) -> Layers:
    """Return the direction within 20° of `up` along which the points' heights are most concentrated.

    Concentration is the integral of the squared density of heights (the exponential of the negative Rényi entropy of
    order 2). It is large for level surfaces and decreases with any tilt.

    Args:
        points: (P, 3) in the world.
        centers: (N, 3) camera centres in the world.
        up: (3,) unit vector around which to search.
    """
    if len(points) < _MIN_POINTS:
        return Layers(up, 0.0, f"{len(points)} sparse points are too few for level surfaces; {_MIN_POINTS} are needed")
    offsets = points - np.median(centers, axis=0)
    ranges = np.linalg.norm(offsets, axis=1)
    typical = float(np.median(ranges))
    near = offsets[ranges < 3 * typical] / typical
    best, width = up, 0.0
    for half_deg, step_deg, width in _ROUNDS:
        candidates = directions_around(best, half_deg, step_deg)
        best = candidates[int(np.argmax([_concentration(near @ candidate, width) for candidate in candidates]))]
    others = directions_around(best, _CONTRAST_HALF_DEG, _CONTRAST_STEP_DEG)
    usual = np.median([_concentration(near @ other, width) for other in others])
    contrast = float(_concentration(near @ best, width) / usual)
    # Minimum ratio of the sharpness of the layers to the median over all directions within 8°. Sparse points of rooms,
    # 200 to 4,000 of them, give 1.3 to 2.0; points without level surfaces 1.0 to 1.2.
    if contrast < 1.3:
        return Layers(up, contrast, f"the sparse points show no clear level surfaces (contrast {contrast:.2f})")
    return Layers(best, contrast, uncertainty_deg=_scatter_deg(near, best))


def _scatter_deg(points: FloatArray, up: FloatArray) -> float:
    """Return the standard deviation of the mean of the directions of four parts of the points."""
    offs = []
    for part in range(_PARTS):
        found = up
        for half_deg, step_deg, width in _ROUNDS[1:]:
            candidates = directions_around(found, half_deg, step_deg)
            sharpness = [_concentration(points[part::_PARTS] @ candidate, width) for candidate in candidates]
            found = candidates[int(np.argmax(sharpness))]
        offs.append(float(np.rad2deg(angle_between(found, up))))
    return float(np.hypot(np.sqrt(np.mean(np.square(offs)) / _PARTS), _ROUNDS[-1][1]))


def _concentration(heights: FloatArray, width: float) -> float:
    """Return the integral of the squared density of heights, smoothed to a given width."""
    step = width / _BINS_PER_WIDTH
    positions = (heights - heights.min()) / step
    lower = positions.astype(np.int64)
    fractions = positions - lower
    size = int(lower.max()) + 2
    counts = np.bincount(lower, 1 - fractions, size) + np.bincount(lower + 1, fractions, size)
    smooth = gaussian_filter1d(counts, _BINS_PER_WIDTH, mode="constant")
    return float(np.sum(smooth**2)) / (step * len(heights) ** 2)
