"""Costs of windows that lie on planes which the reference may show, beside those of windows that face the camera.

Windows on a floor, seen at a slant from panoramas that are as far apart as the floor is, match where windows that face
the camera do not.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.numba.arguments import BAND_ROWS
from pano_mvs.algorithms.sweep.numba.kernels_guided import lower_at_candidates, raise_beyond, sweep_guided_band
from pano_mvs.algorithms.sweep.numba.kernels_records import Guide, Sweep
from pano_mvs.algorithms.sweep.numba.threads import run_jobs, workers
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.geometry import pad_panorama, ray_grid

STEPS = 3
"""Planes on either side of a guide that are tried."""
TABLE_PER_PLANE = 8


def inverse_table(work: SweepInput) -> NDArray[np.float32]:
    """Return the inverse ranges at positions 0, 1/8, 2/8 … among the depth hypotheses."""
    positions = np.arange((work.settings.planes - 1) * TABLE_PER_PLANE + 1) / TABLE_PER_PLANE
    return (1 / work.range_at(positions)).astype(np.float32)


def add_planes(volume: NDArray[np.uint8], work: SweepInput, sweep: Sweep, *, top: int) -> None:
    """Give hypotheses near a plane the costs of windows on it, where these are less; raise those beyond all planes.

    `volume`: (rows, D, W) costs, changed. `top`: the first of these rows.
    """
    if work.planes is None or not len(work.planes):
        return
    height, width = work.reference.shape[:2]
    halo = work.settings.compare_radius + work.settings.box_radius
    table, rays = inverse_table(work), ray_grid((height, width))
    farthest = np.zeros((height, width), np.float32)
    for plane in work.planes:
        inverse = rays @ plane
        met = inverse > table[-1]
        position = np.interp(-inverse, -table.astype(np.float64), np.arange(len(table)) / TABLE_PER_PLANE)
        farthest = np.maximum(farthest, np.where(met, position + STEPS, np.inf)).astype(np.float32)
        guide = pad_panorama(position.astype(np.float32), halo)[:, halo : halo + width]

        def match(first: int, *, guide: NDArray[np.float32] = guide, met: NDArray[np.bool_] = met) -> None:
            rows = min(BAND_ROWS, top + len(volume) - first)
            if not met[first : first + rows].any():
                return
            around = np.ascontiguousarray(guide[first : first + rows + 2 * halo])
            costs = np.empty((rows, 2 * STEPS + 1, width), np.uint8)
            sweep_guided_band(first, sweep, sweep.others, Guide(around, table, TABLE_PER_PLANE), costs)
            own = np.where(met[first : first + rows], around[halo : halo + rows], np.float32(-np.inf))
            lower_at_candidates(costs, own, volume[first - top : first - top + rows])

        with workers() as pool:
            run_jobs(pool, match, range(top, top + len(volume), BAND_ROWS))
    # 5° of arc.
    half_width = np.clip(width / 72 / np.hypot(rays[:, 0, 0], rays[:, 0, 2]), 1, (width - 1) // 2).astype(np.int64)
    rows = slice(top, top + len(volume))
    with workers() as pool:
        run_jobs(pool, partial(raise_beyond, farthest[rows], half_width[rows], volume), range(len(volume)))
