"""Lines of the walls of a storey: known planes, and a Hough transform on the other cells with vertical surfaces.

Each cell supports the one line through it that its normal determines. The line with the most support takes its cells
and is fitted to them; then the rest are searched again. Both sides of a wall give a line each, because normals are on
the side that was seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs_floor_plan.evidence import LAYERS, WallCells

_ANGLE_BINS = 180
# Cells belong to a line if they are this close, in cells, and their normals this similar.
_NEAR_CELLS, _TAKEN_CELLS = 1.0, 2.0
_LEAST_COSINE = np.cos(np.deg2rad(25.0))


@dataclass(frozen=True, eq=False)
class Line:
    """The line normal · x = offset; its normal is on the side that was seen."""

    normal: FloatArray
    offset: float

    @property
    def along(self) -> FloatArray:
        """The direction that has the side that was seen on its left."""
        return np.array([self.normal[1], -self.normal[0]])

    def holds(self, cells: WallCells, *, within: float) -> NDArray[np.bool_]:
        """Return which cells face the same side, at a distance of at most `within` cells."""
        near = np.abs(cells.xy @ self.normal - self.offset) <= within * cells.cell
        return np.asarray(near & (cells.normals_xy @ self.normal >= _LEAST_COSINE))


def wall_lines(cells: WallCells, known: Sequence[Line], *, min_share: float, min_length: float) -> list[Line]:
    """Return the lines of walls, those that are known first.

    `cells`: with vertical surfaces. `known`: lines of planes that others found. `min_share`: share of the layers at
    which a wall must be seen, over a length along it of `min_length`. What is seen just below the ceiling alone is a
    beam, however long.
    """
    min_area = min_length / cells.cell * min_share * LAYERS
    found: list[Line] = []
    held: list[WallCells] = []

    def take(line: Line) -> None:
        nonlocal cells
        near = cells.only(line.holds(cells, within=_NEAR_CELLS))
        if near.layers.sum() >= max(min_area, 1) and _is_wall(line, near, min_share=min_share, min_length=min_length):
            found.append(line)
            held.append(near)
            cells = cells.only(~line.holds(cells, within=_TAKEN_CELLS))

    for line in known:
        take(line)
    left = 0
    while len(cells.xy) != left:
        left = len(cells.xy)
        if left:
            line, support = _strongest(cells)
            if support >= min_area:
                take(_fitted(line, cells))
                cells = cells.only(~line.holds(cells, within=_TAKEN_CELLS))
    return _aligned(found, held)


def _is_wall(line: Line, cells: WallCells, *, min_share: float, min_length: float) -> bool:
    """Return whether a share of the layers has vertical surfaces over a length along a line, in three or more bins."""
    bin_length = min_length / 3
    _, inverse = np.unique(np.floor(cells.xy @ line.along / bin_length).astype(np.int64), return_inverse=True)
    layers = np.zeros((int(inverse.max()) + 1, LAYERS), np.bool_)
    np.logical_or.at(layers, inverse.reshape(-1), cells.layers)
    return bool((layers.sum(axis=1) >= min_share * LAYERS).sum() >= 3)


def _aligned(lines: Sequence[Line], held: Sequence[WallCells]) -> list[Line]:
    """Return lines turned to directions that several have, or at right angles to them, about the middle of each."""
    weights = np.array([cells.layers.sum() for cells in held], np.float64)
    angles = np.array([np.arctan2(line.normal[1], line.normal[0]) for line in lines])
    result = []
    for line, cells, angle in zip(lines, held, angles, strict=True):
        turns = (angles - angle + np.pi / 4) % (np.pi / 2) - np.pi / 4
        across, along = (float(np.std(cells.xy @ one)) for one in (line.normal, line.along))
        within = max(np.radians(1.0), 3 * across / max(along, cells.cell))
        near = weights * (1 - (turns / within) ** 2).clip(0) ** 2
        turn = angle + float(near @ turns / near.sum())
        normal = np.array([np.cos(turn), np.sin(turn)])
        middle = np.average(cells.xy, axis=0, weights=cells.layers.sum(axis=1))
        shift = float(middle @ line.normal - line.offset)
        result.append(Line(normal, float(middle @ normal) - shift))
    return result


def _strongest(cells: WallCells) -> tuple[Line, float]:
    """Return the line with the most support, and how much that is."""
    normals, weights = cells.normals_xy, cells.layers.sum(axis=1).astype(np.float64)
    turns = (np.arange(_ANGLE_BINS) + 0.5) * 2 * np.pi / _ANGLE_BINS
    centers = np.column_stack([np.cos(turns), np.sin(turns)])
    share = np.arctan2(normals[:, 1], normals[:, 0]) / (2 * np.pi)
    angle = np.floor(share * _ANGLE_BINS).astype(np.int64) % _ANGLE_BINS
    # Offsets are those of the normal of the bin, about the middle: otherwise lines far from the origin were beside
    # their cells.
    middle = cells.xy.mean(axis=0)
    offset = ((cells.xy - middle) * centers[angle]).sum(axis=1) / cells.cell
    low = np.floor(offset.min()) - 2
    size = int(offset.max() - low) + 4
    index = angle * size + np.floor(offset - low).astype(np.int64)
    support = np.bincount(index, weights, _ANGLE_BINS * size).reshape(_ANGLE_BINS, size)
    smooth = scipy.ndimage.gaussian_filter(support, (1.5, 1.0), mode=("wrap", "constant"), truncate=3)
    best = int(np.argmax(smooth))
    normal = centers[best // size]
    line = Line(normal, float(middle @ normal + (best % size + low + 0.5) * cells.cell))
    # The smoothing spreads the support of one line over about 1.5 × 1 × 2π bins.
    return line, float(smooth.flat[best] * 1.5 * 2 * np.pi)


def _fitted(line: Line, cells: WallCells) -> Line:
    """Return the weighted total least-squares line of the cells near a line."""
    for number in range(3):
        near = cells.only(line.holds(cells, within=_NEAR_CELLS if number else _TAKEN_CELLS))
        if len(near.xy) < 3:
            return line
        weights = near.layers.sum(axis=1).astype(np.float64)
        mean = np.average(near.xy, axis=0, weights=weights)
        spread = (near.xy - mean).T @ ((near.xy - mean) * weights[:, None])
        normal = np.linalg.eigh(spread)[1][:, 0]
        normal = normal if normal @ line.normal > 0 else -normal
        if normal @ line.normal < _LEAST_COSINE:
            return line
        line = Line(normal, float(mean @ normal))
    return line
