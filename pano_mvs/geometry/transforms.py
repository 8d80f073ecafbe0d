"""Rigid and similarity transforms of 3D points, named target_from_source."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError


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


@dataclass(frozen=True, slots=True, eq=False)
class Rigid3:
    """A rigid transform target_from_source: x_in_target = rotation @ x_in_source + translation.

    Attributes:
        rotation: (3, 3) rotation matrix.
        translation: (3,) in scene units.

    >>> cam_from_world = Rigid3.from_center(np.eye(3), [1.0, 0.0, 0.0])
    >>> cam_from_world.apply([1.0, 0.0, 2.0]).tolist(), cam_from_world.center.tolist()
    ([0.0, 0.0, 2.0], [1.0, 0.0, 0.0])
    """

    rotation: FloatArray
    translation: FloatArray

    @staticmethod
    def identity() -> Rigid3:
        """Return the transform that changes nothing."""
        return Rigid3(np.eye(3), np.zeros(3))

    @staticmethod
    def from_center(rotation: FloatArray, center: ArrayLike) -> Rigid3:
        """Return the cam_from_world whose camera centre lies at `center` (3,) in the world."""
        return Rigid3(rotation, -rotation @ np.asarray(center, dtype=np.float64))

    def apply(self, points_in_source: ArrayLike) -> FloatArray:
        """Return points (..., 3) of the source frame in the target frame."""
        return np.asarray(points_in_source, dtype=np.float64) @ self.rotation.T + self.translation

    def inverse(self) -> Rigid3:
        """Return source_from_target."""
        return Rigid3(self.rotation.T, -self.rotation.T @ self.translation)

    def __matmul__(self, other: Rigid3) -> Rigid3:
        """Return the composition: a_from_b @ b_from_c is a_from_c."""
        return Rigid3(self.rotation @ other.rotation, self.rotation @ other.translation + self.translation)

    @property
    def center(self) -> FloatArray:
        """The origin of the target frame in source coordinates: for cam_from_world, the camera's centre (3,)."""
        return np.asarray(0.0 - self.rotation.T @ self.translation)  # not -0.0


@dataclass(frozen=True, slots=True, eq=False)
class Similarity3:
    """A similarity target_from_source: x_in_target = scale * rotation @ x_in_source + translation.

    Attributes:
        scale: positive factor from source lengths to target lengths.
        rotation: (3, 3) rotation matrix.
        translation: (3,) in target units.

    >>> metres_from_scene = Similarity3(2.0, np.eye(3), np.zeros(3))
    >>> metres_from_scene.apply([1.0, 0.0, 0.5]).tolist()
    [2.0, 0.0, 1.0]
    """

    scale: float
    rotation: FloatArray
    translation: FloatArray

    def apply(self, points_in_source: ArrayLike) -> FloatArray:
        """Return points (..., 3) of the source frame in the target frame."""
        return self.scale * np.asarray(points_in_source, dtype=np.float64) @ self.rotation.T + self.translation

    def inverse(self) -> Similarity3:
        """Return source_from_target."""
        rotation = self.rotation.T
        return Similarity3(1 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def __matmul__(self, other: Similarity3) -> Similarity3:
        """Return the composition: a_from_b @ b_from_c is a_from_c."""
        return Similarity3(self.scale * other.scale, self.rotation @ other.rotation, self.apply(other.translation))

    def move_camera(self, cam_from_source: Rigid3) -> Rigid3:
        """Return cam_from_target of a camera known as cam_from_source, in the target's unit of length."""
        rotation = cam_from_source.rotation @ self.rotation.T
        return Rigid3(rotation, self.scale * cam_from_source.translation - rotation @ self.translation)


def similarity_from_points(source: ArrayLike, target: ArrayLike, *, with_scale: bool = True) -> Similarity3:
    """Return the similarity target_from_source with the least squared distance between paired points.

    Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991.

    Args:
        source: (N, 3) points, N ≥ 1. Points on one line leave the turn about it undetermined.
        target: (N, 3) the same points in the target frame.
        with_scale: whether to estimate the scale; else it is 1.

    Raises:
        UsageError: if the shapes differ, or the source points coincide although a scale is wanted.
    """
    a, b = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 3 or len(a) < 1:
        raise UsageError(f"similarity_from_points needs two (N, 3) arrays of paired points, got {a.shape}, {b.shape}")
    mean_a, mean_b = a.mean(axis=0), b.mean(axis=0)
    covariance = (b - mean_b).T @ (a - mean_a) / len(a)
    rotation = nearest_rotation(covariance)
    scale = 1.0
    if with_scale:
        variance = float(np.sum((a - mean_a) ** 2)) / len(a)
        if variance < 1e-24:
            raise UsageError("the source points coincide, so no scale can be estimated")
        scale = float(np.trace(rotation.T @ covariance)) / variance
    return Similarity3(scale, rotation, mean_b - scale * rotation @ mean_a)
