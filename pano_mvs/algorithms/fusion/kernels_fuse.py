"""Compiled: normals of a range map, and the support of sources for the pixels of a reference view."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.ranges.kernels_agreement import AGREES, CONTRADICTS, Triple, judge_row
from pano_mvs.core.kernels import inlined, kernel
from pano_mvs.geometry.kernels_sphere import bilinear, corners_at, pixel_at, wrapped_column, wrapped_row

FloatArray = NDArray[np.float64]


Reference = tuple[NDArray[np.float32], tuple[FloatArray, FloatArray], NDArray[np.float32], NDArray[np.bool_]]
Source = tuple[FloatArray, FloatArray, NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32]]
Tallies = tuple[
    NDArray[np.bool_], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8], FloatArray, FloatArray, FloatArray
]


@inlined
def solve_symmetric(a: FloatArray, b: FloatArray) -> tuple[float, float, float, bool]:
    """Return the solution of a symmetric 3×3 system, a = (xx, xy, xz, yy, yz, zz), and whether it is well posed."""
    c00, c01, c02 = a[3] * a[5] - a[4] * a[4], a[2] * a[4] - a[1] * a[5], a[1] * a[4] - a[2] * a[3]
    determinant = a[0] * c00 + a[1] * c01 + a[2] * c02
    trace = a[0] + a[3] + a[5]
    if not determinant > 1e-14 * trace * trace * trace:
        return 0.0, 0.0, 0.0, False
    c11, c12, c22 = a[0] * a[5] - a[2] * a[2], a[1] * a[2] - a[0] * a[4], a[0] * a[3] - a[1] * a[1]
    x = (c00 * b[0] + c01 * b[1] + c02 * b[2]) / determinant
    y = (c01 * b[0] + c11 * b[1] + c12 * b[2]) / determinant
    z = (c02 * b[0] + c12 * b[1] + c22 * b[2]) / determinant
    return x, y, z, True


@kernel
def fit_normals(
    pixels: tuple[FloatArray, FloatArray, NDArray[np.bool_]],
    stretches: NDArray[np.int64],
    radius: int,
    max_step: float,
    rows: tuple[int, int],
    normals: NDArray[np.float32],
) -> None:
    """Write unit normals towards the camera of the rows [first, end) into (H, W, 3) float32.

    A normal is that of the plane p with p · ray = 1 / range around a pixel, in units of its own 1 / range. `pixels` is
    (inverse ranges, rays, bool where a normal is wanted), (H, W, ...). Pixels that already have a normal keep it;
    nothing is written where the plane is undefined.
    """
    inverse, rays, wanted = pixels
    height, width = inverse.shape
    a, b = np.empty(6), np.empty(3)
    for row in range(rows[0], rows[1]):
        for column in range(width):
            open_yet = wanted[row, column] and not math.isfinite(normals[row, column, 0])
            if not open_yet or not math.isfinite(inverse[row, column]):
                continue
            center = inverse[row, column]
            a[:] = 0.0
            b[:] = 0.0
            count = 0
            for d_row in range(-radius, radius + 1):
                for d_column in range(-radius, radius + 1):
                    other_row = wrapped_row(row + d_row, height)
                    other_column = wrapped_column(row + d_row, column + d_column * stretches[row], height, width)
                    value = inverse[other_row, other_column] / center
                    deviation = abs(value - 1) / (max_step * max(max(abs(d_row), abs(d_column)), 1))
                    if not deviation < 1:  # NaN included
                        continue
                    weight = (1 - deviation * deviation) ** 2
                    ray = rays[other_row, other_column]
                    x, y, z = ray[0], ray[1], ray[2]
                    a[0] += weight * x * x
                    a[1] += weight * x * y
                    a[2] += weight * x * z
                    a[3] += weight * y * y
                    a[4] += weight * y * z
                    a[5] += weight * z * z
                    b[0] += weight * value * x
                    b[1] += weight * value * y
                    b[2] += weight * value * z
                    count += 1
            # Three points may lie on a line; half of the smallest window cannot.
            if count < 5:
                continue
            x, y, z, ok = solve_symmetric(a, b)
            length = math.sqrt(x * x + y * y + z * z)
            if ok and length > 0:
                # p · ray > 0 at the surface, so −p points towards the camera.
                normals[row, column, 0] = -x / length
                normals[row, column, 1] = -y / length
                normals[row, column, 2] = -z / length


@kernel
def find_supported(
    ranges: NDArray[np.float32],
    confirmed: NDArray[np.bool_],
    stretches: NDArray[np.int64],
    radius: int,
    max_step: float,
    least: float,
) -> NDArray[np.bool_]:
    """Return the pixels, (H, W) bool, that are not confirmed although at least a share `least` of their window is.

    Pixels of the window count if they are confirmed and on the surface of the pixel.
    """
    height, width = ranges.shape
    supported = np.zeros((height, width), np.bool_)
    for row in range(height):
        for column in range(width):
            center = ranges[row, column]
            if not math.isfinite(center) or confirmed[row, column]:
                continue
            count = 0
            for d_row in range(-radius, radius + 1):
                for d_column in range(-radius, radius + 1):
                    other_row = wrapped_row(row + d_row, height)
                    other_column = wrapped_column(row + d_row, column + d_column * stretches[row], height, width)
                    if confirmed[other_row, other_column]:
                        steps = max(max(abs(d_row), abs(d_column)), 1)
                        if abs(center / ranges[other_row, other_column] - 1) < max_step * steps:
                            count += 1
            supported[row, column] = count / (2 * radius + 1) ** 2 >= least
    return supported


@inlined
def add_color(image: NDArray[np.uint8], x: float, y: float, weight: float, color: FloatArray) -> None:
    """Add the bilinear colour at a position, times a weight, to color (4,): r, g, b, weight."""
    height, width = image.shape[0], image.shape[1]
    row_0, row_1, column_00, column_01, column_10, column_11, weight_x, weight_y = corners_at(x, y, height, width)
    for channel in range(3):
        upper_left, upper_right = image[row_0, column_00, channel], image[row_0, column_01, channel]
        lower_left, lower_right = image[row_1, column_10, channel], image[row_1, column_11, channel]
        value = bilinear(upper_left, upper_right, lower_left, lower_right, weight_x, weight_y)
        color[channel] += weight * value
    color[3] += weight


@inlined
def pixel_footprint(view: Triple, normal: NDArray[np.float32]) -> float:
    """Return the surface area, per steradian, that a camera sees along `view` (camera to point): r² / cosine.

    The cosine is at least 0.05: normals are not accurate enough for less.
    """
    squared = view[0] * view[0] + view[1] * view[1] + view[2] * view[2]
    cosine = -(view[0] * normal[0] + view[1] * normal[1] + view[2] * normal[2]) / math.sqrt(squared)
    footprint: float = squared / max(cosine, 0.05)
    return footprint


@kernel
def add_source(
    reference: Reference, source: Source, limits: FloatArray, rows: tuple[int, int], tallies: Tallies
) -> None:
    """Add one source's support for the pixels of the rows [first, end) of a reference view.

    `reference` is (ranges, sines of the grid, normals, bool where a point may be written); `source` is (rotation,
    translation of source_from_reference, ranges, confidence, image, relative uncertainties); if the latter are not
    known, they are (0, 0), and all ranges are taken as equally uncertain relative to the range. `limits` holds the
    three of `judge_point`, the maximum ratio of this view's footprint to the source's, the maximum relative difference
    of merged points, and the minimum confidence of a contradiction. `tallies` changes in place: yields (H, W) bool is
    set where the footprint is too large; counts, violations and confidence (H, W) uint8 of agreeing views, of
    contradicting ones, and the largest confidence; sums (H, W, 4) of weighted points in the reference frame and their
    weights; colors (H, W, 4) likewise; precisions (H, W), the largest 1 / variance of the merged points, (0, 0) if it
    is unknown. Where no point may be written, only counts and violations change.
    """
    ranges, (turns, elevations), normals, written = reference
    rotation, translation, source_ranges, source_confidence, image, uncertainty = source
    yields, counts, violations, confidence, sums, colors, precisions = tallies
    center = -(rotation.T @ translation)
    weighted = uncertainty.size > 0
    sigma = 1.0
    verdicts, found = np.empty(ranges.shape[1], np.uint8), np.empty((5, ranges.shape[1]))
    view, bounds = (rotation, translation, center), (limits[0], limits[1], limits[2])
    for row in range(rows[0], rows[1]):
        sine, cosine = elevations[0, row], elevations[1, row]
        judge_row(ranges[row], turns, (sine, cosine), view, source_ranges, bounds, verdicts, found)
        for column in range(ranges.shape[1]):
            verdict, x, y = verdicts[column], found[0, column], found[1, column]
            if verdict != AGREES and verdict != CONTRADICTS:
                continue
            at = pixel_at(x, y, source_confidence.shape[0], source_confidence.shape[1])
            if verdict == CONTRADICTS:
                violations[row, column] += source_confidence[at] >= limits[5]
                continue
            counts[row, column] += 1
            if not written[row, column]:
                continue
            r, normal = ranges[row, column], normals[row, column]
            point = (r * (cosine * turns[0, column]), r * -sine, r * (cosine * turns[1, column]))
            distance, seen = found[2, column], found[3, column]
            error = abs(seen - distance) / distance
            confidence[row, column] = max(confidence[row, column], source_confidence[at])
            seen_from = (point[0] - center[0], point[1] - center[1], point[2] - center[2])
            footprint = pixel_footprint(seen_from, normal)
            if pixel_footprint(point, normal) > limits[3] * footprint:
                yields[row, column] = True
            add_color(image, x, y, 1 / footprint, colors[row, column])
            if error < limits[4]:
                share = error / limits[4]
                squared = seen_from[0] * seen_from[0] + seen_from[1] * seen_from[1] + seen_from[2] * seen_from[2]
                if weighted:
                    sigma = uncertainty[at]
                variance = squared * sigma * sigma
                weight, ratio = (1 - share * share) ** 2 / variance, seen / math.sqrt(squared)
                if weighted:
                    precisions[row, column] = max(precisions[row, column], 1 / variance)
                for axis in range(3):
                    sums[row, column, axis] += weight * (center[axis] + ratio * seen_from[axis])
                sums[row, column, 3] += weight
