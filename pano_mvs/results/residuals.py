"""Reprojection residuals of the points in degrees, over all views and for each view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import angle_between
from pano_mvs.scene import Poses

_BLOCK = 250_000
_BINS = 30


@dataclass(frozen=True)
class Histogram:
    """Counts over bins of equal width, the last of which includes all larger values."""

    counts: tuple[int, ...]
    upper_deg: float  # nominal end of the last bin
    median_deg: float
    p95_deg: float  # 95 % are smaller
    total: int

    @property
    def median_at(self) -> float:
        """Where the median lies between 0 and the end of the scale, as a share."""
        return min(1.0, self.median_deg / self.upper_deg)

    @property
    def count_ticks(self) -> tuple[int, ...]:
        """Round counts for an axis: from 0 to at least the largest count, in three to six steps or in steps of 1."""
        largest = max(1, *self.counts)
        power = 10 ** (len(str(largest)) - 1)
        steps = [step for step in (power // 5, power // 2, power, 2 * power) if step] or [1]
        step = next(step for step in (*steps, 5 * power) if -(-largest // step) <= 5)
        return tuple(range(0, step * -(-largest // step) + 1, step))


@dataclass(frozen=True)
class Residuals:
    """Reprojection residuals of the points."""

    overall: Histogram  # of all observations
    # image name to (median, 95 % quantile) in degrees and the number of observations
    views: Mapping[str, tuple[float, float, int]]
    sampled: bool  # whether only evenly spaced observations were used


def histogram(values_deg: Sequence[float] | FloatArray) -> Histogram | None:
    """Return the histogram of the finite values, or None if there are none."""
    values = np.asarray(values_deg, np.float64)
    values = values[np.isfinite(values)]
    if not len(values):
        return None
    median, p95, p98 = (float(value) for value in np.quantile(values, [0.5, 0.95, 0.98]))
    upper = _round_up(max(1.01 * p98, 1e-6))  # so that only larger values are in the last column
    counts = np.bincount((values / upper * _BINS).astype(np.int64).clip(0, _BINS - 1), minlength=_BINS)
    return Histogram(tuple(map(int, counts)), upper, median, p95, len(values))


def reprojection_residuals(poses: Poses) -> Residuals | None:
    """Return the angles between the rays of all tracks and those to their points; None if there are no tracks.

    At most two million evenly spaced observations are used.
    """
    total = len(poses.track_point_idx)
    if not total:
        return None
    step = -(-total // 2_000_000)
    image_idx = np.asarray(poses.track_image_idx[::step])
    residuals_deg = _residuals_deg(poses, step)
    overall = histogram(residuals_deg)
    if overall is None:
        return None
    order = np.argsort(image_idx, kind="stable")
    ends = np.searchsorted(image_idx[order], np.arange(len(poses.names) + 1))
    views = {}
    for idx, name in enumerate(poses.names):
        own = residuals_deg[order[ends[idx] : ends[idx + 1]]]
        if len(own):
            median, p95 = np.quantile(own, [0.5, 0.95])
            views[name] = float(median), float(p95), len(own) * step
    return Residuals(overall, views, step > 1)


def _residuals_deg(poses: Poses, step: int) -> FloatArray:
    """Return the residual of every step-th observation, computed in blocks to limit memory."""
    point_idx, image_idx = poses.track_point_idx[::step], poses.track_image_idx[::step]
    bearings = poses.track_bearings[::step]
    found = np.empty(len(point_idx))
    for start in range(0, len(found), _BLOCK):
        block = slice(start, start + _BLOCK)
        points, images = np.asarray(poses.points_in_world)[point_idx[block]], image_idx[block]
        in_cam = np.einsum("nij,nj->ni", np.asarray(poses.rotations)[images], points)
        found[block] = angle_between(in_cam + np.asarray(poses.translations)[images], bearings[block])
    return np.rad2deg(found)


def _round_up(value: float) -> float:
    """Return the smallest of 1, 2, 4, 6, 8, 10 × 10ⁿ that is not smaller: their quarters are short numbers."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(next(step * power for step in (1, 2, 4, 6, 8, 10) if step * power >= value * (1 - 1e-9)))
