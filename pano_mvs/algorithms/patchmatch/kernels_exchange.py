"""Compiled: how well planes match in each source, at the pixels where it is asked for."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pano_mvs.algorithms.patchmatch.kernels_match import SUMS, Sources, sum_windows, weigh_window
from pano_mvs.algorithms.patchmatch.kernels_refine import STRETCH, Reference, correlate_sources

# A gap of fewer columns costs less than another call.
_GAP = 8


@njit(cache=True, error_model="numpy", nogil=True)
def next_run(wanted: NDArray[np.bool_], start: int) -> tuple[int, int]:
    """Return the next run of a row, (W,), from `start` on: its first column and the one after its last.

    Short gaps belong to a run, and no run is longer than `STRETCH`. There is none if both are W.
    """
    width = len(wanted)
    first = start
    while first < width and not wanted[first]:
        first += 1
    last = first
    column = first
    while column < width and column - first < STRETCH and column - last <= _GAP:
        if wanted[column]:
            last = column
        column += 1
    return first, min(last + 1, width)


@njit(cache=True, error_model="numpy", nogil=True)
def correlate_rows(
    first_row: int,
    rows: int,
    planes: NDArray[np.float32],
    wanted: NDArray[np.bool_],
    reference: Reference,
    sources: Sources,
    numbers: tuple[np.float32, np.float32],
    correlations: NDArray[np.float32],
) -> None:
    """Write the correlation of each source with the reference, on planes, where it is wanted and in short gaps.

    Args:
        first_row: the first row.
        rows: number of rows.
        planes: (3, H, W) float32, finite.
        wanted: (H, W) bool.
        reference: see `refine_rows`.
        sources: see `sum_windows`.
        numbers: 1 / width in grey levels of the window's weights, and noise.
        correlations: (S, H, W) float32, written; −2 where a source does not count.
    """
    grey, azimuth, pad, stretches, window_rows, window_columns = reference
    color_scale, noise = numbers
    _, height, width = planes.shape
    count, side = len(sources[1]), len(window_rows)
    for row in range(first_row, first_row + rows):
        place_rows = stretches[row], window_columns[row]
        first, stop = next_run(wanted[row], 0)
        while first < width:
            n = stop - first
            weights, centred = np.empty((side * side, n), np.float32), np.empty((side * side, n), np.float32)
            moments, sums = np.empty((2, n), np.float32), np.empty((count, SUMS, n), np.float32)
            votes, found = np.empty((count, n), np.bool_), np.empty((count, n), np.float32)
            place = row, first, height, place_rows[0], pad, window_rows, place_rows[1]
            weigh_window(grey, place, color_scale, weights, centred, moments)
            part = planes[:, row, first:stop].copy()
            sum_windows(part, place, azimuth, (weights, centred, moments[0]), sources, sums, votes)
            correlate_sources(sums, votes, moments[1], noise, found)
            correlations[:, row, first:stop] = found
            first, stop = next_run(wanted[row], stop)


@njit(cache=True, error_model="numpy", nogil=True)
def nearest_of_cells(cells: NDArray[np.intp], distances: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Return the nearest point of each cell, (count,), the first of equals; −1 where there is none.

    Args:
        cells: (N,) of each point, from 0 to count − 1.
        distances: (N,) of each point.
        count: number of cells.
    """
    nearest = np.full(count, -1, np.int64)
    for i in range(len(cells)):
        before = nearest[cells[i]]
        if before < 0 or distances[i] < distances[before]:
            nearest[cells[i]] = i
    return nearest
