"""The rotation that was applied to the coordinates of a PLY file, as a comment in its header."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import InputError

_KEY = b"comment file_from_world "
_MEANING = "comment x_in_file = file_from_world x_in_world; poses and COLMAP models are in the world\n"
_ROTATION_TOLERANCE = 1e-6


def frame_comments(file_from_world: FloatArray | None) -> str:
    """Return the lines of the header that state a rotation (3, 3), row by row; none for a file in the world frame."""
    if file_from_world is None:
        return ""
    numbers = " ".join(f"{value:.17g}" for value in np.asarray(file_from_world, np.float64).ravel())
    return f"{_MEANING}{_KEY.decode()}{numbers}\n"


def without_comments(head: bytes) -> bytes:
    """Return a header without its comments."""
    return b"".join(line for line in head.splitlines(keepends=True) if not line.startswith(b"comment"))


def stated_rotation(head: bytes, path: Path) -> FloatArray | None:
    """Return the rotation file_from_world (3, 3) in a header; None if it states none: the file is in the world frame.

    Raises:
        InputError: if the header states something that is not a rotation.
    """
    line = next((line for line in head.splitlines() if line.startswith(_KEY)), None)
    if line is None:
        return None
    try:
        rotation = np.array([float(word) for word in line[len(_KEY) :].split()]).reshape(3, 3)
    except ValueError:
        rotation = np.zeros((3, 3))
    orthonormal = np.allclose(rotation @ rotation.T, np.eye(3), rtol=0, atol=_ROTATION_TOLERANCE)
    if not (orthonormal and np.linalg.det(rotation) > 0):
        raise InputError(f"{path}: file_from_world in its header is not a rotation. Write the file again")
    return rotation


def turned(vectors: NDArray[np.float32], target_from_source: FloatArray | None) -> NDArray[np.float32]:
    """Return vectors (N, 3) in other axes; None leaves them as they are."""
    if target_from_source is None:
        return vectors
    # In float64, so that the result does not depend on the library; adding 0 turns −0 into 0.
    return (vectors.astype(np.float64) @ target_from_source.T + 0.0).astype(np.float32)
