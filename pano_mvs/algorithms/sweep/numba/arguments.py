"""The arguments of the kernels of a sweep: packed sources, windows, and parts of bands.

Patch (j, i) of a packed panorama holds the pixels of rows j − 1, j and columns i − 1, i, over the seam and over the
poles: a bilinear sample needs one load, and no sample lies at a border. Values are stored less 128, as signed bytes.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.costs import census_weight
from pano_mvs.algorithms.sweep.kernels_constants import CENSUS, CENSUS_GRADIENT
from pano_mvs.algorithms.sweep.numba.kernels_records import Combination, Sources, Sweep, Windows
from pano_mvs.algorithms.sweep.numba.kernels_winner import STATES
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR
from pano_mvs.algorithms.sweep.preparation import SweepInput, source_weights
from pano_mvs.algorithms.sweep.windows import column_offsets
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import pad_panorama

Element = TypeVar("Element", bound=np.generic)


def pack_plane(plane: NDArray[np.uint8]) -> NDArray[np.uint32]:
    """Return all 2×2 patches of one colour, (H, W) to (H + 1, W + 2), four bytes each.

    They are upper left | lower left << 8 | upper right << 16 | lower right << 24. The last column is not used: it
    makes the rows as long as those of `pack_colors`.
    """
    padded = _signed_bytes(plane)
    upper, lower = padded[:-1], padded[1:]
    patches = np.zeros(upper.shape, np.uint32)
    patches[:, :-1] = upper[:, :-1] | lower[:, :-1] << 8 | upper[:, 1:] << 16 | lower[:, 1:] << 24
    return patches


def pack_colors(picture: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return the left halves of all patches of an RGB panorama, (H, W, 3) to (H + 1, W + 2), eight bytes each.

    They are upper and lower R, upper and lower G, upper and lower B, 0, 0: sixteen bytes from there are a patch.
    """
    height, width = picture.shape[:2]
    halves = np.zeros((height + 1, width + 2, 4, 2), np.uint8)
    for color in range(3):
        padded = _signed_bytes(picture[..., color])
        halves[..., color, 0], halves[..., color, 1] = padded[:-1], padded[1:]
    return halves.reshape(height + 1, -1).view(np.uint64)


def _signed_bytes(plane: NDArray[np.uint8]) -> NDArray[np.uint32]:
    return pad_panorama(plane ^ np.uint8(128), 1).astype(np.uint32)


def pack_sources(
    sources: Sequence[NDArray[np.uint8]], *, vector: bool
) -> tuple[NDArray[np.uint32], NDArray[np.uint64], NDArray[np.int64]]:
    """Return all sources packed in one array, by planes or by colours, one of which is empty, and where each begins.

    `sources`: (Hs, Ws, C) each. `vector`: whether vector instructions can be used; they want RGB by colours.
    """
    if vector and sources[0].shape[2] == 3:
        colors, starts = _joined([pack_colors(source).ravel() for source in sources])
        return np.zeros(0, np.uint32), colors, starts[:, None]
    planes = [pack_plane(plane).ravel() for source in sources for plane in np.moveaxis(source, -1, 0)]
    packed, starts = _joined(planes)
    return packed, np.zeros(0, np.uint64), starts.reshape(len(sources), -1)


def pack_votes(work: SweepInput) -> tuple[NDArray[np.uint8], NDArray[np.int64], NDArray[np.int64]]:
    """Return whether each patch of each source is valid (all four pixels are), and `valid_starts` and `masked`."""
    count = len(work.sources)
    if work.source_valid is None:
        return np.zeros(0, np.uint8), np.zeros(count, np.int64), np.zeros((count, 2), np.int64)
    votes = [_valid_patches(mask).ravel() for mask in work.source_valid]
    valid, starts = _joined(votes)
    masked = [np.flatnonzero(vote == 0)[[0, -1]] + (0, 1) if not vote.all() else (0, 0) for vote in votes]
    return valid, starts, np.array(masked, np.int64)


def _valid_patches(mask: NDArray[np.bool_]) -> NDArray[np.uint8]:
    """Return which patches are valid, (H, W) to (H + 1, W + 2); those of the last column, which is not used, are."""
    padded = pad_panorama(mask, 1)
    patches = np.ones((len(mask) + 1, mask.shape[1] + 2), np.uint8)
    patches[:, :-1] = padded[:-1, :-1] & padded[1:, :-1] & padded[:-1, 1:] & padded[1:, 1:]
    return patches


