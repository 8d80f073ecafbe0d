"""Compiled: consistency of the points of a reference view with the range map of a source view."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from pano_mvs.geometry.kernels_sphere import angle_between, corners_at, pixel_from_ray

FloatArray = NDArray[np.float64]
Triple = FloatArray | tuple[float, float, float]

# Verdicts of a source on a point: no information; it sees the same surface; it sees something farther away through
# the point; something nearer hides the point.
UNKNOWN, AGREES, CONTRADICTS, HIDDEN = 0, 1, 2, 3


@njit(cache=True, error_model="numpy", nogil=True)
def sample_range(ranges: NDArray[np.float32], x: float, y: float, max_step: float) -> float:
    """Return the range between pixels: bilinear in 1/range if the four lie on one surface, else that of the nearest."""
    height, width = ranges.shape
    row_0, row_1, column_00, column_01, column_10, column_11, weight_x, weight_y = corners_at(x, y, height, width)
    r00, r01 = ranges[row_0, column_00], ranges[row_0, column_01]
    r10, r11 = ranges[row_1, column_10], ranges[row_1, column_11]
    near, far = min(min(r00, r01), min(r10, r11)), max(max(r00, r01), max(r10, r11))
    # min and max may swallow a NaN; the sum does not.
    if math.isfinite(r00 + r01 + r10 + r11) and far <= near * (1 + max_step):
        upper = (1 - weight_x) / r00 + weight_x / r01
        lower = (1 - weight_x) / r10 + weight_x / r11
        return float(1.0 / ((1 - weight_y) * upper + weight_y * lower))
    if weight_y < 0.5:
        return float(r00) if weight_x < 0.5 else float(r01)
    return float(r10) if weight_x < 0.5 else float(r11)


@njit(cache=True, error_model="numpy", nogil=True, inline="always")
def transformed(point: Triple, rotation: FloatArray, translation: FloatArray) -> tuple[float, float, float]:
    """Return R x + t of a point (3 numbers)."""
    a = rotation[0, 0] * point[0] + rotation[0, 1] * point[1] + rotation[0, 2] * point[2] + translation[0]
    b = rotation[1, 0] * point[0] + rotation[1, 1] * point[1] + rotation[1, 2] * point[2] + translation[1]
    c = rotation[2, 0] * point[0] + rotation[2, 1] * point[1] + rotation[2, 2] * point[2] + translation[2]
    return a, b, c


@njit(cache=True, error_model="numpy", nogil=True)
def reprojection_angle(point: Triple, baseline: FloatArray, ratio: float) -> float:
    """Return the angle, at the reference, between a point and the source's point along its own ray.

    `baseline` is the source's centre in the reference frame; the source puts the point at
    baseline + ratio (point − baseline).
    """
    other_0 = baseline[0] + ratio * (point[0] - baseline[0])
    other_1 = baseline[1] + ratio * (point[1] - baseline[1])
    other_2 = baseline[2] + ratio * (point[2] - baseline[2])
    angle: float = angle_between(point[0], point[1], point[2], other_0, other_1, other_2)
    return angle


@njit(cache=True, error_model="numpy", nogil=True)
def judge_point(
    point: Triple,
    rotation: FloatArray,
    translation: FloatArray,
    baseline: FloatArray,
    ranges: NDArray[np.float32],
    limits: Triple,
) -> tuple[int, float, float, float, float]:
    """Return (verdict, relative error, x, y, source range) of one source on one point.

    `limits` holds the maximum relative error, the maximum reprojection angle in radians, and the maximum relative
    step between neighbours on one surface.
    """
    a, b, c = transformed(point, rotation, translation)
    x, y = pixel_from_ray(a, b, c, ranges.shape[0], ranges.shape[1])
    distance = math.sqrt(a * a + b * b + c * c)
    if not distance > 0:
        return UNKNOWN, 0.0, x, y, 0.0
    seen = sample_range(ranges, x, y, limits[2])
    if not math.isfinite(seen):
        return UNKNOWN, 0.0, x, y, 0.0
    error = abs(seen - distance) / distance
    if error <= limits[0] and reprojection_angle(point, baseline, seen / distance) <= limits[1]:
        return AGREES, error, x, y, seen
    if seen > distance * (1 + 2 * limits[0]):
        return CONTRADICTS, error, x, y, seen
    if seen < distance * (1 - 2 * limits[0]):
        return HIDDEN, error, x, y, seen
    return UNKNOWN, error, x, y, seen


@njit(cache=True, error_model="numpy", nogil=True)
def squared_motion(point: Triple, distance: float, baseline: FloatArray) -> float:
    """Return the squared motion of a point, in radians at the source, per relative change of its range.

    It is (sin γ r / d)², where γ is the angle between the two rays and r and d are the distances of the cameras.
    """
    square = point[0] * point[0] + point[1] * point[1] + point[2] * point[2]
    along = point[0] * baseline[0] + point[1] * baseline[1] + point[2] * baseline[2]
    length = baseline[0] * baseline[0] + baseline[1] * baseline[1] + baseline[2] * baseline[2]
    motion: float = max(square * length - along * along, 0.0) / distance**4
    return motion


@njit(cache=True, error_model="numpy", nogil=True)
def judge_rows(
    first: int,
    rows: int,
    ranges: NDArray[np.float32],
    rays: FloatArray,
    view: tuple[FloatArray, FloatArray],
    source_ranges: NDArray[np.float32],
    limits: FloatArray,
    verdicts: NDArray[np.uint8],
    supports: FloatArray,
    motions: FloatArray,
) -> None:
    """Write the verdicts of one source on the pixels of some rows.

    Args:
        first: the first row.
        rows: number of rows.
        ranges: (H, W) float32 of the reference.
        rays: (H, W, 3) its rays.
        view: rotation (3, 3) and translation (3,) source_from_reference.
        source_ranges: (Hs, Ws) float32.
        limits: see `judge_point`.
        verdicts: (H, W) uint8, written.
        supports: (H, W) float64, written: (1 − (angle / limit)²)² where the source agrees, else 0.
        motions: (H, W) float64, written: `squared_motion` where the source agrees, else 0.
    """
    rotation, translation = view
    baseline = -(rotation.T @ translation)
    for row in range(first, first + rows):
        for column in range(ranges.shape[1]):
            r = ranges[row, column]
            verdicts[row, column], supports[row, column], motions[row, column] = UNKNOWN, 0.0, 0.0
            if not math.isfinite(r):
                continue
            ray = rays[row, column]
            point = (r * ray[0], r * ray[1], r * ray[2])
            verdict, _, _, _, seen = judge_point(point, rotation, translation, baseline, source_ranges, limits)
            verdicts[row, column] = verdict
            if verdict == AGREES:
                a, b, c = transformed(point, rotation, translation)
                distance = math.sqrt(a * a + b * b + c * c)
                share = reprojection_angle(point, baseline, seen / distance) / limits[1]
                supports[row, column] = (1.0 - share * share) ** 2
                motions[row, column] = squared_motion(point, distance, baseline)
