"""Rotations: exponential map, quaternions, distances."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from pano_mvs.core.arrays import FloatArray


def skew(vectors: ArrayLike) -> FloatArray:
    """Return the matrices [v]× with [v]× u = v × u; (..., 3) to (..., 3, 3)."""
    v = np.asarray(vectors, dtype=np.float64)
    matrix = np.zeros((*v.shape[:-1], 3, 3))
    matrix[..., 0, 1], matrix[..., 0, 2] = -v[..., 2], v[..., 1]
    matrix[..., 1, 0], matrix[..., 1, 2] = v[..., 2], -v[..., 0]
    matrix[..., 2, 0], matrix[..., 2, 1] = -v[..., 1], v[..., 0]
    return matrix


def rotation_from_rotvec(rotvec: ArrayLike) -> FloatArray:
    """Return the rotation matrix of a rotation vector (axis times angle in radians); (3,) to (3, 3), or batched."""
    from scipy.spatial.transform import Rotation  # slow to import

    return np.asarray(Rotation.from_rotvec(np.asarray(rotvec, dtype=np.float64)).as_matrix())


def rotvec_from_rotation(rotation: ArrayLike) -> FloatArray:
    """Return the rotation vector (axis times angle in [0, π]) of a rotation matrix; (3, 3) to (3,), or batched."""
    from scipy.spatial.transform import Rotation  # slow to import

    return np.asarray(Rotation.from_matrix(np.asarray(rotation, dtype=np.float64)).as_rotvec())


def rotation_from_quat_wxyz(quat_wxyz: ArrayLike) -> FloatArray:
    """Return the rotation matrix of a quaternion (w, x, y, z) of any length but zero; (..., 4) to (..., 3, 3)."""
    from scipy.spatial.transform import Rotation  # slow to import

    quat = np.asarray(quat_wxyz, dtype=np.float64)
    return np.asarray(Rotation.from_quat(np.roll(quat, -1, axis=-1)).as_matrix())


def quat_wxyz_from_rotation(rotation: ArrayLike) -> FloatArray:
    """Return the unit quaternion (w, x, y, z) with w ≥ 0 of a rotation matrix; (..., 3, 3) to (..., 4)."""
    from scipy.spatial.transform import Rotation  # slow to import

    quat_xyzw = Rotation.from_matrix(np.asarray(rotation, dtype=np.float64)).as_quat(canonical=True)
    return np.roll(np.asarray(quat_xyzw), 1, axis=-1)


def geodesic_angle(first: ArrayLike, second: ArrayLike) -> FloatArray:
    """Return the angle in radians of the rotation that leads from one rotation to another; (..., 3, 3) to (...,).

    2 asin(‖A − B‖_F / √8), exact for small angles.
    """
    difference = np.asarray(first, dtype=np.float64) - np.asarray(second, dtype=np.float64)
    chord = np.sqrt(np.sum(difference**2, axis=(-2, -1)) / 8)
    angle: FloatArray = 2 * np.arcsin(np.clip(chord, 0.0, 1.0))
    return angle


def nearest_rotation(matrix: ArrayLike) -> FloatArray:
    """Return the rotation nearest to a matrix in the Frobenius norm; (..., 3, 3)."""
    u, _, vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    u[..., :, 2] *= np.linalg.det(u @ vt)[..., None]
    rotation: FloatArray = u @ vt
    return rotation


def rotation_from_two_vectors(source: ArrayLike, target: ArrayLike) -> FloatArray:
    """Return the smallest rotation, (3, 3), that turns direction `source` (3,) into direction `target` (3,)."""
    a = np.asarray(source, dtype=np.float64)
    b = np.asarray(target, dtype=np.float64)
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        axis, sine = np.cross(a, np.eye(3)[np.argmin(np.abs(a))]), 0.0
    # Near opposite directions the cross product is mostly rounding: only its part across `a` may turn `a`.
    axis = axis / np.linalg.norm(axis)
    axis = axis - (axis @ a) * a
    return rotation_from_rotvec(axis / np.linalg.norm(axis) * np.arctan2(sine, cosine))
