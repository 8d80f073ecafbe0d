"""Compiled: the reduced camera system of bundle adjustment (Schur complement), point by point.

The residual of an observation is r = Bᵀ x / |x| with x = R (X − C) and B (3, 2) the tangent plane of the observed
ray: it is the sine of the angular error, wherever on the sphere. Triggs et al., "Bundle Adjustment — A Modern
Synthesis", 2000, section 6.1.
"""

from __future__ import annotations

import numpy as np
from numba import njit


@njit(cache=True, error_model="numpy", nogil=True)
def _observation(rotation, center, point, basis, weight, camera_rows, point_rows, residual):  # type: ignore[no-untyped-def]
    """Write √w-scaled derivatives by (ω, C), (2, 6), by X, (2, 3), and the residual, (2,)."""
    x = np.empty(3)
    for i in range(3):
        x[i] = (
            rotation[i, 0] * (point[0] - center[0])
            + rotation[i, 1] * (point[1] - center[1])
            + rotation[i, 2] * (point[2] - center[2])
        )
    inverse = 1.0 / np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
    root = np.sqrt(weight)
    for k in range(2):
        along = (basis[0, k] * x[0] + basis[1, k] * x[1] + basis[2, k] * x[2]) * inverse
        residual[k] = root * along
        # ∂r/∂x, the row that the chain rule multiplies from the left
        d0 = root * (basis[0, k] - along * x[0] * inverse) * inverse
        d1 = root * (basis[1, k] - along * x[1] * inverse) * inverse
        d2 = root * (basis[2, k] - along * x[2] * inverse) * inverse
        # R ← exp(ω) R gives ∂x/∂ω = −[x]×
        camera_rows[k, 0] = d2 * x[1] - d1 * x[2]
        camera_rows[k, 1] = d0 * x[2] - d2 * x[0]
        camera_rows[k, 2] = d1 * x[0] - d0 * x[1]
        for j in range(3):
            by_point = d0 * rotation[0, j] + d1 * rotation[1, j] + d2 * rotation[2, j]
            point_rows[k, j] = by_point
            camera_rows[k, 3 + j] = -by_point


@njit(cache=True, error_model="numpy", nogil=True)
def _invert_symmetric(matrix, inverse):  # type: ignore[no-untyped-def]
    """Write the inverse of a symmetric positive definite (3, 3) matrix."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    inverse[0, 0] = d * f - e * e
    inverse[0, 1] = c * e - b * f
    inverse[0, 2] = b * e - c * d
    inverse[1, 1] = a * f - c * c
    inverse[1, 2] = b * c - a * e
    inverse[2, 2] = a * d - b * b
    inverse[1, 0], inverse[2, 0], inverse[2, 1] = inverse[0, 1], inverse[0, 2], inverse[1, 2]
    determinant = a * inverse[0, 0] + b * inverse[0, 1] + c * inverse[0, 2]
    for i in range(3):
        for j in range(3):
            inverse[i, j] /= determinant


@njit(cache=True, error_model="numpy", nogil=True)
def _add_observation(camera_rows, point_rows, residual, row, band, gradient, diagonal, coupling, block, by_point):  # type: ignore[no-untyped-def]
    """Add one observation's products of derivatives to its camera's and its point's blocks."""
    for i in range(6):
        for j in range(i + 1):
            band[row + j, i - j] += camera_rows[0, i] * camera_rows[0, j] + camera_rows[1, i] * camera_rows[1, j]
        for j in range(3):
            coupling[i, j] = camera_rows[0, i] * point_rows[0, j] + camera_rows[1, i] * point_rows[1, j]
        gradient[row + i] += camera_rows[0, i] * residual[0] + camera_rows[1, i] * residual[1]
        diagonal[row + i] += camera_rows[0, i] ** 2 + camera_rows[1, i] ** 2
    for i in range(3):
        for j in range(3):
            block[i, j] += point_rows[0, i] * point_rows[0, j] + point_rows[1, i] * point_rows[1, j]
        by_point[i] += point_rows[0, i] * residual[0] + point_rows[1, i] * residual[1]


@njit(cache=True, error_model="numpy", nogil=True)
def _eliminate(start, stop, image_idx, couplings, inverse, by_point, product, band, gradient):  # type: ignore[no-untyped-def]
    """Take one point out of the system: S −= W V⁻¹ Wᵀ, g −= W V⁻¹ b, over all pairs of its observations."""
    for t in range(start, stop):
        row = 6 * image_idx[t]
        for i in range(6):
            for j in range(3):
                product[i, j] = (
                    couplings[t, i, 0] * inverse[0, j]
                    + couplings[t, i, 1] * inverse[1, j]
                    + couplings[t, i, 2] * inverse[2, j]
                )
            for j in range(3):
                gradient[row + i] -= product[i, j] * by_point[j]
        for s in range(start, stop):
            column = 6 * image_idx[s]
            if column > row:
                continue
            for j in range(6):
                for i in range(j if column == row else 0, 6):
                    band[column + j, row + i - column - j] -= (
                        product[i, 0] * couplings[s, j, 0]
                        + product[i, 1] * couplings[s, j, 1]
                        + product[i, 2] * couplings[s, j, 2]
                    )


@njit(cache=True, error_model="numpy", nogil=True)
def reduced_system(rotations, centers, points, starts, image_idx, bases, weights, damping, width):  # type: ignore[no-untyped-def]
    """Return the camera system after elimination of all points, and what is needed to get the points back.

    Observations are sorted by point; those of point p are starts[p] to starts[p + 1]. One thread, fixed order.

    `width` diagonals are kept: 6 (d + 1) where cameras d positions apart share a point.

    Returns:
        band (6N, width), the lower half of the symmetric system: band[j, d] is its entry in row j + d, column j;
        right-hand side (6N,), both undamped in the cameras; diagonal (6N,) of the cameras' own blocks;
        for back-substitution the couplings (T, 6, 3), inverse point blocks (P, 3, 3) and point gradients (P, 3).
    """
    cameras, count = len(centers), len(points)
    band, gradient, diagonal = np.zeros((6 * cameras, width)), np.zeros(6 * cameras), np.zeros(6 * cameras)
    couplings = np.zeros((len(image_idx), 6, 3))
    inverses, point_gradients = np.zeros((count, 3, 3)), np.zeros((count, 3))
    camera_rows, point_rows, residual = np.empty((2, 6)), np.empty((2, 3)), np.empty(2)
    block, product = np.empty((3, 3)), np.empty((6, 3))
    for p in range(count):
        block[:] = 0.0
        for t in range(starts[p], starts[p + 1]):
            k = image_idx[t]
            _observation(rotations[k], centers[k], points[p], bases[t], weights[t], camera_rows, point_rows, residual)
            _add_observation(
                camera_rows, point_rows, residual, 6 * k, band, gradient, diagonal, couplings[t], block,
                point_gradients[p],
            )  # fmt: skip
        for i in range(3):
            block[i, i] *= 1.0 + damping
        _invert_symmetric(block, inverses[p])
        _eliminate(
            starts[p], starts[p + 1], image_idx, couplings, inverses[p], point_gradients[p], product, band, gradient
        )
    return band, gradient, diagonal, couplings, inverses, point_gradients
