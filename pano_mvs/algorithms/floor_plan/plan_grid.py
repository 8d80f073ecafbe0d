"""Storeys of a place, and their grids seen from above, filled with parts of a cloud; the drawn plan."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

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
    if len(heights) < 50:
        return []
    start = float(heights.min())
    counts = np.bincount(((heights - start) / step).astype(np.int64)).astype(np.float64)
    density = gaussian_filter1d(np.pad(counts, 4), 1.5, mode="constant")
    inner = density[1:-1]
    peaks = 1 + np.flatnonzero((inner >= density[:-2]) & (inner > density[2:]))
    strong = peaks[density[peaks] >= 0.25 * density.max()]
    middles = [start + (peak - 4 + 0.5) * step for peak in strong]
    return [float(np.median(heights[np.abs(heights - middle) < 3 * step])) for middle in middles]


LAYERS = 32
"""Number of layers between floor and ceiling in which walls are looked for."""

_WALL_FROM, _WALL_TO = 0.08, 0.95
_HEIGHT_BITS = 20


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

    def coarser(self, factor: int) -> Extent:
        """Return a grid of larger pixels that covers at least the same area."""
        rows, columns = (-(-size // factor) for size in self.size_hw)
        return Extent(self.left, self.top, self.pixel * factor, (rows, columns))

    def cells(self, xy: FloatArray) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the flat index (N,) of the pixel of each point (N, 2), and whether it is inside."""
        column = np.floor((xy[:, 0] - self.left) / self.pixel).astype(np.int64)
        row = np.floor((self.top - xy[:, 1]) / self.pixel).astype(np.int64)
        rows, columns = self.size_hw
        inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
        return np.where(inside, row * columns + column, 0), inside

    def pixels_from_xy(self, xy: FloatArray) -> FloatArray:
        """Return positions (..., 2) as column and row; (0, 0) is the upper left corner of the grid."""
        return np.stack([xy[..., 0] - self.left, self.top - xy[..., 1]], axis=-1) / self.pixel


@dataclass(frozen=True, eq=False)
class WallCells:
    """Cells of a plan with vertical surfaces.

    `xy`: (N, 2) mean position of the points in each cell. `normals_xy`: (N, 2) unit normals, on the side that was seen.
    `shares`: (N,) share of the layers between floor and ceiling with such points in the cell or beside it. `weights`:
    (N,) number of layers with such points in the cell. `cell`: edge of a cell.
    """

    xy: FloatArray
    normals_xy: FloatArray
    shares: FloatArray
    weights: FloatArray
    cell: float

    def only(self, chosen: NDArray[np.bool_]) -> WallCells:
        """Return some of the cells."""
        return WallCells(self.xy[chosen], self.normals_xy[chosen], self.shares[chosen], self.weights[chosen], self.cell)


class PlanGrid:
    """The orthophoto and the walls of one storey.

    The orthophoto shows the highest point below a cut, in each pixel. The result does not depend on the order of the
    points. Memory: 8 bytes a pixel, and 44 bytes a cell of the walls.
    """

    def __init__(self, storey: Storey, extent: Extent, *, cut: float, cell_px: int) -> None:
        """Start with empty grids.

        Args:
            storey: whose floor and ceiling bound the points.
            extent: of the orthophoto.
            cut: height of the cut; points above are not in the orthophoto.
            cell_px: edge of a cell of the walls in pixels.
        """
        self.storey = storey
        self.extent = extent
        self.walls = extent.coarser(cell_px)
        self._cut = cut
        self._photo = np.zeros(extent.size_hw[0] * extent.size_hw[1], np.int64)
        cells = self.walls.size_hw[0] * self.walls.size_hw[1]
        self._layers = np.zeros(cells, np.uint32)
        self._sums = np.zeros((cells, 5))  # x, y, their normal's, number

    def add(self, points: FloatArray, normals: FloatArray, colors_rgb: NDArray[np.uint8]) -> None:
        """Add points (N, 3) with z up, their unit normals (N, 3) and colours (N, 3)."""
        self._add_photo(points, colors_rgb)
        self._add_walls(points, normals)

    def photo(self) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
        """Return the orthophoto (H, W, 3) RGB, with small gaps filled, and the pixels (H, W) that show something."""
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

    def wall_cells(self) -> WallCells:
        """Return the cells with vertical surfaces."""
        rows, columns = self.walls.size_hw
        beside = self._layers.reshape(rows, columns).copy()
        for axis in (0, 1):
            padded = np.pad(beside, [(1, 1) if number == axis else (0, 0) for number in (0, 1)])
            size = beside.shape[axis]
            parts = [np.take(padded, range(start, start + size), axis=axis) for start in range(3)]
            beside = parts[0] | parts[1] | parts[2]
        used = np.flatnonzero(self._layers)
        sums = self._sums[used]
        lengths = np.linalg.norm(sums[:, 2:4], axis=1)
        sure = lengths > 0.3 * sums[:, 4]  # points whose normals agree
        used, sums, lengths = used[sure], sums[sure], lengths[sure]
        return WallCells(
            xy=sums[:, :2] / sums[:, 4:],
            normals_xy=sums[:, 2:4] / lengths[:, None],
            shares=_bits(beside.reshape(-1)[used]) / LAYERS,
            weights=_bits(self._layers[used]).astype(np.float64),
            cell=self.walls.pixel,
        )

    def _add_photo(self, points: FloatArray, colors_rgb: NDArray[np.uint8]) -> None:
        low = self.storey.floor - 0.05 * self.storey.height
        index, inside = self.extent.cells(points[:, :2])
        inside &= (points[:, 2] >= low) & (points[:, 2] <= self._cut)
        share = (points[inside, 2] - low) / max(self._cut - low, 1e-12)
        level = 1 + (share * ((1 << _HEIGHT_BITS) - 2)).astype(np.int64)
        red, green, blue = colors_rgb[inside].astype(np.int64).T
        np.maximum.at(self._photo, index[inside], (level << 24) | (red << 16) | (green << 8) | blue)

    def _add_walls(self, points: FloatArray, normals: FloatArray) -> None:
        share = (points[:, 2] - self.storey.floor) / max(self.storey.height, 1e-12)
        index, inside = self.walls.cells(points[:, :2])
        inside &= (share > _WALL_FROM) & (share < _WALL_TO) & (np.abs(normals[:, 2]) < 0.35)
        layer = ((share[inside] - _WALL_FROM) / (_WALL_TO - _WALL_FROM) * LAYERS).astype(np.uint32)
        chosen = index[inside]
        np.bitwise_or.at(self._layers, chosen, np.uint32(1) << np.minimum(layer, LAYERS - 1))
        values = np.column_stack([points[inside, :2], normals[inside, :2], np.ones(len(chosen))])
        for column in range(5):
            self._sums[:, column] += np.bincount(chosen, values[:, column], len(self._sums))


