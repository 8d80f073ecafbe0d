"""The sweep, compiled: bands of rows in threads, no volume unless semi-global matching needs one.

Memory beyond the pictures and the result: a source's packed copy has 4 bytes a pixel if it is grey, 8 in colour, or 12
without vector instructions; for "box" about 3 MB a thread at 1,000 columns and 3 sources, whatever the planes and the
rows; for "sgm" on top of it 3 bytes for each pixel and plane (a uint8 volume of costs and a uint16 volume of path sums;
201 MB at 512×1024×128), but no more than the settings allow: beyond, it is done in parts.

Bands and strips are handed to plain threads (the kernels release the GIL), as many as numba is told to use: they write
disjoint parts in a fixed arithmetic order, so the number of threads changes no bit. numba's own parallel regions would
take several times longer to compile, and their portable threading layer aborts when two Python threads enter it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from math import ceil
from typing import TypeAlias, TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.combination import source_weights
from pano_mvs.algorithms.sweep.numba.kernels_band import sweep_band
from pano_mvs.algorithms.sweep.numba.kernels_cost import COSTS
from pano_mvs.algorithms.sweep.numba.kernels_sgm import sweep_row, sweep_strip
from pano_mvs.algorithms.sweep.numba.kernels_winner import AFTER, BEFORE, BEST, RIVAL, STATES, winners_of_rows
from pano_mvs.algorithms.sweep.numba.packing import pack_sources, pack_votes
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR
from pano_mvs.algorithms.sweep.penalties import step_penalties, warm_up
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.windows import column_offsets
from pano_mvs.algorithms.sweep.winner import Winners
from pano_mvs.geometry import pad_panorama

VOLUME_BYTES = 3
_BAND_ROWS = 32
_OVERLAP = 1 / 20
_NO_VOLUME = np.empty((0, 0, 0), np.uint8)
_STRIP_LINES = 128
# More than the eight paths of a plane can cost, see `SweepSettings.penalties`.
_NO_SUM = 65535

Job = TypeVar("Job")
_Pool: TypeAlias = ThreadPoolExecutor | None


def find_winners(work: SweepInput) -> Winners:
    """Return the winning plane of every pixel and the costs around it; equals the numpy backend's but for rounding.

    Semi-global matching of a volume beyond `volume_limit_gb` is done for some rows after the other, see `parts_of`.
    """
    height, width = work.reference.shape[:2]
    prepared = _band_arguments(work)
    if work.settings.aggregation == "box":
        return _box_winners(work, prepared)
    parts = parts_of((height, width), work.settings)
    if len(parts) == 1:
        return winners_by_paths(work, _volume_of(work, prepared, parts[0].around))
    found = _unset_winners((height, width))
    for part in parts:
        some = winners_by_paths(work, _volume_of(work, prepared, part.around), top=part.around.start)
        found.put(part.rows, some.of_rows(part.inner))
    return found


@dataclass(frozen=True)
class Part:
    """Rows that are decided together.

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


def parts_of(size_hw: tuple[int, int], settings: SweepSettings) -> list[Part]:
    """Return the parts of a panorama, from top to bottom, whose volumes keep within `volume_limit_gb`.

    Paths begin anew a twentieth of the rows (nine degrees) away from what they decide. A path carries on what it knows
    until it has gathered the penalty of a step, which grows with the rows, so that on surfaces with texture what it
    brings from beyond is forgotten by then; on plain ones ranges change, though they are as often right.
    """
    height, width = size_hw
    row_bytes = VOLUME_BYTES * width * settings.planes
    most = int(settings.volume_limit_gb * 1e9) // row_bytes // _BAND_ROWS * _BAND_ROWS
    if most >= height:
        return [Part(slice(0, height), slice(0, height))]
    overlap = _up(ceil(height * _OVERLAP))
    step = max(_BAND_ROWS, most - 2 * overlap)
    step = _up(ceil(height / ceil(height / step)))
    return [
        Part(slice(first, min(first + step, height)),
             slice(max(0, first - overlap), min(first + step + overlap, height)))
        for first in range(0, height, step)
    ]  # fmt: skip


