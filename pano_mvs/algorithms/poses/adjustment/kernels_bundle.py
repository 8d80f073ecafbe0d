"""Compiled: the reduced camera system of bundle adjustment (Schur complement), point by point.

The residual of an observation is r = Bᵀ x / |x| with x = R (X − C) − o, where o is the origin of the observed ray in
the camera frame (zero for a central camera) and B (3, 2) the tangent plane of the ray: it is the sine of the angular
error anywhere on the sphere. Triggs et al., "Bundle Adjustment — A Modern Synthesis", 2000, section 6.1.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import inlined, kernel
from pano_mvs.geometry.kernels_sphere import angle_between


@inlined
def _derivatives(
    rotations: FloatArray,
    centers: FloatArray,
    points: FloatArray,
    bases: FloatArray,
    origins: FloatArray,
    weights: FloatArray,
    t: int,
    k: int,
    p: int,
    rows: FloatArray,
) -> None:
    """Write √w-scaled rows of derivatives by (ω, C) and X, and the residual, (2, 10), of observation t."""
    dx, dy, dz = points[p, 0] - centers[k, 0], points[p, 1] - centers[k, 1], points[p, 2] - centers[k, 2]
    r00, r01, r02 = rotations[k, 0, 0], rotations[k, 0, 1], rotations[k, 0, 2]
    r10, r11, r12 = rotations[k, 1, 0], rotations[k, 1, 1], rotations[k, 1, 2]
    r20, r21, r22 = rotations[k, 2, 0], rotations[k, 2, 1], rotations[k, 2, 2]
    y0, y1, y2 = r00 * dx + r01 * dy + r02 * dz, r10 * dx + r11 * dy + r12 * dz, r20 * dx + r21 * dy + r22 * dz
    x0, x1, x2 = y0 - origins[t, 0], y1 - origins[t, 1], y2 - origins[t, 2]
    inverse = 1.0 / np.sqrt(x0 * x0 + x1 * x1 + x2 * x2)
    root = np.sqrt(weights[t])
    for k2 in range(2):
        b0, b1, b2 = bases[t, 0, k2], bases[t, 1, k2], bases[t, 2, k2]
        along = (b0 * x0 + b1 * x1 + b2 * x2) * inverse
        # ∂r/∂x, which the chain rule multiplies from the left
        d0 = root * (b0 - along * x0 * inverse) * inverse
        d1 = root * (b1 - along * x1 * inverse) * inverse
        d2 = root * (b2 - along * x2 * inverse) * inverse
        # R ← exp(ω) R gives ∂x/∂ω = −[y]× with y = R (X − C)
        rows[k2, 0] = d2 * y1 - d1 * y2
        rows[k2, 1] = d0 * y2 - d2 * y0
        rows[k2, 2] = d1 * y0 - d0 * y1
        by_x = d0 * r00 + d1 * r10 + d2 * r20
        by_y = d0 * r01 + d1 * r11 + d2 * r21
        by_z = d0 * r02 + d1 * r12 + d2 * r22
        rows[k2, 3], rows[k2, 4], rows[k2, 5] = -by_x, -by_y, -by_z
        rows[k2, 6], rows[k2, 7], rows[k2, 8] = by_x, by_y, by_z
        rows[k2, 9] = root * along


@kernel
def _invert_symmetric(matrix: FloatArray, inverses: FloatArray, p: int) -> None:
    """Write the inverse of a symmetric positive definite (3, 3) matrix to inverses[p]."""
    a, b, c = matrix[0, 0], matrix[0, 1], matrix[0, 2]
    d, e, f = matrix[1, 1], matrix[1, 2], matrix[2, 2]
    i00, i01, i02 = d * f - e * e, c * e - b * f, b * e - c * d
    i11, i12, i22 = a * f - c * c, b * c - a * e, a * d - b * b
    scale = 1.0 / (a * i00 + b * i01 + c * i02)
    inverses[p, 0, 0], inverses[p, 1, 1], inverses[p, 2, 2] = i00 * scale, i11 * scale, i22 * scale
    inverses[p, 0, 1], inverses[p, 0, 2], inverses[p, 1, 2] = i01 * scale, i02 * scale, i12 * scale
    inverses[p, 1, 0], inverses[p, 2, 0], inverses[p, 2, 1] = i01 * scale, i02 * scale, i12 * scale


@inlined
def _add_observation(
    rows: FloatArray,
    t: int,
    row: int,
    p: int,
    band: FloatArray,
    gradient: FloatArray,
    diagonal: FloatArray,
    couplings: FloatArray,
    block: FloatArray,
    point_gradients: FloatArray,
) -> None:
    """Add one observation's products of derivatives to its camera's and its point's blocks."""
    p0, p1, p2, residual_0 = rows[0, 6], rows[0, 7], rows[0, 8], rows[0, 9]
    q0, q1, q2, residual_1 = rows[1, 6], rows[1, 7], rows[1, 8], rows[1, 9]
    for j in range(6):
        first, second = rows[0, j], rows[1, j]
        for i in range(j, 6):
            band[row + j, i - j] += rows[0, i] * first + rows[1, i] * second
        couplings[t, j, 0] = first * p0 + second * q0
        couplings[t, j, 1] = first * p1 + second * q1
        couplings[t, j, 2] = first * p2 + second * q2
        gradient[row + j] += first * residual_0 + second * residual_1
        diagonal[row + j] += first * first + second * second
    block[0, 0] += p0 * p0 + q0 * q0
    block[0, 1] += p0 * p1 + q0 * q1
    block[0, 2] += p0 * p2 + q0 * q2
    block[1, 1] += p1 * p1 + q1 * q1
    block[1, 2] += p1 * p2 + q1 * q2
    block[2, 2] += p2 * p2 + q2 * q2
    point_gradients[p, 0] += p0 * residual_0 + q0 * residual_1
    point_gradients[p, 1] += p1 * residual_0 + q1 * residual_1
    point_gradients[p, 2] += p2 * residual_0 + q2 * residual_1


