"""Semi-global matching of a volume of costs by eight paths over the sphere, compiled."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from math import ceil

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.numba.arguments import BAND_ROWS
from pano_mvs.algorithms.sweep.numba.kernels_sgm import sweep_row, sweep_strip
from pano_mvs.algorithms.sweep.numba.kernels_winner import AFTER, BEFORE, BEST, RIVAL, STATES, winners_of_rows
from pano_mvs.algorithms.sweep.numba.threads import Pool, run_jobs, workers
from pano_mvs.algorithms.sweep.penalties import step_penalties, warm_up
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.winner import Winners

VOLUME_BYTES = 3
"""Bytes for each pixel and plane: a uint8 cost and a uint16 sum of paths."""

_OVERLAP = 1 / 20
_STRIP_LINES = 128
# More than the eight paths of a plane can cost, see `SweepSettings.penalties`.
_NO_SUM = 65535


@dataclass(frozen=True)
class VolumePart:
    """Rows whose ranges are decided together.

    Attributes:
        rows: the rows.
        around: these, and those on either side from which paths come; whole bands.
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
    overlap = _whole_bands(ceil(height * _OVERLAP))
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

    Args:
        work: what is swept.
        volume: (rows, D, W) of all rows, or of some.
        top: the first of these.
    """
    height, _, width = volume.shape
    found = Winners.unset((height, width))

    def decide(first: int) -> None:
        rows = min(BAND_ROWS, height - first)
        state, planes = np.full((STATES, rows, width), _NO_SUM, np.uint16), np.zeros((rows, width), np.uint16)
        winners_of_rows(total, first, state, planes)
        keep_band(found, state, planes, first=first)
        rival = found.rival[first : first + rows]
        rival[rival == _NO_SUM] = np.inf

    with workers() as pool:
        total = _sum_paths(pool, work, volume, top=top)
        run_jobs(pool, decide, range(0, height, BAND_ROWS))
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


def _sum_paths(pool: Pool, work: SweepInput, volume: NDArray[np.uint8], *, top: int) -> NDArray[np.uint16]:
    """Return the sum of the eight paths' costs, (rows, D, W) uint16."""
    height, width = work.reference.shape[:2]
    settings, rows = work.settings, slice(top, top + len(volume))
    total = np.zeros(volume.shape, np.uint16)
    p1 = np.uint16(settings.penalties(height)[0])
    beyond_pole, before_seam = warm_up((height, width))
    # Where rows end that are not at a pole, nothing lies beyond.
    warm = (beyond_pole if rows.start == 0 else 0, beyond_pole if rows.stop == height else 0)
    for drift in (-1, 0, 1):
        penalties = (
            step_penalties(work.reference, (1, drift), settings, rows=rows),
            step_penalties(work.reference, (-1, -drift), settings, rows=rows),
        )
        follow = partial(_follow_lines, volume, total, penalties=penalties, p1=p1, drift=drift, warm=warm)
        run_jobs(pool, follow, range(0, width, _STRIP_LINES))
    sideways = np.stack([step_penalties(work.reference, (0, step), settings, rows=rows) for step in (1, -1)])
    run_jobs(pool, lambda y: sweep_row(volume, total, sideways, p1, y, before_seam), range(len(volume)))
    return total


def _follow_lines(
    volume: NDArray[np.uint8],
    total: NDArray[np.uint16],
    first: int,
    *,
    penalties: tuple[NDArray[np.uint16], NDArray[np.uint16]],
    p1: np.uint16,
    drift: int,
    warm: tuple[int, int],
) -> None:
    """Follow a strip of lines down and then, while caches still hold it, up again."""
    height, _, width = volume.shape
    lines = min(_STRIP_LINES, width - first)
    sweep_strip(volume, total, penalties[0], p1, first, lines, drift, False, warm[0])
    last = (first + drift * (height - 1)) % width
    sweep_strip(volume, total, penalties[1], p1, last, lines, -drift, True, warm[1])
