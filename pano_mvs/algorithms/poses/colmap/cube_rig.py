"""A panorama as a rig of six pinhole cameras that share its centre: the faces of a cube."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.layout import CUBE_ROTATIONS

FloatArray = NDArray[np.float64]


def face_size(size_hw: tuple[int, int]) -> int:
    """Return the width in pixels of a face whose middle is as fine as the panorama's equator: w / π, rounded up."""
    return int(np.ceil(size_hw[1] / np.pi))


def face_of_bearing(bearings: FloatArray) -> NDArray[np.int32]:
    """Return the face in which each ray of the panorama, (N, 3), lies, (N,); of two at an edge the first."""
    faces: NDArray[np.int32] = (bearings @ CUBE_ROTATIONS[:, 2].T).argmax(axis=1).astype(np.int32)
    return faces


def face_pixels(bearings: FloatArray, face_idx: int, size: int) -> FloatArray:
    """Return where rays of the panorama, (N, 3), lie in a face of 90° and size × size pixels, (N, 2)."""
    in_face = bearings @ CUBE_ROTATIONS[face_idx].T
    pixels: FloatArray = (in_face[:, :2] / in_face[:, 2:] + 1) * (size / 2)
    return pixels
