"""Rotations from the world of the poses to the axes that other programs expect: z up or y up.

The world of the poses has y down, as cameras do. CloudCompare, MeshLab, Blender, LAS and nerfstudio have z up; glTF and
three.js have y up. In a world with y down, both rotations only exchange axes and change signs, so coordinates keep all
their digits.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import rotation_from_two_vectors
from pano_mvs.scene.poses import Poses

WORLD_UP: Final = (0.0, -1.0, 0.0)
"""The up direction of a world that nothing has levelled: −y, that of the first camera."""


def mean_up_direction(rotations: ArrayLike) -> NDArray[np.float64] | None:
    """Return the mean of the cameras' own up directions, −y of each camera, in the world.

    Returns:
        A unit vector (3,), or None if the cameras do not agree: if the mean of the N unit vectors is not longer than
        0.5. For two cameras, that is an angle of 120° or more between their up directions.
    """
    ups = -np.asarray(rotations, np.float64).reshape(-1, 3, 3)[:, 1]
    mean = ups.mean(axis=0) if len(ups) else np.zeros(3)
    length = float(np.linalg.norm(mean))
    return mean / length if length > 0.5 else None


_QUARTER_TURN: Final = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))


def world_up(poses: Poses) -> FloatArray:
    """Return the up direction in the world of poses of one group, (3,), for display.

    It is −y if the world is level, as `poses.level` makes it. Otherwise it is the axis of the world,
    with its sign, that is nearest to the mean up direction of the cameras, or that mean itself if it is more than 20°
    from every axis. If the cameras do not agree, it is −y.
    """
    mean = None if poses.axes.is_level else mean_up_direction(poses.rotations)
    if mean is None:
        return np.array(WORLD_UP)
    largest = int(np.argmax(np.abs(mean)))
    axis = np.zeros(3)
    axis[largest] = np.sign(mean[largest])
    return axis if float(axis @ mean) >= np.cos(np.deg2rad(20.0)) else mean


def z_up_from_world(up: ArrayLike = WORLD_UP) -> FloatArray:
    """Return the rotation (3, 3) from the world to axes with z up.

    For `up` = −y, it maps (x, y, z) to (x, z, −y): what lay ahead of the first camera lies along y.

    Args:
        up: (3,) unit vector, the up direction in the world; see `world_up`.
    """
    rotation = np.array(_QUARTER_TURN) @ rotation_from_two_vectors(up, WORLD_UP)
    # An exchange of axes is exact; adding 0 turns −0 into 0.
    exact = np.round(rotation)
    return (exact if np.allclose(rotation, exact, rtol=0, atol=1e-12) else rotation) + 0.0


def y_up_from_world(up: ArrayLike = WORLD_UP) -> FloatArray:
    """Return the rotation (3, 3) from the world to axes with y up, as glTF has them.

    For `up` = −y, it maps (x, y, z) to (x, −y, −z). It agrees with `z_up_from_world` in the way in which programs with
    z up import glTF: (x, y, z) of a file with y up is (x, −z, y) with z up.
    """
    return np.array(_QUARTER_TURN) @ z_up_from_world(up) + 0.0
