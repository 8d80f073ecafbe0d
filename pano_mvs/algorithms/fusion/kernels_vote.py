"""Compiled: which pixels of a reference view become points of the cloud, and where those points lie."""

from __future__ import annotations

import math

from numba import njit, prange

from pano_mvs.algorithms.filters.kernels_reprojection import (
    AGREES,
    judge_point,
    wrapped_column,
    wrapped_row,
)


@njit(cache=True, error_model="numpy", nogil=True)
def sample_color(image, x, y, channel):  # type: ignore[no-untyped-def]
    """Return one channel of a picture between its pixels, bilinear."""
    height, width = image.shape[0], image.shape[1]
    left, top = math.floor(x - 0.5), math.floor(y - 0.5)
    weight_x, weight_y = x - 0.5 - left, y - 0.5 - top
    row_0, row_1 = wrapped_row(top, height), wrapped_row(top + 1, height)
    upper = (1 - weight_x) * image[row_0, wrapped_column(top, left, height, width), channel] + weight_x * image[
        row_0, wrapped_column(top, left + 1, height, width), channel
    ]
    lower = (1 - weight_x) * image[row_1, wrapped_column(top + 1, left, height, width), channel] + weight_x * image[
        row_1, wrapped_column(top + 1, left + 1, height, width), channel
    ]
    return (1 - weight_y) * upper + weight_y * lower


@njit(cache=True, error_model="numpy", nogil=True)
def pixel_footprint(view, normal):  # type: ignore[no-untyped-def]
    """Return the surface area, per steradian, that a camera sees along `view` (camera to point): r² / cosine.

    The cosine is held above 0.05, beyond which a normal is not known well enough.
    """
    squared = view[0] * view[0] + view[1] * view[1] + view[2] * view[2]
    cosine = -(view[0] * normal[0] + view[1] * normal[1] + view[2] * normal[2]) / math.sqrt(squared)
    return squared / max(cosine, 0.05)


@njit(cache=True, error_model="numpy", nogil=True, parallel=True)
def vote(reference, source, limits, most_worse, tallies):  # type: ignore[no-untyped-def]
    """Add one source's vote on every pixel of a reference view.

    `reference` is (ranges, rays, normals); `source` is (rotation, translation of source_from_reference, ranges,
    image); `limits` that of `judge_point`. `tallies` changes in place: kept (H, W) bool is cleared where this view's
    footprint on the surface is over `most_worse` times the source's; counts (H, W) uint8 of agreeing views; sums
    (H, W, 4) of weighted points in the reference frame and their weights; colors (H, W, 3) of weighted colours.
    """
    ranges, rays, normals = reference
    rotation, translation, source_ranges, image = source
    kept, counts, sums, colors = tallies
    height, width = ranges.shape
    center = -(rotation.T @ translation)
    for row in prange(height):
        for column in range(width):
            r = ranges[row, column]
            if not math.isfinite(r):
                continue
            ray, normal = rays[row, column], normals[row, column]
            point = (r * ray[0], r * ray[1], r * ray[2])
            verdict, _, x, y, seen = judge_point(point, rotation, translation, center, source_ranges, limits)
            if verdict != AGREES:
                continue
            view = (point[0] - center[0], point[1] - center[1], point[2] - center[2])
            if pixel_footprint(point, normal) > most_worse * pixel_footprint(view, normal):
                kept[row, column] = False
            squared = view[0] * view[0] + view[1] * view[1] + view[2] * view[2]
            weight, ratio = 1 / squared, seen / math.sqrt(squared)
            for axis in range(3):
                sums[row, column, axis] += weight * (center[axis] + ratio * view[axis])
                colors[row, column, axis] += weight * sample_color(image, x, y, axis)
            sums[row, column, 3] += weight
            counts[row, column] += 1
