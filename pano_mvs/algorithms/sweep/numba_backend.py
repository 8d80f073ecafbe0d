"""The sweep, compiled: bands of rows in threads, no volume unless semi-global matching needs one.

Memory beyond the pictures and the result: a source's packed copy has 4 bytes a pixel if it is grey, 8 in colour, or 12
without vector instructions; for "box" about 3 MB a thread at 1,000 columns and 3 sources, whatever the planes and the
rows; for "sgm" on top of it 3 bytes for each pixel and plane (a uint8 volume of costs and a uint16 volume of path sums;
201 MB at 512×1024×128).

Bands and strips are handed to plain threads (the kernels release the GIL), as many as numba is told to use: they write
disjoint parts in a fixed arithmetic order, so the number of threads changes no bit. numba's own parallel regions would
take several times longer to compile, and their portable threading layer aborts when two Python threads enter it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.combination import source_weights
from pano_mvs.algorithms.sweep.kernels_band import sweep_band
from pano_mvs.algorithms.sweep.kernels_cost import COSTS
from pano_mvs.algorithms.sweep.kernels_sgm import sweep_row, sweep_strip
from pano_mvs.algorithms.sweep.kernels_vector import HAS_VECTOR
from pano_mvs.algorithms.sweep.kernels_winner import AFTER, BEFORE, BEST, RIVAL, STATES, winners_of_rows
from pano_mvs.algorithms.sweep.packing import pack_sources, pack_votes
from pano_mvs.algorithms.sweep.penalties import step_penalties, warm_up
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.windows import column_offsets
from pano_mvs.algorithms.sweep.winner import Winners
from pano_mvs.geometry import pad_panorama

_BAND_ROWS = 32
_STRIP_LINES = 128
# More than the eight paths of a plane can cost, see `SweepSettings.penalties`.
_NO_SUM = 65535

Job = TypeVar("Job")


def find_winners(work: SweepInput) -> Winners:
    """Return the winning plane of every pixel and the costs around it; equals the numpy backend's but for rounding."""
    height, width = work.reference.shape[:2]
    settings = work.settings
    with_volume = settings.aggregation == "sgm"
    volume = np.empty((height, settings.planes, width) if with_volume else (0, 0, 0), np.uint8)
    found = _unset_winners((height, width))
    prepared = _band_arguments(work)

    def sweep(first: int) -> None:
        state, planes = _fresh_state(min(_BAND_ROWS, height - first), width)
        sweep_band(first, *prepared, volume, state, planes)
        _keep(found, first, state, planes)

    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        _run(pool, sweep, range(0, height, _BAND_ROWS))
    return winners_by_paths(work, volume) if with_volume else found


def winners_by_paths(work: SweepInput, volume: NDArray[np.uint8]) -> Winners:
    """Return the winners after semi-global matching of a volume of costs, (H, D, W), whoever made it."""
    height, _, width = volume.shape
    found = _unset_winners((height, width))

    def decide(first: int) -> None:
        rows = min(_BAND_ROWS, height - first)
        state, planes = np.full((STATES, rows, width), _NO_SUM, np.uint16), np.zeros((rows, width), np.uint16)
        winners_of_rows(total, first, state, planes)
        _keep(found, first, state, planes)
        rival = found.rival[first : first + rows]
        rival[rival == _NO_SUM] = np.inf

    with ThreadPoolExecutor(numba.get_num_threads()) as pool:
        total = _aggregate(pool, work, volume)
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


def _aggregate(pool: ThreadPoolExecutor, work: SweepInput, volume: NDArray[np.uint8]) -> NDArray[np.uint16]:
    """Return the sum of the eight paths' costs, (H, D, W) uint16."""
    height, _, width = volume.shape
    settings = work.settings
    total = np.zeros(volume.shape, np.uint16)
    p1 = np.uint16(settings.penalties(height)[0])
    beyond_pole, before_seam = warm_up((height, width))
    for drift in (-1, 0, 1):
        penalties = (
            step_penalties(work.reference, (1, drift), settings),
            step_penalties(work.reference, (-1, -drift), settings),
        )
        follow = partial(_follow_lines, volume, total, penalties, p1, drift, beyond_pole)
        _run(pool, follow, range(0, width, _STRIP_LINES))
    sideways = np.stack([step_penalties(work.reference, (0, step), settings) for step in (1, -1)])
    _run(pool, lambda y: sweep_row(volume, total, sideways, p1, y, before_seam), range(height))
    return total


def _follow_lines(
    volume: NDArray[np.uint8], total: NDArray[np.uint16], penalties: tuple[NDArray[np.uint16], NDArray[np.uint16]],
    p1: np.uint16, drift: int, warm: int, first: int,
) -> None:  # fmt: skip
    """Follow a strip of lines down and then, while caches still hold it, up again."""
    height, _, width = volume.shape
    lines = min(_STRIP_LINES, width - first)
    sweep_strip(volume, total, penalties[0], p1, first, lines, drift, False, warm)
    last = (first + drift * (height - 1)) % width
    sweep_strip(volume, total, penalties[1], p1, last, lines, -drift, True, warm)


def _run(pool: ThreadPoolExecutor, work: Callable[[Job], object], jobs: Iterable[Job]) -> None:
    """Do all jobs and raise what the first of them raised."""
    for _ in pool.map(work, jobs):
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
