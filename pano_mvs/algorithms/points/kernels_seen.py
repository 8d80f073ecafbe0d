"""Compiled: visibility of points in a view, by its range map."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.kernels_reprojection import AGREES, judge_point, reprojection_angle
from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import pixel_at

FloatArray = NDArray[np.float64]


@kernel
def see_points(
    points: FloatArray,
    homes: FloatArray,
    max_angle: float,
    view: tuple[FloatArray, FloatArray],
    ranges: NDArray[np.float32],
    confidence: NDArray[np.uint8],
    limits: tuple[float, float, int],
    seen: NDArray[np.bool_],
    errors: FloatArray,
    bearings: FloatArray,
) -> None:
    """Write which points one view sees, with the angular error and the bearing of each.

    Args:
        points: (N, 3) in the world.
        homes: (N, 3) centres of the cameras whose range maps the points come from.
        max_angle: maximum angle, at the home, between a point and the view's point on its own ray.
        view: (rotation (3, 3), translation (3,)) cam_from_world.
        ranges: (H, W) float32 of the view.
        confidence: (H, W) uint8 of the view.
        limits: maximum relative error of the range, maximum relative step on a surface, minimum confidence.
        seen: (N,) bool, written.
        errors: (N,) float64, written where seen: the angle limited by `max_angle`.
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
        row, column = pixel_at(x, y, height, width)
        seen[idx] = verdict == AGREES and confidence[row, column] >= limits[2]
        if not seen[idx]:
            continue
        in_view = rotation @ point + moved
        distance = math.sqrt(in_view[0] ** 2 + in_view[1] ** 2 + in_view[2] ** 2)
        errors[idx] = reprojection_angle(point, baseline, found / distance)
        for axis in range(3):
            bearings[idx, axis] = in_view[axis] / distance
