"""The compiled sweep: bands of rows in threads, without a cost volume unless semi-global matching needs one.

Memory beyond the pictures and the result: a source's packed copy has 4 bytes a pixel if it is grey, 8 in colour, or 12
without vector instructions; for "box" about 3 MB a thread at 1,000 columns and 3 sources, whatever the planes and the
rows; for "sgm" on top of it 3 bytes for each pixel and plane (a uint8 volume of costs and a uint16 volume of path sums;
201 MB at 512×1024×128), but no more than the settings allow: beyond, it is done in parts.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.backends.compiled_aggregation import keep_band, volume_parts, winners_by_paths
from pano_mvs.algorithms.sweep.edge_support.edge_support import average_volume
from pano_mvs.algorithms.sweep.numba.arguments import BAND_ROWS, NO_VOLUME, fresh_state, sweep_arguments
from pano_mvs.algorithms.sweep.numba.kernels_band import sweep_band
from pano_mvs.algorithms.sweep.numba.kernels_records import Sweep
from pano_mvs.algorithms.sweep.numba.threads import run_jobs, workers
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.winner import Winners


def find_winners(work: SweepInput) -> Winners:
    """Return the winning plane of every pixel and the costs around it; equals the numpy backend's except for rounding.

    With `levels` above 1 it sweeps from coarse to fine. Semi-global matching of a volume beyond `volume_limit_gb` is
    done in parts of the rows, see `volume_parts`.
    """
    if work.settings.levels > 1:
        from pano_mvs.algorithms.sweep.coarse_to_fine.coarse_to_fine import find_winners_coarse_to_fine

        return find_winners_coarse_to_fine(work, find_coarsest=find_winners_plainly)
    return find_winners_plainly(work)


def find_winners_plainly(work: SweepInput) -> Winners:
    """Do what `find_winners` does, trying every plane everywhere."""
    height, width = work.reference.shape[:2]
    sweep = sweep_arguments(work)
    if work.settings.aggregation == "box":
        return _box_winners(work, sweep)
    parts = volume_parts((height, width), work.settings)
    if len(parts) == 1:
        return winners_by_paths(work, _volume_of(work, sweep, parts[0].around))
    found = Winners.unset((height, width))
    for part in parts:
        some = winners_by_paths(work, _volume_of(work, sweep, part.around), top=part.around.start)
        found.put(part.rows, some.of_rows(part.inner))
    return found


def _box_winners(work: SweepInput, sweep: Sweep) -> Winners:
    height, width = work.reference.shape[:2]
    found = Winners.unset((height, width))

    def sweep_rows(first: int) -> None:
        state, planes = fresh_state(min(BAND_ROWS, height - first), width)
        sweep_band(first, sweep, work.ranges, NO_VOLUME, state, planes)
        keep_band(found, state, planes, first=first)

    with workers() as pool:
        run_jobs(pool, sweep_rows, range(0, height, BAND_ROWS))
    return found


def _volume_of(work: SweepInput, sweep: Sweep, around: slice) -> NDArray[np.uint8]:
    """Return the costs of some rows, (rows, D, W)."""
    volume = np.empty((around.stop - around.start, work.settings.planes, work.reference.shape[1]), np.uint8)

    def sweep_rows(first: int) -> None:
        rows = min(BAND_ROWS, around.stop - first)
        state, planes = fresh_state(rows, volume.shape[2])
        here = first - around.start
        sweep_band(first, sweep, work.ranges, volume[here : here + rows], state, planes)

    with workers() as pool:
        run_jobs(pool, sweep_rows, range(around.start, around.stop, BAND_ROWS))
    average_volume(volume, work, top=around.start)
    return volume