def _bits(masks: NDArray[np.uint32]) -> NDArray[np.int64]:
    """Return the number of bits that are set in each mask."""
    bits = np.unpackbits(masks.astype("<u4").view(np.uint8).reshape(-1, 4), axis=1)
    return np.asarray(bits.sum(axis=1), np.int64)


_PAPER, _INK, _CAMERA = (255, 255, 255), (24, 32, 56), (214, 72, 36)
_SUBPIXEL_BITS = 4


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


def strip_px(size_hw: tuple[int, int]) -> int:
    """Return the rows of the strip for the scale bar below a plan of a size."""
    return max(36, round(0.06 * max(size_hw)))


def draw_plan(
    photo: NDArray[np.uint8],
    known: NDArray[np.bool_],
    extent: Extent,
    *,
    walls: FloatArray,
    cameras: FloatArray,
    unit: str,
) -> NDArray[np.uint8]:
    """Return the picture of a plan (H + strip, W, 3) RGB: the strip below the plan has the scale bar.

    `photo`: (H, W, 3) RGB orthophoto. `known`: (H, W) pixels that show something; others are white. `extent`: of the
    orthophoto. `walls`: (N, 2, 2) ends of wall lines. `cameras`: (M, 2) positions of cameras. `unit`: of lengths,
    beside the scale bar.
    """
    height, width = extent.size_hw
    image = np.full((height + strip_px(extent.size_hw), width, 3), _PAPER, np.uint8)
    image[:height][known] = photo[known]
    thickness = max(2, round(width / 350))
    for x1, y1, x2, y2 in _subpixels(extent.pixels_from_xy(walls)).reshape(-1, 4).tolist():
        cv2.line(image, (x1, y1), (x2, y2), _INK, thickness, cv2.LINE_AA, _SUBPIXEL_BITS)
    radius = max(3, width // 150) << _SUBPIXEL_BITS
    for x, y in _subpixels(extent.pixels_from_xy(cameras)).reshape(-1, 2).tolist():
        cv2.circle(image, (x, y), radius, _PAPER, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
        cv2.circle(image, (x, y), int(0.7 * radius), _CAMERA, -1, cv2.LINE_AA, _SUBPIXEL_BITS)
    image[height:] = _PAPER
    _draw_bar(image[height:], extent.pixel, unit)
    return image


def _draw_bar(strip: NDArray[np.uint8], pixel: float, unit: str) -> None:
    rows, columns = strip.shape[:2]
    length = bar_length(columns * pixel)
    left, right, middle = rows // 3, rows // 3 + round(length / pixel), rows // 2
    tick = max(3, rows // 8)
    thickness = max(1, rows // 24)
    for start, end in (
        ((left, middle), (right, middle)),
        ((left, middle - tick), (left, middle + tick)),
        ((right, middle - tick), (right, middle + tick)),
    ):
        cv2.line(strip, start, end, _INK, thickness)
    size = rows / 60
    place = (right + rows // 4, middle + round(8 * size))
    cv2.putText(strip, f"{length:g} {unit}", place, cv2.FONT_HERSHEY_SIMPLEX, size, _INK, thickness, cv2.LINE_AA)


def _subpixels(xy: FloatArray) -> NDArray[np.int64]:
    """Return positions as OpenCV's fixed-point numbers, whose pixels have their centres at whole numbers."""
    return np.rint((xy - 0.5) * (1 << _SUBPIXEL_BITS)).astype(np.int64)