@kernel
def _eliminate(
    start: int,
    stop: int,
    p: int,
    image_idx: NDArray[np.int32],
    couplings: FloatArray,
    inverses: FloatArray,
    point_gradients: FloatArray,
    product: FloatArray,
    band: FloatArray,
    gradient: FloatArray,
) -> None:
    """Eliminate one point from the system: S −= W V⁻¹ Wᵀ, g −= W V⁻¹ b, over all pairs of its observations.

    Rows are written out: the compiler cannot know that the arrays do not overlap, and would reload W V⁻¹ every time.
    """
    for t in range(start, stop):
        row = 6 * image_idx[t]
        for i in range(6):
            for j in range(3):
                product[i, j] = (
                    couplings[t, i, 0] * inverses[p, 0, j]
                    + couplings[t, i, 1] * inverses[p, 1, j]
                    + couplings[t, i, 2] * inverses[p, 2, j]
                )
            gradient[row + i] -= (
                product[i, 0] * point_gradients[p, 0]
                + product[i, 1] * point_gradients[p, 1]
                + product[i, 2] * point_gradients[p, 2]
            )
        a0, b0, c0 = product[0, 0], product[0, 1], product[0, 2]
        a1, b1, c1 = product[1, 0], product[1, 1], product[1, 2]
        a2, b2, c2 = product[2, 0], product[2, 1], product[2, 2]
        a3, b3, c3 = product[3, 0], product[3, 1], product[3, 2]
        a4, b4, c4 = product[4, 0], product[4, 1], product[4, 2]
        a5, b5, c5 = product[5, 0], product[5, 1], product[5, 2]
        for s in range(start, stop):
            column = 6 * image_idx[s]
            if column > row:
                continue
            for j in range(6):
                u, v, w = couplings[s, j, 0], couplings[s, j, 1], couplings[s, j, 2]
                at = row - column - j
                if column == row:
                    for i in range(j, 6):
                        band[column + j, i - j] -= product[i, 0] * u + product[i, 1] * v + product[i, 2] * w
                else:
                    band[column + j, at] -= a0 * u + b0 * v + c0 * w
                    band[column + j, at + 1] -= a1 * u + b1 * v + c1 * w
                    band[column + j, at + 2] -= a2 * u + b2 * v + c2 * w
                    band[column + j, at + 3] -= a3 * u + b3 * v + c3 * w
                    band[column + j, at + 4] -= a4 * u + b4 * v + c4 * w
                    band[column + j, at + 5] -= a5 * u + b5 * v + c5 * w


