"""Sweep parts of bands only: tiles, the runs of neighbouring tiles, and the arguments of the kernels for a run."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.numba.arguments import BAND_ROWS
from pano_mvs.algorithms.sweep.numba.kernels_records import Sweep, Windows

_TILE_COLUMNS = 64
# A band of which this share is to be swept is swept as a whole.
_WHOLE_SHARE = 0.7


@dataclass(frozen=True)
class TileRun:
    """Neighbouring tiles of one band.

    Attributes:
        first: the first row.
        rows: number of rows.
        start: the first column.
        columns: number of columns.
        margin: columns on either side that windows reach into; 0 if the band is whole.
    """

    first: int
    rows: int
    start: int
    columns: int
    margin: int

    @property
    def with_margin(self) -> NDArray[np.intp]:
        """The columns to sweep, (columns + 2 margin,), some of them beyond the seam."""
        return np.arange(self.start - self.margin, self.start + self.columns + self.margin)

    @property
    def place(self) -> tuple[slice, slice]:
        """Its rows and columns."""
        return slice(self.first, self.first + self.rows), slice(self.start, self.start + self.columns)

    @property
    def inner(self) -> slice:
        """Its own columns among those with the margin."""
        return slice(self.margin, self.margin + self.columns)


def tile_means(picture: NDArray[Any]) -> NDArray[np.float64]:
    """Return the mean of each tile of a picture (H, W), (bands, tiles)."""
    height, width = picture.shape
    bands, tiles = np.arange(0, height, BAND_ROWS), np.arange(0, width, _TILE_COLUMNS)
    sums = np.add.reduceat(np.add.reduceat(picture, bands, axis=0, dtype=np.float64), tiles, axis=1)
    pixels = np.diff(bands, append=height)[:, None] * np.diff(tiles, append=width)
    means: NDArray[np.float64] = sums / pixels
    return means


def spread_tiles(tiles: NDArray[Any], size_hw: tuple[int, int]) -> NDArray[Any]:
    """Return the picture (H, W) whose pixels have the values of their tiles."""
    height, width = size_hw
    return tiles.repeat(BAND_ROWS, axis=0)[:height].repeat(_TILE_COLUMNS, axis=1)[:, :width]


def runs_of(tiles: NDArray[np.bool_], size_hw: tuple[int, int], windows: Windows) -> list[TileRun]:
    """Return the runs of tiles that are set, (bands, tiles), from top to bottom."""
    height, width = size_hw
    runs = []
    for band, row in enumerate(tiles):
        first, rows = band * BAND_ROWS, min(BAND_ROWS, height - band * BAND_ROWS)
        if row.mean() > _WHOLE_SHARE:
            runs.append(TileRun(first, rows, 0, width, 0))
            continue
        margin = _margin(windows, first, rows)
        runs += [TileRun(first, rows, start, stop - start, margin) for start, stop in _stretches(row, width)]
    return runs


def run_arguments(sweep: Sweep, run: TileRun) -> Sweep:
    """Return the arguments that all bands share, cut to the columns of a run."""
    if run.margin == 0:
        return sweep
    pad, width, columns = sweep.windows.pad, sweep.sin_cos_azimuth.shape[1], run.with_margin
    padded = np.arange(columns[0] - pad, columns[-1] + pad + 1) % width + pad
    combination = sweep.combination
    if combination.weights.size:
        combination = combination._replace(weights=np.ascontiguousarray(combination.weights[:, :, columns % width]))
    return sweep._replace(
        reference=np.ascontiguousarray(sweep.reference[:, :, padded]),
        sin_cos_azimuth=np.ascontiguousarray(sweep.sin_cos_azimuth[:, columns % width]),
        combination=combination,
    )


def _margin(windows: Windows, first: int, rows: int) -> int:
    """Return how far the windows of a band reach, the box's and those that look around within it."""
    around = slice(max(0, first - BAND_ROWS // 2), first + rows + BAND_ROWS // 2)
    return int(windows.offsets[around].max() + windows.reach[around].max()) + 1


def _stretches(tiles: NDArray[np.bool_], width: int) -> Iterator[tuple[int, int]]:
    """Yield the first column and the one after the last of each stretch of tiles that are set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], tiles, [False]]).astype(np.int8)))
    for start, stop in edges.reshape(-1, 2):
        yield int(start) * _TILE_COLUMNS, min(int(stop) * _TILE_COLUMNS, width)