def _up(rows: int) -> int:
    return -(-rows // _BAND_ROWS) * _BAND_ROWS


def _box_winners(work: SweepInput, prepared: tuple[object, ...]) -> Winners:
    height, width = work.reference.shape[:2]
    found = _unset_winners((height, width))

    def sweep(first: int) -> None:
        state, planes = _fresh_state(min(_BAND_ROWS, height - first), width)
        sweep_band(first, *prepared, _NO_VOLUME, state, planes)
        _keep(found, first, state, planes)

    with _workers() as pool:
        _run(pool, sweep, range(0, height, _BAND_ROWS))
    return found


def _volume_of(work: SweepInput, prepared: tuple[object, ...], around: slice) -> NDArray[np.uint8]:
    """Return the costs of some rows, (rows, D, W)."""
    volume = np.empty((around.stop - around.start, work.settings.planes, work.reference.shape[1]), np.uint8)

    def sweep(first: int) -> None:
        rows = min(_BAND_ROWS, around.stop - first)
        state, planes = _fresh_state(rows, volume.shape[2])
        here = first - around.start
        sweep_band(first, *prepared, volume[here : here + rows], state, planes)

    with _workers() as pool:
        _run(pool, sweep, range(around.start, around.stop, _BAND_ROWS))
    return volume


def winners_by_paths(work: SweepInput, volume: NDArray[np.uint8], *, top: int = 0) -> Winners:
    """Return the winners after semi-global matching of a volume of costs, whoever made it.

    Args:
        work: what is swept.
        volume: (rows, D, W) of all rows, or of some.
        top: the first of these.
    """
    height, _, width = volume.shape
    found = _unset_winners((height, width))

    def decide(first: int) -> None:
        rows = min(_BAND_ROWS, height - first)
        state, planes = np.full((STATES, rows, width), _NO_SUM, np.uint16), np.zeros((rows, width), np.uint16)
        winners_of_rows(total, first, state, planes)
        _keep(found, first, state, planes)
        rival = found.rival[first : first + rows]
        rival[rival == _NO_SUM] = np.inf

    with _workers() as pool:
        total = _aggregate(pool, work, volume, top)
        _run(pool, decide, range(0, height, _BAND_ROWS))
    return found


def _fresh_state(rows: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    return np.full((STATES, rows, width), np.inf, np.float32), np.zeros((rows, width), np.int32)


def _band_arguments(work: SweepInput) -> tuple[object, ...]:
    """Return the arguments of `sweep_band` that all bands share."""
    height, width, _ = work.reference.shape
    settings = work.settings
    offsets = column_offsets((height, width), settings.compare_radius, spherical=settings.spherical_window)
    reach = column_offsets((height, width), settings.box_radius, spherical=settings.spherical_window)[:, -1].copy()
    halo = settings.compare_radius + settings.box_radius
    pad = max(int(offsets.max()), int(reach.max()) + 1, halo)
    reference = np.stack([pad_panorama(plane, pad) for plane in np.moveaxis(work.reference, -1, 0)])
    azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    vector = HAS_VECTOR
    packed, colors, starts = pack_sources(work.sources, vector=vector)
    valid, valid_starts = pack_votes(work)
    poses = np.stack([np.column_stack([pose.rotation, pose.translation]) for pose in work.source_from_reference])
    shapes = np.array([source.shape[:2] for source in work.sources])
    return (
        reference, np.stack([np.sin(azimuth), np.cos(azimuth)]).astype(np.float32), poses, work.ranges,
        packed, colors, starts, shapes, valid, valid_starts, vector, offsets, reach,
        COSTS[settings.cost], settings.census_weight, settings.compare_radius, settings.box_radius, pad,
        source_weights((height, width), work.source_from_reference, settings),
        settings.weight_share, settings.most_sources(len(work.sources)),
        np.float32(settings.cost_scale), np.float32(settings.neutral_cost),
    )  # fmt: skip


def _aggregate(pool: _Pool, work: SweepInput, volume: NDArray[np.uint8], top: int) -> NDArray[np.uint16]:
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
            step_penalties(work.reference, (1, drift), settings, rows),
            step_penalties(work.reference, (-1, -drift), settings, rows),
        )
        follow = partial(_follow_lines, volume, total, penalties, p1, drift, warm)
        _run(pool, follow, range(0, width, _STRIP_LINES))
    sideways = np.stack([step_penalties(work.reference, (0, step), settings, rows) for step in (1, -1)])
    _run(pool, lambda y: sweep_row(volume, total, sideways, p1, y, before_seam), range(len(volume)))
    return total


def _follow_lines(
    volume: NDArray[np.uint8], total: NDArray[np.uint16], penalties: tuple[NDArray[np.uint16], NDArray[np.uint16]],
    p1: np.uint16, drift: int, warm: tuple[int, int], first: int,
) -> None:  # fmt: skip
    """Follow a strip of lines down and then, while caches still hold it, up again."""
    height, _, width = volume.shape
    lines = min(_STRIP_LINES, width - first)
    sweep_strip(volume, total, penalties[0], p1, first, lines, drift, False, warm[0])
    last = (first + drift * (height - 1)) % width
    sweep_strip(volume, total, penalties[1], p1, last, lines, -drift, True, warm[1])


@contextmanager
def _workers() -> Iterator[_Pool]:
    """Give threads as many as numba may use; None for one, which needs no pool."""
    if numba.get_num_threads() == 1:
        yield None
        return
    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        yield pool


def _run(pool: _Pool, work: Callable[[Job], object], jobs: Iterable[Job]) -> None:
    """Do all jobs and raise what the first of them raised."""
    for _ in map(work, jobs) if pool is None else pool.map(work, jobs):
        pass


def _unset_winners(size_hw: tuple[int, int]) -> Winners:
    costs = [np.empty(size_hw, np.float32) for _ in range(4)]
    return Winners(np.empty(size_hw, np.int32), *costs)


def _keep(
    found: Winners, first: int, state: NDArray[np.float32 | np.uint16], planes: NDArray[np.int32 | np.uint16]
) -> None:
    """Copy what a band found to where it belongs."""
    rows = slice(first, first + len(planes))
    found.plane[rows] = planes
    found.cost[rows] = state[BEST]
    found.before[rows] = np.where(planes == 0, state[BEST], state[BEFORE])
    found.after[rows] = state[AFTER]
    found.rival[rows] = state[RIVAL]
