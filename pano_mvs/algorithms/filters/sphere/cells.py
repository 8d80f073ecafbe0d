"""The spatial cells of a bilateral grid on the sphere."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Number of cells around a pole: with fewer, half a turn across the pole would end in the same cell.
_MIN_CELLS = 4


@dataclass(frozen=True, slots=True, eq=False)
class SphereCells:
    """Cells of about equal width and height on the sphere, and the interpolation weights of pixels.

    Bands of equal height run around the sphere. A band is divided into equal cells, with half, a quarter … of the
    number of cells at the equator towards the poles, so that a cell is never much narrower than high. Cells are
    neighbours within a band, across the seam, between bands by the length of their common side, and across the poles. A
    pixel lies between four centres, which form an element. All elements of a gap between two bands have the same bands
    above and below.

    Attributes:
        element_of_pixel: (G, W) int32: element of a pixel by gap and column.
        weight_upper: (G, W) float64 weight of the right one of the element's two cells in the band above.
        weight_lower: (G, W) float64 the same in the band below.
        gap_of_row: (H,) int32.
        weight_row: (H,) float64 weight of the band below.
        corners: (E, 4) int32 cells of each element: upper left, upper right, lower left, lower right.
        starts: (C + 1,) int32: the neighbours of cell c are `neighbours[starts[c]:starts[c + 1]]`.
        neighbours: (K,) int32.
        strengths: (K,) float64 common side with each neighbour, relative to the shorter cell; symmetric.
    """

    element_of_pixel: NDArray[np.int32]
    weight_upper: NDArray[np.float64]
    weight_lower: NDArray[np.float64]
    gap_of_row: NDArray[np.int32]
    weight_row: NDArray[np.float64]
    corners: NDArray[np.int32]
    starts: NDArray[np.int32]
    neighbours: NDArray[np.int32]
    strengths: NDArray[np.float64]


def sphere_cells(size_hw: tuple[int, int], cell_px: float) -> SphereCells:
    """Divide a panorama into cells, `cell_px` pixels wide and high at the equator.

    Args:
        size_hw: (height, width) of the panorama in pixels, even width.
        cell_px: size of a cell in pixels at the equator.
    """
    height, width = size_hw
    counts = _cells_in_band(size_hw, cell_px)
    bands = len(counts)
    first = np.concatenate([[0], np.cumsum(counts)])
    y = (np.arange(height) + 0.5) * bands / height + 0.5
    gap_of_row = np.floor(y).astype(np.int32)
    left, weight = _place_columns(counts, width)
    # Above the first band is the first band again, rotated by half a turn; below the last one likewise.
    upper = np.concatenate([[0], np.arange(bands)])
    lower = np.concatenate([np.arange(bands), [bands - 1]])
    half = width // 2
    left_upper, weight_upper = left[upper], weight[upper]
    left_lower, weight_lower = left[lower], weight[lower]
    left_upper[0], weight_upper[0] = np.roll(left_upper[0], -half), np.roll(weight_upper[0], -half)
    left_lower[-1], weight_lower[-1] = np.roll(left_lower[-1], -half), np.roll(weight_lower[-1], -half)
    element_of_pixel, firsts = _number_elements(left_upper, left_lower)
    gap, column = firsts
    corners = np.stack(
        [
            first[band[gap]] + (start[gap, column] + step) % counts[band[gap]]
            for band, start in ((upper, left_upper), (lower, left_lower))
            for step in (0, 1)
        ],
        axis=1,
    )
    starts, neighbours, strengths = _neighbours(counts)
    return SphereCells(
        element_of_pixel=element_of_pixel,
        weight_upper=weight_upper,
        weight_lower=weight_lower,
        gap_of_row=gap_of_row,
        weight_row=y - gap_of_row,
        corners=corners.astype(np.int32),
        starts=starts,
        neighbours=neighbours,
        strengths=strengths,
    )


def _cells_in_band(size_hw: tuple[int, int], cell_px: float) -> NDArray[np.int64]:
    """Return the number of cells of each band, always even."""
    height, width = size_hw
    bands = max(2, round(height / cell_px))
    elevation = np.pi * (0.5 - (np.arange(bands) + 0.5) / bands)
    equator = max(_MIN_CELLS, 2 * round(width / cell_px / 2))
    halvings = np.rint(np.log2(1 / np.cos(elevation)))
    counts: NDArray[np.int64] = np.maximum(_MIN_CELLS, 2 * np.rint(equator / 2 / 2**halvings)).astype(np.int64)
    return counts


def _place_columns(counts: NDArray[np.int64], width: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return for each band and column the cell to the left and the weight of the one to the right, (B, W) each."""
    position = (np.arange(width) + 0.5) * counts[:, None] / width - 0.5
    left = np.floor(position)
    return left.astype(np.int64) % counts[:, None], position - left


def _number_elements(
    left_upper: NDArray[np.int64], left_lower: NDArray[np.int64]
) -> tuple[NDArray[np.int32], tuple[NDArray[np.int64], NDArray[np.int64]]]:
    """Return the index of the element of each (gap, column), and a (gap, column) in each element."""
    starts = (left_upper != np.roll(left_upper, 1, axis=1)) | (left_lower != np.roll(left_lower, 1, axis=1))
    # The element at the seam starts at the end of the row, so a row's indices start before its first column.
    per_gap = starts.sum(axis=1)
    before = np.concatenate([[0], np.cumsum(per_gap)[:-1]])
    inside = (np.cumsum(starts, axis=1) - 1) % per_gap[:, None]
    gap, column = np.nonzero(starts)
    return (before[:, None] + inside).astype(np.int32), (gap, column)


def _neighbours(
    counts: NDArray[np.int64],
) -> tuple[NDArray[np.int32], NDArray[np.int32], NDArray[np.float64]]:
    """Return the symmetric graph of the cells as compressed rows: starts, neighbours and strengths."""
    first = np.concatenate([[0], np.cumsum(counts)])
    heads: list[NDArray[np.int64]] = []
    tails: list[NDArray[np.int64]] = []
    sides: list[NDArray[np.float64]] = []
    for band, count in enumerate(counts):
        cell = np.arange(count)
        heads.append(first[band] + cell)
        tails.append(first[band] + (cell + 1) % count)
        sides.append(np.ones(count))
        if band in (0, len(counts) - 1):
            opposite = cell[: count // 2]
            heads.append(first[band] + opposite)
            tails.append(first[band] + opposite + count // 2)
            sides.append(np.ones(count // 2))
        if band + 1 < len(counts):
            upper, lower, side = _common_sides(int(count), int(counts[band + 1]))
            heads.append(first[band] + upper)
            tails.append(first[band + 1] + lower)
            sides.append(side)
    head, tail, side = np.concatenate(heads), np.concatenate(tails), np.concatenate(sides)
    rows, columns, strengths = np.concatenate([head, tail]), np.concatenate([tail, head]), np.concatenate([side, side])
    order = np.lexsort((columns, rows))
    starts = np.searchsorted(rows[order], np.arange(first[-1] + 1))
    return starts.astype(np.int32), columns[order].astype(np.int32), strengths[order]


def _common_sides(
    upper_count: int, lower_count: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """Return the pairs of cells of two bands that touch, and their common side relative to the shorter cell."""
    edges = np.unique(np.concatenate([np.arange(upper_count) * lower_count, np.arange(lower_count) * upper_count]))
    lengths = np.diff(np.append(edges, upper_count * lower_count))
    return edges // lower_count, edges // upper_count, lengths / min(upper_count, lower_count)
