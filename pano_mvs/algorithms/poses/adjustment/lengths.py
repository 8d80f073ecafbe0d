"""Lengths of baselines that rays leave open: by the floor under upright cameras, or as they were before."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.adjustment.bundle import Bundle, Lengths
from pano_mvs.core.arrays import FloatArray

# The floor around two cameras: at most this far away, in heights; points within a factor of the same height; a level
# with this many points, and more than twice as many as any other.
_REACH, _SAME_LEVEL, _MIN_POINTS = 2.5, 0.04, 8
# Of the logarithm of a length that observations leave open: of one that the floor determines before.
_LENGTH_STD = 0.06


def floor_lengths(bundle: Bundle, *, scale_rad: float) -> Lengths | None:
    """Return the lengths of baselines at which all cameras stand equally high above the floor; None if unknown.

    They are uncertain by the spread of the heights that were found, so that they count little where heights differ.

    Args:
        bundle: its cameras, with y down in the frames of those that stand upright.
        scale_rad: scale of the loss of the rays.
    """
    if not len(bundle.points):
        return None
    downs = bundle.rotations[:, 1, :]
    down = downs.mean(axis=0)
    down /= max(float(np.linalg.norm(down)), 1e-12)
    # Of a typical camera against all: others are not known to be upright.
    if np.median(np.arccos(np.clip(downs @ down, -1, 1))) > float(np.deg2rad(3.0)):
        return None
    pairs, heights = _heights(bundle, down)
    baselines = np.linalg.norm(bundle.centers[pairs[:, 0]] - bundle.centers[pairs[:, 1]], axis=1)
    # In heights: shorter ones do not determine the height, and would be held at any length.
    long = baselines > 0.2 * heights
    pairs, heights, baselines = pairs[long], heights[long], baselines[long]
    if len(pairs) < 3:
        return None
    differences = np.log(heights / np.median(heights))
    # A length whose height differs by more comes from a table, or from cameras at different heights. In a real tour of
    # 20 panoramas, 28 of 35 are within 1.6 %, the others at 7 to 14 %, all due to wrong lengths.
    same = np.abs(differences) < 0.25
    # What is known of the spread of heights before any is measured.
    std = max(0.02, 1.4826 * float(np.median(np.abs(differences))), 0.1 / len(pairs) ** 0.5)
    lengths = (baselines * np.exp(-differences))[same]
    return Lengths(pairs[same], lengths, np.full(len(lengths), std), _weight_of_lengths(bundle, scale_rad))


def lengths_of(pairs: NDArray[np.intp], centers: FloatArray) -> FloatArray:
    """Return the distances (K,) of pairs of cameras (K, 2) by their centres (N, 3)."""
    return np.asarray(np.linalg.norm(centers[pairs[:, 0]] - centers[pairs[:, 1]], axis=1))


def open_lengths(bundle: Bundle, pairs: NDArray[np.intp], lengths: FloatArray, *, scale_rad: float) -> Lengths | None:
    """Return the lengths that are to be kept because observations leave them open; None without any.

    Args:
        bundle: the cameras.
        pairs: (K, 2) `pairs_of_scales` of it, or of the same cameras with more observations.
        lengths: (K,) their lengths before.
        scale_rad: scale of the loss of the rays.
    """
    # Only cameras that still share points are beside each other in the system of the cameras.
    kept = [np.isin(*(bundle.point_idx[bundle.image_idx == camera] for camera in pair)).any() for pair in pairs]
    if len(pairs) < 2 or not any(kept):
        return None
    stds = np.full(np.count_nonzero(kept), _LENGTH_STD)
    return Lengths(pairs[kept], lengths[kept], stds, _weight_of_lengths(bundle, scale_rad))


def _weight_of_lengths(bundle: Bundle, scale_rad: float) -> float:
    """Return the weight of lengths in standard deviations relative to that of rays in units of the scale."""
    # 1.39 is the squared median of the length of a normal vector of variance 1 in each of two directions.
    return float(np.median(bundle.scaled_errors_rad()) / scale_rad) ** 2 / 1.39


def pairs_of_scales(bundle: Bundle) -> NDArray[np.intp]:
    """Return a pair of cameras (K, 2) of each part of a bundle with a scale of its own, that which shares most points.

    Points that three cameras see, or three pairs of three cameras, tie the lengths of these pairs to one another. What
    hangs on a single pair, such as a room that two panoramas see through a door, can be at any distance along its
    direction, and drifts.
    """
    count = len(bundle.centers)
    seen = scipy.sparse.coo_array(
        (np.ones(len(bundle.point_idx), np.int32), (bundle.point_idx, bundle.image_idx)), (len(bundle.points), count)
    ).tocsr()
    seen.data[:] = 1
    shared = (seen.T @ seen).toarray()
    first, second = np.nonzero(np.triu(shared, 1) >= _MIN_POINTS)
    number = np.full((count, count), -1, np.int32)
    number[first, second] = number[second, first] = np.arange(len(first))
    rows, columns = [np.zeros(0, np.intp)], [np.zeros(0, np.int32)]
    for edge, (one, other) in enumerate(zip(first, second, strict=True)):
        thirds = np.flatnonzero((number[one] >= 0) & (number[other] >= 0))
        columns += [number[one, thirds], number[other, thirds]]
        rows.append(np.full(2 * len(thirds), edge))
    at = np.concatenate(rows), np.concatenate(columns)
    joined = scipy.sparse.coo_array((np.ones(len(at[0])), at), (len(first), len(first)))
    _, part = scipy.sparse.csgraph.connected_components(joined, directed=False)
    best = np.lexsort((-shared[first, second], part))
    chosen = best[np.flatnonzero(np.diff(part[best], prepend=-1))]
    return np.column_stack([first, second])[chosen]


def _heights(bundle: Bundle, down: FloatArray) -> tuple[NDArray[np.intp], FloatArray]:
    """Return pairs of cameras (K, 2), ascending, and their heights (K,) above the level of most points they share."""
    towards = bundle.points[bundle.point_idx] - bundle.centers[bundle.image_idx]
    below = towards @ down
    level = np.linalg.norm(towards - below[:, None] * down, axis=1)
    is_floor = (below > 0) & (level < _REACH * below)
    # Each observation and the next one of the same point.
    both = is_floor[:-1] & is_floor[1:] & (bundle.point_idx[:-1] == bundle.point_idx[1:])
    both &= np.abs(np.log(np.where(both, below[:-1] / below[1:], 1.0))) < _SAME_LEVEL
    first = np.flatnonzero(both)
    pairs = np.sort(np.column_stack([bundle.image_idx[first], bundle.image_idx[first + 1]]), axis=1).astype(np.intp)
    logs = np.log(below[first] * below[first + 1]) / 2
    order = np.lexsort((logs, pairs[:, 1], pairs[:, 0]))
    pairs, logs = pairs[order], logs[order]
    starts = np.flatnonzero(np.diff(pairs, axis=0, prepend=-1).any(axis=1))
    levels = np.array([_level(part) for part in np.split(logs, starts)[1:]])
    known = np.isfinite(levels)
    return pairs[starts[known]], np.exp(levels[known])


def _level(logs: FloatArray) -> float:
    """Return the logarithm of the height that most of some, ascending, have in common; NaN if there is none."""
    counts = np.searchsorted(logs, logs + _SAME_LEVEL, side="right") - np.arange(len(logs))
    best = int(counts.argmax())
    chosen = logs[best : best + counts[best]]
    rivals = counts[(logs < chosen[0] - _SAME_LEVEL) | (logs > chosen[-1])]
    is_clear = counts[best] >= _MIN_POINTS and 2 * rivals.max(initial=0) <= counts[best]
    return float(np.mean(chosen)) if is_clear else np.nan
