"""The compiled sweep: bands of rows in threads, without a cost volume unless semi-global matching needs one.

Memory beyond the pictures and the result: a source's packed copy has 4 bytes a pixel if it is grey, 8 in colour, or 12
without vector instructions; for "box" about 3 MB a thread at 1,000 columns and 3 sources, whatever the planes and the
rows; for "sgm" on top of it 3 bytes for each pixel and plane (a uint8 volume of costs and a uint16 volume of path sums;
201 MB at 512×1024×128), but no more than the settings allow: beyond, it is done in parts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from math import ceil

import numba
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.edge_support import average_volume
from pano_mvs.algorithms.sweep.numba.arguments import BAND_ROWS, NO_VOLUME, fresh_state, sweep_arguments
from pano_mvs.algorithms.sweep.numba.kernels_band import sweep_band
from pano_mvs.algorithms.sweep.numba.kernels_lookup import INTERPOLATED_FROM
from pano_mvs.algorithms.sweep.numba.kernels_records import Sweep
from pano_mvs.algorithms.sweep.numba.kernels_sgm import (
    DRIFTS,
    Front,
    PathCosts,
    Sums,
    follow_block,
    look_up_penalties,
    state_columns,
)
from pano_mvs.algorithms.sweep.numba.kernels_sgm_rows import follow_rows
from pano_mvs.algorithms.sweep.numba.kernels_winner import AFTER, BEFORE, BEST, RIVAL, STATES, winners_of_rows
from pano_mvs.algorithms.sweep.numba.slanted import add_planes
from pano_mvs.algorithms.sweep.numba.threads import Pool, run_jobs, workers
from pano_mvs.algorithms.sweep.penalties import padded_channels, penalty_table, warm_up
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.winner import Winners

VOLUME_BYTES = 3
"""Bytes for each pixel and plane: a uint8 cost and a uint16 sum of paths."""

_BLOCK_ROWS = 32
_JOB_ROWS = 4
_STRIP_COLUMNS = 512
_LINE_WORDS = 32  # uint16 in a line of the cache
# More than the eight paths of a plane can cost, see `SweepSettings.penalties`.
_NO_SUM = 65535


@dataclass(frozen=True)
class VolumePart:
    """Rows whose ranges are decided together.

    `rows`: the rows. `around`: these, and those on either side from which paths come; whole bands.
    """

    rows: slice
    around: slice

    @property
    def inner(self) -> slice:
        """The rows among those around them."""
        return slice(self.rows.start - self.around.start, self.rows.stop - self.around.start)


def volume_parts(size_hw: tuple[int, int], settings: SweepSettings) -> list[VolumePart]:
    """Return the parts of a panorama, from top to bottom, whose volumes keep within `volume_limit_gb`.

    Paths begin again a twentieth of the rows (nine degrees) away from the rows that they decide. A path keeps its costs
    until it has gathered the penalty of a step, which grows with the rows: on surfaces with texture, nothing from
    beyond is left by then; on plain ones ranges change, though they are as often right.
    """
    height, width = size_hw
    row_bytes = VOLUME_BYTES * width * settings.planes
    max_rows = int(settings.volume_limit_gb * 1e9) // row_bytes // BAND_ROWS * BAND_ROWS
    if max_rows >= height:
        return [VolumePart(slice(0, height), slice(0, height))]
    overlap = _whole_bands(ceil(height * 0.05))
    step = max(BAND_ROWS, max_rows - 2 * overlap)
    step = _whole_bands(ceil(height / ceil(height / step)))
    return [
        VolumePart(
            rows=slice(first, min(first + step, height)),
            around=slice(max(0, first - overlap), min(first + step + overlap, height)),
        )
        for first in range(0, height, step)
    ]


def _whole_bands(rows: int) -> int:
    return -(-rows // BAND_ROWS) * BAND_ROWS


def winners_by_paths(work: SweepInput, volume: NDArray[np.uint8], *, top: int = 0) -> Winners:
    """Return the winners after semi-global matching of a volume of costs, whichever backend computed it.

    `work`: what is swept. `volume`: (rows, D, W) of all rows, or of some. `top`: the first of these.
    """
    height, _, width = volume.shape
    found = Winners.unset((height, width))

    def decide(first: int, *, rows: slice, sums: NDArray[np.uint16]) -> None:
        count = min(_JOB_ROWS, rows.stop - first)
        columns = sums.shape[2]
        state, planes = np.full((STATES, count, columns), _NO_SUM, np.uint16), np.zeros((count, columns), np.uint16)
        winners_of_rows(sums, first - rows.start, state, planes)
        keep_band(found, state[:, :, :width], planes[:, :width], first=first)
        rival = found.rival[first : first + count]
        rival[rival == _NO_SUM] = np.inf

    with workers() as pool:
        for rows, sums in _summed_paths(pool, work, volume, top=top):
            run_jobs(pool, partial(decide, rows=rows, sums=sums), range(rows.start, rows.stop, _JOB_ROWS))
    return found


def keep_band(
    found: Winners, state: NDArray[np.float32 | np.uint16], planes: NDArray[np.int32 | np.uint16], *, first: int
) -> None:
    """Write the winners of a band, from the final state of `update_plain`, to its rows from `first` on."""
    rows = slice(first, first + len(planes))
    found.plane[rows] = planes
    found.cost[rows] = state[BEST]
    found.before[rows] = np.where(planes == 0, state[BEST], state[BEFORE])
    found.after[rows] = state[AFTER]
    found.rival[rows] = state[RIVAL]


def _summed_paths(
    pool: Pool, work: SweepInput, volume: NDArray[np.uint8], *, top: int
) -> Iterator[tuple[slice, NDArray[np.uint16]]]:
    """Yield blocks of rows, the last ones first, with the sums of the eight paths' costs, (rows, D, W) uint16.

    The paths along the rows and downwards come first, and their sums are kept; those upwards complete a block's sums,
    which are valid until the next block.
    """
    size_hw, settings = (work.reference.shape[0], work.reference.shape[1]), work.settings
    height, end = len(volume), top + len(volume)
    p1 = np.uint16(settings.penalties(size_hw[0])[0])
    beyond_pole, _ = warm_up(size_hw)

    channels = padded_channels(work.contrast_picture)
    table = penalty_table(settings, size_hw[0])

    def penalties(*directions: tuple[int, int]) -> NDArray[np.uint16]:
        found = np.empty((len(directions), height, size_hw[1]), np.uint16)
        look_up_penalties(channels, table, np.array(directions), top, found)
        return found

    total, block = (np.empty((count, *_sum_shape(volume)), np.uint16) for count in (height, min(_BLOCK_ROWS, height)))
    sideways = penalties((0, 1), (0, -1))
    paths = _PolePaths(PathCosts(volume, penalties(*((1, drift) for drift in DRIFTS)), p1, False))
    # Where rows end that are not at a pole, nothing lies beyond.
    paths.prepare(pool, beyond_pole if top == 0 else 0)
    for first in range(0, height, _BLOCK_ROWS):
        count = min(_BLOCK_ROWS, height - first)
        rows = range(first, first + count)

        def along(row: int, rows: range = rows) -> None:
            follow_rows(volume, sideways, p1, (row, min(_JOB_ROWS, rows.stop - row)), block, rows.start)

        run_jobs(pool, along, rows[::_JOB_ROWS])
        paths.follow(pool, rows, Sums(block, first, total, 0))
    paths = _PolePaths(PathCosts(volume, penalties(*((-1, drift) for drift in DRIFTS)), p1, True))
    paths.prepare(pool, beyond_pole if end == size_hw[0] else 0)
    for step in range(0, height, _BLOCK_ROWS):
        count = min(_BLOCK_ROWS, height - step)
        first = height - step - count
        paths.follow(pool, range(step, step + count), Sums(total, 0, block, first))
        yield slice(first, first + count), block


class _PolePaths:
    """All paths from one pole to the other, followed block by block."""

    def __init__(self, costs: PathCosts) -> None:
        _, depth, width = costs.volume.shape
        self._costs = costs
        self._fronts = [
            Front(np.zeros((len(DRIFTS), depth, width), np.uint16), np.zeros((len(DRIFTS), width), np.uint16))
            for _ in range(2)
        ]
        # Few enough columns that the paths of a strip fit the caches, and a strip for each thread.
        self._strip = min(_STRIP_COLUMNS, ceil(width / numba.get_num_threads()))
        columns = state_columns(self._strip, _BLOCK_ROWS)
        self._states = np.empty((-(-width // self._strip), len(DRIFTS), depth + 1, columns), np.uint16)

    def prepare(self, pool: Pool, steps: int) -> None:
        """Follow the paths beyond the pole from which they come."""
        nowhere = np.empty((0, *_sum_shape(self._costs.volume)), np.uint16)
        for first in range(-steps, 0, _BLOCK_ROWS):
            self.follow(pool, range(first, min(first + _BLOCK_ROWS, 0)), Sums(nowhere, 0, nowhere, 0))

    def follow(self, pool: Pool, steps: range, sums: Sums) -> None:
        """Follow the paths by some steps, the same for any strips, and add their costs to the sums."""
        width, strip = self._costs.volume.shape[2], self._strip

        def follow_strip(first: int) -> None:
            columns = first, min(strip, width - first)
            state = self._states[first // strip]
            follow_block(self._costs, self._fronts[0], self._fronts[1], (steps.start, len(steps)), columns, sums, state)

        run_jobs(pool, follow_strip, range(0, width, strip))
        self._fronts.reverse()


def _sum_shape(volume: NDArray[np.uint8]) -> tuple[int, int]:
    """Return (D, columns) of the sums of paths for a row.

    Planes must not lie a power of two apart, or all of a pixel's sums fall on a few places of the cache.
    """
    _, depth, width = volume.shape
    return depth, (-(-width // _LINE_WORDS) | 1) * _LINE_WORDS


def find_winners(work: SweepInput) -> Winners:
    """Return the winning plane of every pixel and the costs around it; equals the numpy backend's except for rounding.

    With `levels` above 1 it sweeps from coarse to fine. Semi-global matching of a volume beyond `volume_limit_gb` is
    done in parts of the rows, see `volume_parts`.
    """
    if work.settings.levels > 1:
        from pano_mvs.algorithms.sweep.coarse_to_fine import find_winners_coarse_to_fine

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
        sweep_band(first, sweep, sweep.others, work.ranges, NO_VOLUME, state, planes)
        keep_band(found, state, planes, first=first)

    with workers() as pool:
        run_jobs(pool, sweep_rows, range(0, height, BAND_ROWS))
    return found


def _volume_of(work: SweepInput, sweep: Sweep, around: slice) -> NDArray[np.uint8]:
    """Return the costs of some rows, (rows, D, W)."""
    height, width = work.reference.shape[:2]
    volume = np.empty((around.stop - around.start, work.settings.planes, width), np.uint8)
    # A band needs the rows around it as well: low pictures that one thread sweeps are one band.
    band = height if height < INTERPOLATED_FROM and numba.get_num_threads() == 1 else BAND_ROWS

    def sweep_rows(first: int) -> None:
        rows = min(band, around.stop - first)
        state, planes = fresh_state(rows, volume.shape[2])
        here = first - around.start
        sweep_band(first, sweep, sweep.others, work.ranges, volume[here : here + rows], state, planes)

    with workers() as pool:
        run_jobs(pool, sweep_rows, range(around.start, around.stop, band))
    average_volume(volume, work, top=around.start)
    add_planes(volume, work, sweep, top=around.start)
    return volume
