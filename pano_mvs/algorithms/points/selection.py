"""Select evenly distributed points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.core.errors import UsageError

_EXCESS = 0.02
# Ratio of points after voxel selection, and number of a point's neighbours to examine for discs: points are on
# surfaces, where no more fit around one.
_CHOICE, _NEIGHBOURS = 2.5, 16
_LEVELS_PER_OCTAVE = 3
# Odd numbers without structure, to hash the positions of voxels to 64-bit numbers.
_MIX = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0xD6E8FEB86659FD93], np.uint64)


def spread_points(
    points: NDArray[np.float64], spacing: NDArray[np.float64], count: int, *, rng: np.random.Generator
) -> NDArray[np.intp]:
    """Select `count` points whose distances to their neighbours are proportional to `spacing`.

    There are two steps, each with the largest width, to about 2 %, that leaves enough points. First, space is divided
    into voxels with edges proportional to the spacing, rounded to one of a few sizes, and the point nearest to each
    voxel's centre is kept, about 2.5 times the wanted number. Then, in random order, a point is kept unless a kept one
    is closer than a disc's radius, which is proportional to the spacing (Poisson discs: Cook, "Stochastic sampling in
    computer graphics", 1986). The remaining excess is removed at random.

    `points`: (M, 3). `spacing`: (M,) wanted distance to the neighbours at each point, in any unit: only ratios matter.
    `count`: number of points to keep; all, if there are fewer. `rng`: draws the order and the excess.

    Returns:
        (min(count, M),) positions in `points`, ascending.

    Raises:
        UsageError: if shapes disagree or a spacing is not positive.
    """
    if points.ndim != 2 or spacing.shape != (len(points),) or not (spacing > 0).all() or count < 1:
        raise UsageError("spread_points needs points (M, 3), as many positive spacings, and a positive count")
    kept = _one_per_voxel(points, spacing, int(np.ceil(_CHOICE * count)))
    if len(kept) > count:
        kept = kept[_discs(points[kept], spacing[kept], count, rng=rng)]
    dropped = rng.permutation(len(kept))[count:]
    return np.sort(np.delete(kept, dropped))


def _widest(low: float, high: float, wanted: int, *, left: Callable[[float], int]) -> float:
    """Return the largest width between two limits, to about 2 %, that leaves enough points; `left` is decreasing."""
    for _ in range(24):
        middle = float(np.sqrt(low * high))
        found = left(middle)
        if found < wanted:
            high = middle
            continue
        low = middle
        if found <= wanted * (1 + _EXCESS):
            break
    return low


def _one_per_voxel(points: NDArray[np.float64], spacing: NDArray[np.float64], wanted: int) -> NDArray[np.intp]:
    if len(points) <= wanted:
        return np.arange(len(points))
    levels = np.rint(_LEVELS_PER_OCTAVE * np.log2(spacing / spacing.min()))
    edges = np.exp2(levels / _LEVELS_PER_OCTAVE)
    extent = max(float(np.ptp(points, axis=0).max()), 1e-9)
    width = _widest(1e-7 * extent, 2 * extent, wanted, left=lambda width: _occupied(points, edges * width, levels))
    return _nearest_to_centers(points, edges * width, levels)


def _discs(
    points: NDArray[np.float64], spacing: NDArray[np.float64], wanted: int, *, rng: np.random.Generator
) -> NDArray[np.intp]:
    """Return points of which no two are closer than the smaller of their discs' radii."""
    order = rng.permutation(len(points))
    ranks = list(range(2, min(_NEIGHBOURS, len(points)) + 1))
    distance, neighbour = (np.asarray(found) for found in cKDTree(points).query(points, k=ranks))
    first = np.repeat(np.arange(len(points)), distance.shape[1])
    second = neighbour.ravel()
    width = distance.ravel() / np.minimum(spacing[first], spacing[second])
    later = order[first] > order[second]  # each pair occurs once or twice, once with the later one first
    first, second = np.where(later, first, second), np.where(later, second, first)

    def left(radius: float) -> NDArray[np.intp]:
        close = width < radius
        return _undisturbed(first[close], second[close], len(points))

    low = max(float(width.min()), 1e-12)
    return left(_widest(0.5 * low, 2 * float(width.max()), wanted, left=lambda radius: len(left(radius))))


def _undisturbed(later: NDArray[np.intp], earlier: NDArray[np.intp], total: int) -> NDArray[np.intp]:
    """Return the points to keep, given conflicting pairs: the earlier one is kept unless it was removed before."""
    stays, open_ = np.zeros(total, np.bool_), np.ones(total, np.bool_)
    while open_.any():
        waits = np.zeros(total, np.bool_)
        waits[later] = True
        safe = open_ & ~waits
        stays |= safe
        open_ &= ~safe
        open_[later[safe[earlier]]] = False
        alive = open_[later] & open_[earlier]
        later, earlier = later[alive], earlier[alive]
    return np.flatnonzero(stays)


def _voxels(points: NDArray[np.float64], edges: NDArray[np.float64], levels: NDArray[np.float64]) -> NDArray[np.uint64]:
    """Return a hash of the voxel of each point; collisions are practically impossible."""
    places = np.concatenate([np.floor(points / edges[:, None]), levels[:, None]], axis=1)
    keys = np.zeros(len(points), np.uint64)
    for axis in range(4):
        keys = (keys ^ places[:, axis].astype(np.int64).view(np.uint64)) * _MIX[axis]
        keys ^= keys >> np.uint64(29)
    return keys


def _occupied(points: NDArray[np.float64], edges: NDArray[np.float64], levels: NDArray[np.float64]) -> int:
    keys = np.sort(_voxels(points, edges, levels))
    return int((np.diff(keys) != 0).sum()) + 1


def _nearest_to_centers(
    points: NDArray[np.float64], edges: NDArray[np.float64], levels: NDArray[np.float64]
) -> NDArray[np.intp]:
    """Return the point nearest to the centre of each occupied voxel, the first one for ties."""
    place = points / edges[:, None]
    distance = np.square(place - np.floor(place) - 0.5).sum(axis=1)
    keys = _voxels(points, edges, levels)
    order = np.lexsort((distance, keys))
    first = np.ones(len(order), np.bool_)
    first[1:] = np.diff(keys[order]) != 0
    return order[first]
