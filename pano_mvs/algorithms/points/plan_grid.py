"""Storeys of a place, and their grids seen from above, filled with parts of a cloud."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray

_BINS = 400
# A camera that is higher than this times the height of the lowest one above its floor stands on another floor.
_SAME_STOREY = 2.0
_QUANTILES = (0.005, 0.995)


@dataclass(frozen=True)
class Storey:
    """One storey.

    `floor`: height of the floor. `ceiling`: height of the ceiling. `cameras`: positions, in the list of cameras, of
    those that stand on the floor. `has_floor`: whether a level surface was found there; otherwise it is the lowest part
    of the cloud. `has_ceiling`: the same of the ceiling.
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

    `heights`: (N,) heights of the points, or of an even sample of them. `normal_heights`: (N,) upward components of
    their unit normals. `camera_heights`: (M,) heights of the cameras; with none, the cloud is one storey.
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
        found = levels(facing_up[(facing_up > below) & (facing_up < lowest)], step)
        floor = found[0] if found else max(low, below) if low < lowest else lowest - (high - low) / 2
        limit = floor + _SAME_STOREY * (lowest - floor)
        here = order[camera_heights[order] <= limit]
        if found or not floors:
            floors.append((floor, bool(found), sorted(int(idx) for idx in here)))
            below = float(np.median(camera_heights[here]))  # one may stand on stairs
        else:  # higher than others on one floor
            floors[-1] = (*floors[-1][:2], sorted([*floors[-1][2], *(int(idx) for idx in here)]))
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
    middle = float(np.median(camera_heights[cameras]))
    limit = floors[number + 1][0] if number + 1 < len(floors) else np.inf
    found = levels(facing_down[(facing_down > middle) & (facing_down < limit)], step)
    ceiling = found[-1] if found else min(limit, floor + _SAME_STOREY * (middle - floor), max(top, middle))
    return Storey(floor, float(ceiling), tuple(cameras), has_floor, bool(found))


def levels(heights: FloatArray, step: float) -> list[float]:
    """Return the heights of large level surfaces, in rising order."""
    if len(heights) < 50:
        return []
    start = float(heights.min())
    counts = np.bincount(((heights - start) / step).astype(np.int64)).astype(np.float64)
    density = scipy.ndimage.gaussian_filter1d(np.pad(counts, 4), 1.5, mode="constant")
    inner = density[1:-1]
    peaks = 1 + np.flatnonzero((inner >= density[:-2]) & (inner > density[2:]))
    strong = peaks[density[peaks] >= 0.25 * density.max()]
    middles = [start + (peak - 4 + 0.5) * step for peak in strong]
    return [float(np.median(heights[np.abs(heights - middle) < 3 * step])) for middle in middles]


@dataclass(frozen=True)
class Extent:
    """Where a grid lies: its pixels are squares, and its first row is the farthest along y.

    `left`: x of the left edge. `top`: y of the upper edge. `pixel`: edge of a pixel in scene units. `size_hw`: rows and
    columns.
    """

    left: float
    top: float
    pixel: float
    size_hw: tuple[int, int]

    def with_pixel(self, pixel: float) -> Extent:
        """Return a grid of other pixels that covers at least the same area."""
        rows, columns = (math.ceil(size * self.pixel / pixel) for size in self.size_hw)
        return Extent(self.left, self.top, pixel, (rows, columns))

    def cells(self, xy: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the flat index (N,) of the pixel of each point (N, 2), and whether it is inside."""
        column = np.floor((xy[:, 0] - self.left) / self.pixel).astype(np.int64)
        row = np.floor((self.top - xy[:, 1]) / self.pixel).astype(np.int64)
        rows, columns = self.size_hw
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        return np.where(inside, row * columns + column, 0), inside

    def centers(self) -> FloatArray:
        """Return the positions (N, 2) of the centres of all pixels, row by row."""
        rows, columns = self.size_hw
        x, y = self.left + (np.arange(columns) + 0.5) * self.pixel, self.top - (np.arange(rows) + 0.5) * self.pixel
        return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


class Orthophoto:
    """The highest point below a cut in each pixel of one storey, or the lowest one above it.

    The result does not depend on the order of the points. Memory: 8 bytes a pixel.
    """

    def __init__(self, storey: Storey, extent: Extent, *, cut: float, from_below: bool = False) -> None:
        """Start with an empty picture.

        Args:
            storey: whose floor and ceiling bound the points.
            extent: of the picture.
            cut: height of the cut; points above are left out, or from below, those below.
            from_below: show the lowest points above the cut, as a mirror on the floor does: x and y stay.
        """
        self.extent = extent
        self._far = storey.ceiling + 0.05 * storey.height if from_below else storey.floor - 0.05 * storey.height
        self._cut = cut
        self._photo = np.zeros(extent.size_hw[0] * extent.size_hw[1], np.int64)

    def add(self, points: FloatArray, colors_rgb: NDArray[np.uint8]) -> None:
        """Add points (N, 3) with z up and their colours (N, 3)."""
        index, inside = self.extent.cells(points[:, :2])
        depth = abs(self._cut - self._far)
        nearness = np.abs(points[:, 2] - self._far)
        inside &= (nearness <= depth) & (np.abs(points[:, 2] - self._cut) <= depth)
        share = nearness[inside] / max(depth, 1e-12)
        level = 1 + (share * ((1 << 20) - 2)).astype(np.int64)
        red, green, blue = colors_rgb[inside].astype(np.int64).T
        np.maximum.at(self._photo, index[inside], (level << 24) | (red << 16) | (green << 8) | blue)

    def picture(self) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return the picture (H, W, 3) RGB, with small gaps filled, and the pixels (H, W) that show something."""
        packed = self._photo.reshape(self.extent.size_hw)
        known = packed > 0
        image = np.stack([(packed >> shift) & 255 for shift in (16, 8, 0)], axis=-1).astype(np.uint8)
        if not known.any() or known.all():
            return image, known
        distance, labels = cv2.distanceTransformWithLabels(
            (~known).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
        )
        near = distance <= 6
        colors = np.zeros((int(labels.max()) + 1, 3), np.uint8)
        colors[labels[known]] = image[known]
        return np.where(near[..., None], colors[labels], np.uint8(0)), near


def bar_length(width: float) -> float:
    """Return a round length (1, 2 or 5 times a power of ten) of at most a quarter of a width.

    >>> bar_length(10.0), bar_length(0.9)
    (2.0, 0.2)
    """
    power = 10.0 ** np.floor(np.log10(width / 4))
    return float(next(step * power for step in (5, 2, 1) if step * power <= width / 4 * (1 + 1e-9)))


def bar_text(length: float, unit: str) -> str:
    """Return a round length with its unit, as text."""
    return f"{length:g} {unit.removesuffix('s') if length == 1 else unit}"
