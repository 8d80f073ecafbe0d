"""Compiled: which points a view sees, by its range map."""

from __future__ import annotations

import math

from numba import njit

from pano_mvs.algorithms.filters.kernels_reprojection import AGREES, judge_point, reprojection_angle


@njit(cache=True, error_model="numpy", nogil=True)
def see_points(points, homes, max_angle, view, ranges, confidence, limits, seen, errors, bearings):  # type: ignore[no-untyped-def]
    """Write which points one view sees where they are.

    Args:
        points: (N, 3) in the world.
        homes: (N, 3) centres of the cameras that the points were taken from.
        max_angle: the largest angle, at the home, between a point and where the view puts it.
        view: (rotation (3, 3), translation (3,)) cam_from_world.
        ranges: (H, W) float32 of the view.
        confidence: (H, W) uint8 of the view.
        limits: largest relative error of the range, largest relative step on a surface, least confidence.
        seen: (N,) bool, written.
        errors: (N,) float64, written where seen: that angle.
        bearings: (N, 3) float64, written where seen: unit rays in the view's camera frame.
    """
    rotation, translation = view
    height, width = ranges.shape
    for idx in range(len(points)):
        point = points[idx] - homes[idx]
        moved = rotation @ homes[idx] + translation
        baseline = -(rotation.T @ moved)
        bounds = (limits[0], max_angle, limits[1])
        verdict, _, x, y, found = judge_point(point, rotation, moved, baseline, ranges, bounds)
        row, column = min(max(math.floor(y), 0), height - 1), math.floor(x) % width
        seen[idx] = verdict == AGREES and confidence[row, column] >= limits[2]
        if not seen[idx]:
            continue
        in_view = rotation @ point + moved
        distance = math.sqrt(in_view[0] ** 2 + in_view[1] ** 2 + in_view[2] ** 2)
        errors[idx] = reprojection_angle(point, baseline, found / distance)
        for axis in range(3):
            bearings[idx, axis] = in_view[axis] / distance
