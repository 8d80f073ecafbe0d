"""Compiled: the support of one source for the pixels of a reference view, and the merging of its points and colours."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.kernels_reprojection import (
    AGREES,
    CONTRADICTS,
    Triple,
    judge_row,
)
from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import bilinear, corners_at, pixel_at

FloatArray = NDArray[np.float64]
Reference = tuple[NDArray[np.float32], tuple[FloatArray, FloatArray], NDArray[np.float32], NDArray[np.bool_]]
Source = tuple[FloatArray, FloatArray, NDArray[np.float32], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.float32]]
Tallies = tuple[
    NDArray[np.bool_], NDArray[np.uint8], NDArray[np.uint8], NDArray[np.uint8], FloatArray, FloatArray, FloatArray
]


@kernel
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


@kernel
def pixel_footprint(view: Triple, normal: NDArray[np.float32]) -> float:
    """Return the surface area, per steradian, that a camera sees along `view` (camera to point): r² / cosine.

    The cosine is at least 0.05: normals are not accurate enough for less.
    """
    squared = view[0] * view[0] + view[1] * view[1] + view[2] * view[2]
    cosine = -(view[0] * normal[0] + view[1] * normal[1] + view[2] * normal[2]) / math.sqrt(squared)
    footprint: float = squared / max(cosine, 0.05)
    return footprint


@kernel
def confidence_at(confidence: NDArray[np.uint8], x: float, y: float) -> int:
    """Return the confidence of the pixel at a position."""
    row, column = pixel_at(x, y, confidence.shape[0], confidence.shape[1])
    value: int = confidence[row, column]
    return value


@kernel
def uncertainty_at(uncertainty: NDArray[np.float32], x: float, y: float) -> float:
    """Return the relative uncertainty of the pixel at a position."""
    row, column = pixel_at(x, y, uncertainty.shape[0], uncertainty.shape[1])
    return float(uncertainty[row, column])


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
    view = rotation, translation, center
    for row in range(rows[0], rows[1]):
        sine, cosine = elevations[0, row], elevations[1, row]
        judge_row(ranges[row], turns, (sine, cosine), view, source_ranges, limits, verdicts, found)
        for column in range(ranges.shape[1]):
            verdict, x, y = verdicts[column], found[0, column], found[1, column]
            if verdict == CONTRADICTS and confidence_at(source_confidence, x, y) >= limits[5]:
                violations[row, column] += 1
            if verdict != AGREES:
                continue
            counts[row, column] += 1
            if not written[row, column]:
                continue
            r, normal = ranges[row, column], normals[row, column]
            point = (r * (cosine * turns[0, column]), r * -sine, r * (cosine * turns[1, column]))
            distance, seen = found[2, column], found[3, column]
            error = abs(seen - distance) / distance
            confidence[row, column] = max(confidence[row, column], confidence_at(source_confidence, x, y))
            seen_from = (point[0] - center[0], point[1] - center[1], point[2] - center[2])
            footprint = pixel_footprint(seen_from, normal)
            if pixel_footprint(point, normal) > limits[3] * footprint:
                yields[row, column] = True
            add_color(image, x, y, 1 / footprint, colors[row, column])
            if error < limits[4]:
                share = error / limits[4]
                squared = seen_from[0] * seen_from[0] + seen_from[1] * seen_from[1] + seen_from[2] * seen_from[2]
                if weighted:
                    sigma = uncertainty_at(uncertainty, x, y)
                variance = squared * sigma * sigma
                weight, ratio = (1 - share * share) ** 2 / variance, seen / math.sqrt(squared)
                if weighted:
                    precisions[row, column] = max(precisions[row, column], 1 / variance)
                for axis in range(3):
                    sums[row, column, axis] += weight * (center[axis] + ratio * seen_from[axis])
                sums[row, column, 3] += weight