@kernel
def reduced_system(
    rotations: FloatArray,
    centers: FloatArray,
    points: FloatArray,
    starts: NDArray[np.intp],
    image_idx: NDArray[np.int32],
    bases: FloatArray,
    origins: FloatArray,
    weights: FloatArray,
    damping: float,
    width: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Return the camera system after elimination of all points, and the blocks for back-substitution.

    Observations are sorted by point; those of point p are starts[p] to starts[p + 1]. One thread, fixed order.

    The band has `width` diagonals: 6 (d + 1) if cameras up to d positions apart share a point.

    Returns:
        band (6N, width), the lower half of the symmetric system: band[j, d] is its entry in row j + d, column j;
        right-hand side (6N,), both undamped in the cameras; diagonal (6N,) of the cameras' own blocks;
        for back-substitution the couplings (T, 6, 3), inverse point blocks (P, 3, 3) and point gradients (P, 3).
    """
    cameras, count = len(centers), len(points)
    band, gradient, diagonal = np.zeros((6 * cameras, width)), np.zeros(6 * cameras), np.zeros(6 * cameras)
    couplings = np.empty((len(image_idx), 6, 3))
    inverses, point_gradients = np.empty((count, 3, 3)), np.zeros((count, 3))
    rows, block, product = np.empty((2, 10)), np.empty((3, 3)), np.empty((6, 3))
    for p in range(count):
        block[:] = 0.0
        for t in range(starts[p], starts[p + 1]):
            k = image_idx[t]
            _derivatives(rotations, centers, points, bases, origins, weights, t, k, p, rows)
            _add_observation(rows, t, 6 * k, p, band, gradient, diagonal, couplings, block, point_gradients)
        for i in range(3):
            block[i, i] *= 1.0 + damping
        _invert_symmetric(block, inverses, p)
        _eliminate(
            starts[p], starts[p + 1], p, image_idx, couplings, inverses, point_gradients, product, band, gradient
        )
    return band, gradient, diagonal, couplings, inverses, point_gradients


@kernel
def moved_points(
    points: FloatArray,
    starts: NDArray[np.intp],
    image_idx: NDArray[np.int32],
    couplings: FloatArray,
    inverses: FloatArray,
    point_gradients: FloatArray,
    steps: FloatArray,
) -> FloatArray:
    """Return the points, (P, 3), after the cameras' steps s (N, 6): X − V⁻¹ (b + Wᵀ s)."""
    moved = np.empty_like(points)
    for p in range(len(points)):
        x, y, z = point_gradients[p, 0], point_gradients[p, 1], point_gradients[p, 2]
        for t in range(starts[p], starts[p + 1]):
            k = image_idx[t]
            for i in range(6):
                x += couplings[t, i, 0] * steps[k, i]
                y += couplings[t, i, 1] * steps[k, i]
                z += couplings[t, i, 2] * steps[k, i]
        for i in range(3):
            moved[p, i] = points[p, i] - (inverses[p, i, 0] * x + inverses[p, i, 1] * y + inverses[p, i, 2] * z)
    return moved


@kernel
def ray_errors(
    rotations: FloatArray,
    centers: FloatArray,
    points: FloatArray,
    point_idx: NDArray[np.int32],
    image_idx: NDArray[np.int32],
    bearings: FloatArray,
    origins: FloatArray,
) -> FloatArray:
    """Return the angle between every observed ray and the one from its origin to its point, (T,)."""
    errors = np.empty(len(point_idx))
    for t in range(len(point_idx)):
        k, p = image_idx[t], point_idx[t]
        dx, dy, dz = points[p, 0] - centers[k, 0], points[p, 1] - centers[k, 1], points[p, 2] - centers[k, 2]
        x = rotations[k, 0, 0] * dx + rotations[k, 0, 1] * dy + rotations[k, 0, 2] * dz - origins[t, 0]
        y = rotations[k, 1, 0] * dx + rotations[k, 1, 1] * dy + rotations[k, 1, 2] * dz - origins[t, 1]
        z = rotations[k, 2, 0] * dx + rotations[k, 2, 1] * dy + rotations[k, 2, 2] * dz - origins[t, 2]
        errors[t] = angle_between(bearings[t, 0], bearings[t, 1], bearings[t, 2], x, y, z)
    return errors
