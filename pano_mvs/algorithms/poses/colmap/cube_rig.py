"""A panorama as a rig of six pinhole cameras with a common centre: the faces of a cube."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import CUBE_ROTATIONS
from pano_mvs.core.arrays import FloatArray


def face_size(size_hw: tuple[int, int]) -> int:
    """Return the face width in pixels with the resolution of the equator at the face's centre: w / π, rounded up."""
    return int(np.ceil(size_hw[1] / np.pi))


def face_of_bearing(bearings: FloatArray) -> NDArray[np.int32]:
    """Return the face of each ray of the panorama, (N, 3) to (N,); on an edge, the first of the two faces."""
    faces: NDArray[np.int32] = (bearings @ CUBE_ROTATIONS[:, 2].T).argmax(axis=1).astype(np.int32)
    return faces


def face_pixels(bearings: FloatArray, face_idx: int, size: int) -> FloatArray:
    """Return the pixels, (N, 2), of rays of the panorama, (N, 3), in a face of 90° and size × size pixels."""
    in_face = bearings @ CUBE_ROTATIONS[face_idx].T
    pixels: FloatArray = (in_face[:, :2] / in_face[:, 2:] + 1) * (size / 2)
    return pixels
