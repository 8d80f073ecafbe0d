"""Storeys: floors and ceilings from the heights of level surfaces and of the cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d

from pano_mvs.core.arrays import FloatArray

_BINS = 400
_SMOOTHING_BINS = 1.5
_STRONG_SHARE = 0.25
# A camera that is higher than this times the height of the lowest one above its floor stands on another floor.
_SAME_STOREY = 2.0
_MIN_POINTS = 50
_QUANTILES = (0.005, 0.995)


@dataclass(frozen=True)
class Storey:
    """One storey.

    Attributes:
        floor: height of the floor.
        ceiling: height of the ceiling.
        cameras: positions, in the list of cameras, of those that stand on the floor.
        has_floor: whether a level surface was found there; otherwise it is the lowest part of the cloud.
        has_ceiling: the same of the ceiling.
    """

    floor: float
    ceiling: float
    cameras: tuple[int, ...]
    has_floor: bool = True
    has_ceiling: bool = True

    @property
    def height(self) -> float:
        """Height of the ceiling above the floor."""
        return self.ceiling - self.floor


def find_storeys(heights: FloatArray, normal_heights: FloatArray, camera_heights: FloatArray) -> list[Storey]:
    """Return the storeys on which cameras stand, the lowest first.

    A floor is the lowest large level surface that faces up, below the cameras that stand on it and above those of the
    storey below. A ceiling is the highest large one that faces down, below the next floor.

    Args:
        heights: (N,) heights of the points, or of an even sample of them.
        normal_heights: (N,) upward components of their unit normals.
        camera_heights: (M,) heights of the cameras; with none, the cloud is one storey.
    """
    if not len(heights):
        return []
    low, high = (float(value) for value in np.quantile(heights, _QUANTILES))
    if not len(camera_heights):
        return [Storey(low, high, (), has_floor=False, has_ceiling=False)]
    step = max(high - low, 1e-9) / _BINS
    facing_up, facing_down = heights[normal_heights > 0.9], heights[normal_heights < -0.9]
    order = np.argsort(camera_heights, kind="stable")
    floors: list[tuple[float, bool, list[int]]] = []
    below = -np.inf
    while len(order):
        lowest = float(camera_heights[order[0]])
        found = _levels(facing_up[(facing_up > below) & (facing_up < lowest)], step)
        floor = found[0] if found else max(low, below) if low < lowest else lowest - (high - low) / 2
        limit = floor + _SAME_STOREY * (lowest - floor)
        here = order[camera_heights[order] <= limit]
        floors.append((floor, bool(found), sorted(int(idx) for idx in here)))
        below = float(camera_heights[here].max())
        order = order[camera_heights[order] > limit]
    return [
        _with_ceiling(number, floors, camera_heights, facing_down=facing_down, step=step, top=high)
        for number in range(len(floors))
    ]


def _with_ceiling(
    number: int,
    floors: list[tuple[float, bool, list[int]]],
    camera_heights: FloatArray,
    *,
    facing_down: FloatArray,
    step: float,
    top: float,
) -> Storey:
    floor, has_floor, cameras = floors[number]
    highest = float(camera_heights[cameras].max())
    limit = floors[number + 1][0] if number + 1 < len(floors) else np.inf
    found = _levels(facing_down[(facing_down > highest) & (facing_down < limit)], step)
    usual = floor + _SAME_STOREY * (highest - floor)
    ceiling = found[-1] if found else min(limit, max(usual, highest), max(top, highest))
    return Storey(floor, float(ceiling), tuple(cameras), has_floor, bool(found))


def _levels(heights: FloatArray, step: float) -> list[float]:
    """Return the heights of large level surfaces, in rising order."""
    if len(heights) < _MIN_POINTS:
        return []
    start = float(heights.min())
    counts = np.bincount(((heights - start) / step).astype(np.int64)).astype(np.float64)
    density = gaussian_filter1d(np.pad(counts, 4), _SMOOTHING_BINS, mode="constant")
    inner = density[1:-1]
    peaks = 1 + np.flatnonzero((inner >= density[:-2]) & (inner > density[2:]))
    strong = peaks[density[peaks] >= _STRONG_SHARE * density.max()]
    middles = [start + (peak - 4 + 0.5) * step for peak in strong]
    return [float(np.median(heights[np.abs(heights - middle) < 3 * step])) for middle in middles]
