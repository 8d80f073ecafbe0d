"""Compiled: project a band of rows into a source, exactly in every eighth row and by cubic interpolation between.

The exact position costs two arc tangents. Along a column of the reference it is smooth but near the poles of the
source: there, where four exact rows are bent too much (their third difference is large, and with it the fourth, of
which a cubic between them misses 0.023), it is computed exactly. Rows, not columns, are skipped: a
rolled picture then has the same positions, and the inner loops have no border.
"""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.sweep.numba.kernels_records import F32, F64, I64, U8
from pano_mvs.algorithms.sweep.numba.kernels_warp import project_row
from pano_mvs.core.kernels import inlined, kernel

_F = np.float32
_U = np.uint64

EVERY = 8
"""Rows from one exact row to the next."""

_BLOCK = 16
_MAX_THIRD_PX = _F(1)
# In a lower picture, eight rows are a large step on the sphere, so all positions are exact.
_LOWEST_PICTURE = 128


@kernel
def ray_row(y: int, height: int, pose: F64, virtual_range: float, matrix: F32, offset: F32) -> None:
    """Compute what takes (sin θ, cos θ) of row y, which may lie beyond a pole, into the source; see `project_row`."""
    elevation = np.pi * (0.5 - (y + 0.5) / height)
    level, dip = np.cos(elevation), -np.sin(elevation)
    for a in range(3):
        matrix[a, 0] = _F(level * pose[a, 0])
        matrix[a, 1] = _F(level * pose[a, 2])
        offset[a] = _F(dip * pose[a, 1] + pose[a, 3] / virtual_range)


@inlined
def _across(step: np.float32, turn: np.float32) -> np.float32:
    """Return a difference of columns the short way around."""
    half = _F(turn * _F(0.5))
    step = step - turn if step > half else step
    return step + turn if step < -half else step


@kernel
def fit_group(knots: F32, first: int, height: int, turn: np.float32, curve: F32, rough: U8) -> None:
    """Fit cubics through the exact rows `first` to `first` + 3, and see where they are too bent for that.

    Args:
        knots: (2, K, W) float32 x and y of the exact rows.
        first: of them.
        height: rows of the reference picture.
        turn: columns of the source, float32.
        curve: (2, 3, W) float32, written: first, second and third differences of x and of y.
        rough: (W,) uint8, written: whether the cubic misses.
    """
    k, one, two, three = _U(first), _U(first + 1), _U(first + 2), _U(first + 3)
    largest = _MAX_THIRD_PX if height >= _LOWEST_PICTURE else _F(-1)
    for i in range(_U(rough.shape[0])):
        step = _across(knots[0, one, i] - knots[0, k, i], turn)
        after = _across(knots[0, two, i] - knots[0, one, i], turn)
        last = _across(knots[0, three, i] - knots[0, two, i], turn)
        curve[0, 0, i] = step
        curve[0, 1, i] = after - step
        curve[0, 2, i] = (last - after) - (after - step)
    for i in range(_U(rough.shape[0])):
        step = knots[1, one, i] - knots[1, k, i]
        after = knots[1, two, i] - knots[1, one, i]
        last = knots[1, three, i] - knots[1, two, i]
        curve[1, 0, i] = step
        curve[1, 1, i] = after - step
        curve[1, 2, i] = (last - after) - (after - step)
    for i in range(_U(rough.shape[0])):
        rough[i] = np.uint8((abs(curve[0, 2, i]) > largest) | (abs(curve[1, 2, i]) > largest))


@kernel
def rough_runs(rough: U8, runs: I64) -> int:
    """Write the runs of blocks of columns that need exact positions, (·, 2) int64 start and stop; return how many."""
    width = rough.shape[0]
    count = 0
    for start in range(0, width, _BLOCK):
        stop = min(start + _BLOCK, width)
        found = np.int32(0)
        for i in range(_U(start), _U(stop)):
            found += np.int32(rough[i])
        if not found:
            continue
        if count and runs[count - 1, 1] == start:
            runs[count - 1, 1] = stop
            continue
        runs[count, 0], runs[count, 1] = start, stop
        count += 1
    return count


@kernel
def replace_rough(rough: U8, exact: F32, start: int, stop: int, x_px: F32, y_px: F32) -> None:
    """Take the exact positions, (2, W), of the rough columns, and of no others: blocks must not show in the result."""
    for i in range(_U(start), _U(stop)):
        x_px[i] = exact[0, i] if rough[i] else x_px[i]
        y_px[i] = exact[1, i] if rough[i] else y_px[i]


@kernel
def follow_curve(knots: F32, first: int, curve: F32, step: float, x_px: F32, y_px: F32) -> None:
    """Evaluate the cubics `step` exact rows after `first`, at most 3; writes x_px and y_px, (W,) float32."""
    k = _U(first)
    t = _F(step)
    u = _F(step * (step - 1) / 2)
    v = _F(step * (step - 1) * (step - 2) / 6)
    for i in range(_U(x_px.shape[0])):
        x_px[i] = knots[0, k, i] + t * curve[0, 0, i] + u * curve[0, 1, i] + v * curve[0, 2, i]
    for i in range(_U(x_px.shape[0])):
        y_px[i] = knots[1, k, i] + t * curve[1, 0, i] + u * curve[1, 1, i] + v * curve[1, 2, i]


@kernel
def knot_rows(rows: int) -> int:
    """Return how many exact rows a band of `rows` needs; at least four."""
    return max(-(-(rows - 1) // EVERY) + 1, 4)


@kernel
def project_knots(
    first: int, height: int, sin_cos_azimuth: F32, pose: F64, virtual_range: float, shape: I64, knots: F32
) -> None:
    """Compute every eighth row from `first` exactly, into (2, K, W) float32."""
    matrix = np.empty((3, 2), np.float32)
    offset = np.empty(3, np.float32)
    for k in range(knots.shape[1]):
        ray_row(first + k * EVERY, height, pose, virtual_range, matrix, offset)
        project_row(sin_cos_azimuth, matrix, offset, shape, 0, knots.shape[2], knots[0, k], knots[1, k])