def _joined(arrays: Sequence[NDArray[Element]]) -> tuple[NDArray[Element], NDArray[np.int64]]:
    lengths = [len(array) for array in arrays]
    return np.concatenate(arrays), np.cumsum([0, *lengths[:-1]], dtype=np.int64)


BAND_ROWS = 32
"""The rows that `sweep_band` is given at a time."""

NO_VOLUME = np.empty((0, 0, 0), np.uint8)
"""Passed to `sweep_band` where the winners are wanted and the costs are not."""


def sweep_arguments(work: SweepInput) -> Sweep:
    """Return what all bands of a sweep share, as the kernels read it.

    Raises:
        UsageError: if the cost has no compiled version.
    """
    height, width, _ = work.reference.shape
    settings = work.settings
    windows = _windows(work)
    azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    kernel = settings.matching_cost.kernel
    if kernel is None:
        raise UsageError(f"the sweep cost {settings.cost!r} has no compiled version: use the backend numpy or opencv")
    return Sweep(
        reference=np.stack([pad_panorama(plane, windows.pad) for plane in np.moveaxis(work.reference, -1, 0)]),
        sin_cos_azimuth=np.stack([np.sin(azimuth), np.cos(azimuth)]).astype(np.float32),
        sources=_sources(work),
        windows=windows,
        cost=kernel,
        others=None if kernel in (CENSUS, CENSUS_GRADIENT) else True,
        census_weight=census_weight(settings.compare_radius) if kernel == CENSUS_GRADIENT else 0,
        combination=Combination(
            weights=source_weights((height, width), work.source_from_reference, settings),
            share=settings.weight_share,
            max_count=settings.max_sources(len(work.sources)),
            neutral=np.float32(settings.neutral_cost),
        ),
        scale=np.float32(settings.cost_scale),
    )


def _sources(work: SweepInput) -> Sources:
    packed, colors, starts = pack_sources(work.sources, vector=HAS_VECTOR)
    valid, valid_starts, masked = pack_votes(work)
    return Sources(
        poses=np.stack([np.column_stack([pose.rotation, pose.translation]) for pose in work.source_from_reference]),
        packed=packed,
        colors=colors,
        starts=starts,
        shapes=np.array([source.shape[:2] for source in work.sources]),
        valid=valid,
        valid_starts=valid_starts,
        masked=masked,
        vector=HAS_VECTOR,
    )


def _windows(work: SweepInput) -> Windows:
    size_hw, settings = (work.reference.shape[0], work.reference.shape[1]), work.settings
    compare_radius, box_radius = settings.compare_radius, settings.box_radius
    offsets = column_offsets(size_hw, compare_radius, spherical=settings.spherical_window)
    reach = column_offsets(size_hw, box_radius, spherical=settings.spherical_window)[:, -1].copy()
    pad = max(int(offsets.max()), int(reach.max()) + 1, compare_radius + box_radius)
    return Windows(offsets, reach, compare_radius, box_radius, pad)


def fresh_state(rows: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Return the state and the planes of `sweep_band` before the first plane: (STATES, rows, W) and (rows, W)."""
    return np.full((STATES, rows, width), np.inf, np.float32), np.zeros((rows, width), np.int32)


_TILE_COLUMNS = 64


@dataclass(frozen=True)
class TileRun:
    """Neighbouring tiles of one band.

    `first`: the first row. `rows`: number of rows. `start`: the first column. `columns`: number of columns. `margin`:
    columns on either side that windows reach into; 0 if the band is whole.
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
        if row.mean() > 0.7:  # a band most of which is to be swept is swept as a whole
            runs.append(TileRun(first, rows, 0, width, 0))
            continue
        # How far the windows of the band reach, the box's and those that look around within it.
        around = slice(max(0, first - BAND_ROWS // 2), first + rows + BAND_ROWS // 2)
        margin = int(windows.offsets[around].max() + windows.reach[around].max()) + 1
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


def _stretches(tiles: NDArray[np.bool_], width: int) -> Iterator[tuple[int, int]]:
    """Yield the first column and the one after the last of each stretch of tiles that are set."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], tiles, [False]]).astype(np.int8)))
    for start, stop in edges.reshape(-1, 2):
        yield int(start) * _TILE_COLUMNS, min(int(stop) * _TILE_COLUMNS, width)
