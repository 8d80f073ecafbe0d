"""Compiled: triangulation of tracks, one after the other; see `points`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import kernel
from pano_mvs.geometry.kernels_sphere import angle_between


@kernel
def _solved(matrix: FloatArray, vector: FloatArray, least: float, point: FloatArray) -> bool:
    """Write the solution of a symmetric (3, 3) system; return whether its smallest eigenvalue exceeds `least`.

    All eigenvalues of A exceed λ if and only if A − λ I is positive definite, which its LDLᵀ decomposition shows.
    """
    for shift in (least, 0.0):
        a, b, c = matrix[0, 0] - shift, matrix[0, 1], matrix[0, 2]
        if not a > 0:
            return False
        l10, l20 = b / a, c / a
        d = matrix[1, 1] - shift - l10 * b
        if not d > 0:
            return False
        e = matrix[1, 2] - l10 * c
        l21 = e / d
        f = matrix[2, 2] - shift - l20 * c - l21 * e
        if not f > 0:
            return False
    y1 = vector[1] - l10 * vector[0]
    y2 = vector[2] - l20 * vector[0] - l21 * y1
    point[2] = y2 / f
    point[1] = y1 / d - l21 * point[2]
    point[0] = vector[0] / a - l10 * point[1] - l20 * point[2]
    return True


@kernel
def _nearest_point(
    centers: FloatArray,
    rays: FloatArray,
    used: NDArray[np.bool_],
    start: int,
    stop: int,
    least: float,
    weights: FloatArray,
    matrix: FloatArray,
    vector: FloatArray,
    point: FloatArray,
) -> bool:
    """Write the point nearest to the rays in use, reweighted twice by range; return whether it is well defined."""
    count = 0
    for t in range(start, stop):
        count += used[t]
        weights[t] = 1.0
    if count < 2:
        return False
    for step in range(3):
        matrix[:], vector[:] = 0.0, 0.0
        for t in range(start, stop):
            if used[t]:
                w, x, y, z = weights[t], rays[t, 0], rays[t, 1], rays[t, 2]
                along = x * centers[t, 0] + y * centers[t, 1] + z * centers[t, 2]
                matrix[0, 0] += w * (1.0 - x * x)
                matrix[1, 1] += w * (1.0 - y * y)
                matrix[2, 2] += w * (1.0 - z * z)
                matrix[0, 1] -= w * x * y
                matrix[0, 2] -= w * x * z
                matrix[1, 2] -= w * y * z
                vector[0] += w * (centers[t, 0] - along * x)
                vector[1] += w * (centers[t, 1] - along * y)
                vector[2] += w * (centers[t, 2] - along * z)
        if not _solved(matrix, vector, least if step == 0 else 0.0, point):
            return False
        mean = 0.0
        for t in range(start, stop):
            if used[t]:
                weights[t] = (
                    (point[0] - centers[t, 0]) ** 2 + (point[1] - centers[t, 1]) ** 2 + (point[2] - centers[t, 2]) ** 2
                )
                mean += weights[t] / count
        # Rays from a single camera position meet in that position, not in a point of the scene.
        if not mean > 0:
            return False
        for t in range(start, stop):
            weights[t] = mean / max(weights[t], 1e-6 * mean + 1e-300)
    return True


@kernel
def triangulate(
    centers: FloatArray, rays: FloatArray, starts: NDArray[np.intp], least: float, max_error: float, rounds: int
) -> tuple[FloatArray, NDArray[np.bool_], NDArray[np.bool_], FloatArray]:
    """Return points (P, 3), whether they are valid (P,), which observations fit (T,), and their errors (T,).

    Observations are sorted by track; those of track p are starts[p] to starts[p + 1].
    """
    count = len(starts) - 1
    points, valid = np.full((count, 3), np.nan), np.zeros(count, np.bool_)
    used, errors, weights = np.ones(len(rays), np.bool_), np.full(len(rays), np.pi), np.empty(len(rays))
    matrix, vector, point = np.empty((3, 3)), np.empty(3), np.empty(3)
    for p in range(count):
        start, stop = starts[p], starts[p + 1]
        fits = False
        for _ in range(rounds):
            fits = _nearest_point(centers, rays, used, start, stop, least, weights, matrix, vector, point)
            worst = 0.0
            for t in range(start, stop):
                errors[t] = np.pi
                if fits:
                    x, y, z = point[0] - centers[t, 0], point[1] - centers[t, 1], point[2] - centers[t, 2]
                    errors[t] = angle_between(rays[t, 0], rays[t, 1], rays[t, 2], x, y, z)
                    if used[t] and errors[t] > worst:
                        worst = errors[t]
            if not fits or worst <= max_error:
                break
            for t in range(start, stop):
                if errors[t] >= worst:
                    used[t] = False
        for t in range(start, stop):
            fits = fits and not (used[t] and errors[t] > max_error)
        valid[p] = fits
        if fits:
            points[p] = point
        for t in range(start, stop):
            used[t] = used[t] and fits
    return points, valid, used, errors
