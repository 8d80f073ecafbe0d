"""Compute the costs of selected pixels at all depth hypotheses."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.backends.numpy_backend import combined_cost
from pano_mvs.algorithms.sweep.preparation import SweepInput, valid_where_seen
from pano_mvs.geometry import pixel_from_ray, ray_from_pixel, sample_panorama


def costs_at(work: SweepInput, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return the mean costs of pixels before the decision, (D, N), combined from the sources, not scaled.

    Args:
        work: what is swept.
        rows: (N,) of the pixels.
        columns: (N,) likewise.
    """
    if work.settings.matching_cost.kernel is None:
        planes = [combined_cost(work, virtual_range)[rows, columns] for virtual_range in work.ranges]
        return np.asarray(planes, dtype=np.float32)
    return _compiled_costs(work, rows, columns)


def _compiled_costs(work: SweepInput, rows: NDArray[np.intp], columns: NDArray[np.intp]) -> NDArray[np.float32]:
    """Sweep the tiles in which the pixels lie, range by range: the winner's cost is then that of the range."""
    # On use: numba is slow to import.
    from pano_mvs.algorithms.sweep.numba.arguments import NO_VOLUME, fresh_state, sweep_arguments
    from pano_mvs.algorithms.sweep.numba.kernels_band import sweep_band
    from pano_mvs.algorithms.sweep.numba.kernels_winner import BEST
    from pano_mvs.algorithms.sweep.numba.tiles import run_arguments, runs_of, tile_means

    height, width = work.reference.shape[:2]
    wanted = np.zeros((height, width), np.bool_)
    wanted[rows, columns] = True
    sweep = sweep_arguments(work)
    costs = np.empty((len(work.ranges), len(rows)), np.float32)
    for run in runs_of(tile_means(wanted) > 0, (height, width), sweep.windows):
        down, across = rows - run.first, columns - run.start
        own = np.flatnonzero((down >= 0) & (down < run.rows) & (across >= 0) & (across < run.columns))
        place = down[own], across[own] + run.margin
        arguments = run_arguments(sweep, run)
        for idx in range(len(work.ranges)):
            state, planes = fresh_state(run.rows, run.columns + 2 * run.margin)
            sweep_band(run.first, arguments, work.ranges[idx : idx + 1], NO_VOLUME, state, planes)
            costs[idx, own] = state[BEST][place]
    return costs


def votes_at(work: SweepInput, source_idx: int, *, row: int, column: int) -> NDArray[np.bool_]:
    """Return at which depth hypotheses a source is valid for a pixel, (D,): all pixels sampled there are."""
    if work.source_valid is None:
        return np.ones(len(work.ranges), np.bool_)
    valid = work.source_valid[source_idx]
    points = work.source_from_reference[source_idx].apply(_points_at(work, row, column))
    pixels = pixel_from_ray(points, (valid.shape[0], valid.shape[1]))
    return np.asarray(sample_panorama(valid, pixels) > 1 - 1e-9)


def is_seen(work: SweepInput, *, row: int, column: int, plane: int) -> bool:
    """Return whether a sweep keeps a pixel's winner: a source sees it in a valid pixel; see `sees_winner`."""
    point = _points_at(work, row, column)[plane]
    return work.source_valid is None or any(
        bool(valid_where_seen(valid, pose.apply(point)))
        for pose, valid in zip(work.source_from_reference, work.source_valid, strict=True)
    )


def _points_at(work: SweepInput, row: int, column: int) -> NDArray[np.float64]:
    ray = ray_from_pixel([column + 0.5, row + 0.5], (work.reference.shape[0], work.reference.shape[1]))
    return work.ranges[:, None] * ray
