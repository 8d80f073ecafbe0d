"""Compiled: errors of matches between two models under a similarity."""

from __future__ import annotations

import math

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import inlined, kernel


@inlined
def _chord(x: float, y: float, z: float, ray: FloatArray, out: FloatArray) -> float:
    """Write the difference of a direction and a ray, and return the angle between them."""
    length = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    out[0], out[1], out[2] = x / length - ray[0], y / length - ray[1], z / length - ray[2]
    half = 0.5 * math.sqrt(out[0] * out[0] + out[1] * out[1] + out[2] * out[2])
    return 2.0 * math.asin(min(half, 1.0))


@kernel
def match_errors(
    similarity: FloatArray,
    centers: FloatArray,
    rays: FloatArray,
    ranges: FloatArray,
    errors: FloatArray,
    residuals: FloatArray,
) -> None:
    """Write the error of each match, (M,), and its residuals, (M, 7): two chords, and the epipolar error.

    Args:
        similarity: (13,) rotation, translation and scale of first_from_second.
        centers: (M, 2, 3) centres of the cameras, each in its own world.
        rays: (M, 2, 3) unit rays.
        ranges: (M, 2) known ranges, NaN where unknown.
        errors: the larger angle between a known point and the ray to it in the other model; else the epipolar error.
        residuals: the chord is zero where the point is unknown.
    """
    r, t, s = similarity[:9].reshape(3, 3), similarity[9:12], similarity[12]
    first, second, v = np.empty(3), np.empty(3), np.empty(3)
    for m in range(len(ranges)):
        u, w = rays[m, 0], rays[m, 1]
        for axis in range(3):
            second[axis] = t[axis]
            v[axis] = 0.0
            for k in range(3):
                second[axis] += s * r[axis, k] * centers[m, 1, k]
                v[axis] += r[axis, k] * w[k]
        worst = -1.0
        residuals[m, :6] = 0.0
        if ranges[m, 0] == ranges[m, 0]:
            for axis in range(3):
                first[axis] = centers[m, 0, axis] + ranges[m, 0] * u[axis] - second[axis]
            x = r[0, 0] * first[0] + r[1, 0] * first[1] + r[2, 0] * first[2]
            y = r[0, 1] * first[0] + r[1, 1] * first[1] + r[2, 1] * first[2]
            z = r[0, 2] * first[0] + r[1, 2] * first[1] + r[2, 2] * first[2]
            worst = max(worst, _chord(x, y, z, w, residuals[m, :3]))
        if ranges[m, 1] == ranges[m, 1]:
            for axis in range(3):
                first[axis] = second[axis] + s * ranges[m, 1] * v[axis] - centers[m, 0, axis]
            worst = max(worst, _chord(first[0], first[1], first[2], u, residuals[m, 3:6]))
        for axis in range(3):
            first[axis] = second[axis] - centers[m, 0, axis]
        length = max(math.sqrt(first[0] ** 2 + first[1] ** 2 + first[2] ** 2), 1e-12)
        bx, by, bz = first[0] / length, first[1] / length, first[2] / length
        nx, ny, nz = u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]
        e = nx * bx + ny * by + nz * bz
        bu, bv = bx * u[0] + by * u[1] + bz * u[2], bx * v[0] + by * v[1] + bz * v[2]
        residuals[m, 6] = e / math.sqrt(max(2.0 - bu * bu - bv * bv - 2.0 * e * e, 1e-12))
        errors[m] = worst if worst >= 0 else abs(residuals[m, 6])
