"""The frame of walls around a single panorama: the vertical and two directions at right angles, by its lines."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import reduced_mask, reduced_panorama
from pano_mvs.algorithms.poses.frame.vertical_lines import (
    Segments,
    directions_around,
    find_segments,
    turn_into_walls,
    wall_azimuth,
)
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import UP, rotation_from_rotvec, rotation_from_two_vectors

_WIDTH_PX = 1024  # of the pictures in which lines are found

# The vertical is searched within this tilt from several starts, each of which finds it within 3°. One that is farther
# away must have more lines on the vertical and the walls by this factor. At least this length of lines and this share
# of all must be on them: .27 to .67 in rendered and real rooms, .04 of many lines and .2 of 3 rad in noise.
_TILT_DEG, _TILT_STEP_DEG, _BETTER = 15.0, 5.0, 1.1
_LEAST_RAD, _LEAST_SHARE = 3.0, 0.15


def level_and_walls(segments: Segments, up: FloatArray) -> tuple[FloatArray, float | None]:
    """Return the rotation into a level frame near `up` (3,) in which lines are upright or along walls, and a wall.

    The frame is turned as little as possible against the camera. The azimuth of the wall there, in radians from 0 to
    π/2, is None if no walls at right angles are clear.
    """
    upright, wall, most = up, None, max(_LEAST_RAD, _LEAST_SHARE * float(segments.weights.sum())) / _BETTER
    starts = directions_around(up, _TILT_DEG, _TILT_STEP_DEG)
    # Rounded, so that equal angles keep their order on all processors.
    nearest_first = np.argsort(-(starts @ up).round(6), kind="stable")
    for start in starts[nearest_first]:
        near = rotation_from_two_vectors(start, UP)
        turned = segments.turned(near)
        azimuth = wall_azimuth(turned)
        if not np.isfinite(azimuth):
            continue
        turn, weight = turn_into_walls(turned, azimuth)
        if weight > _BETTER * most:
            most, upright = weight, near.T @ turn @ UP
            wall = near.T @ turn @ [np.sin(azimuth), 0.0, np.cos(azimuth)]
    level_from_cam = rotation_from_two_vectors(upright, UP)
    if wall is None:
        return level_from_cam, None
    across = level_from_cam @ wall
    return level_from_cam, float(np.arctan2(across[0], across[2]) % (np.pi / 2))


def walls_of_picture(image: NDArray[np.uint8], valid: NDArray[np.bool_], up: FloatArray) -> FloatArray | None:
    """Return the rotation (3, 3) from a camera into a frame whose y points down and whose x and z are along walls.

    Args:
        image: (H, W, 3) uint8 RGB, the full sphere.
        valid: (H, W) pixels that count.
        up: (3,) direction away from gravity in the camera frame, to some 15°.

    Returns:
        None if the picture shows no walls at right angles.
    """
    small = reduced_panorama(image, _WIDTH_PX)
    mask = reduced_mask(valid, small.shape[1])
    level_from_cam, wall = level_and_walls(find_segments({"": lambda: (small, mask)}, {"": np.eye(3)}), up)
    return None if wall is None else rotation_from_rotvec((0.0, -wall, 0.0)) @ level_from_cam
