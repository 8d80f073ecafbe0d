"""Compiled: minimise the Cauchy loss of the spherical Sampson error over the five degrees of freedom of a pose.

With a = R p, e = q·(t × a) and D = |t × a|² + |t × q|² − 2 e² = 2 − (t·a)² − (t·q)² − 2 e² the residual is e / √D, and
∂e/∂ω = (t·a) q − (q·a) t, ∂e/∂t = a × q, ∂D/∂ω = 2 (t·a) (t × a) − 4 e ∂e/∂ω,
∂D/∂t = −2 ((t·a) a + (t·q) q) − 4 e ∂e/∂t; R ← exp(ω) R, and t moves along two tangents of the unit sphere.
"""

from __future__ import annotations

import math

import numpy as np

from pano_mvs.algorithms.two_view.kernels_agreement import epipolar
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.kernels import kernel


@kernel
def _tangents(t: FloatArray, basis: FloatArray) -> None:
    """Write two orthonormal vectors that are normal to t, (2, 3)."""
    least = 0
    for axis in range(1, 3):
        if abs(t[axis]) < abs(t[least]):
            least = axis
    i, j = (least + 1) % 3, (least + 2) % 3
    u, v = basis[0], basis[1]
    # t × the unit vector of that axis
    length = math.sqrt(t[i] * t[i] + t[j] * t[j])
    u[least], u[i], u[j] = 0.0, t[j] / length, -t[i] / length
    v[0], v[1], v[2] = t[1] * u[2] - t[2] * u[1], t[2] * u[0] - t[0] * u[2], t[0] * u[1] - t[1] * u[0]


@kernel
def _cost(rotation: FloatArray, t: FloatArray, first: FloatArray, second: FloatArray, squared_scale: float) -> float:
    """Return Σ log(1 + r² / scale²), with one logarithm for the product of many factors."""
    total, factor = 0.0, 1.0
    for idx in range(len(first)):
        e, squared, _, _, _ = epipolar(rotation, t, first[idx], second[idx])
        factor *= 1.0 + e * e / (max(squared, 1e-12) * squared_scale)
        if factor > 1e100:
            total += math.log(factor)
            factor = 1.0
    return total + math.log(factor)


@kernel
def _normal_equations(
    rotation: FloatArray,
    t: FloatArray,
    first: FloatArray,
    second: FloatArray,
    squared_scale: float,
    hessian: FloatArray,
    gradient: FloatArray,
) -> None:
    """Write the weighted normal equations, (5, 5) and (5,)."""
    basis = np.empty((2, 3))
    _tangents(t, basis)
    row = np.empty(5)
    hessian[:] = 0.0
    gradient[:] = 0.0
    for idx in range(len(first)):
        p, q = first[idx], second[idx]
        a0 = rotation[0, 0] * p[0] + rotation[0, 1] * p[1] + rotation[0, 2] * p[2]
        a1 = rotation[1, 0] * p[0] + rotation[1, 1] * p[1] + rotation[1, 2] * p[2]
        a2 = rotation[2, 0] * p[0] + rotation[2, 1] * p[1] + rotation[2, 2] * p[2]
        n0, n1, n2 = a1 * q[2] - a2 * q[1], a2 * q[0] - a0 * q[2], a0 * q[1] - a1 * q[0]
        along_a = t[0] * a0 + t[1] * a1 + t[2] * a2
        along_q = t[0] * q[0] + t[1] * q[1] + t[2] * q[2]
        cosine = a0 * q[0] + a1 * q[1] + a2 * q[2]
        e = t[0] * n0 + t[1] * n1 + t[2] * n2
        scale = max(2.0 - along_a * along_a - along_q * along_q - 2.0 * e * e, 1e-12)
        root = math.sqrt(scale)
        residual = e / root
        # d r = (1 / √D) de − (e / 2 D^1.5) dD, and dD holds − 4 e de
        by_e = (1.0 + 2.0 * e * e / scale) / root
        by_d = -0.5 * e / (scale * root)
        turn = 2.0 * along_a * by_d
        row[0] = by_e * (along_a * q[0] - cosine * t[0]) + turn * (t[1] * a2 - t[2] * a1)
        row[1] = by_e * (along_a * q[1] - cosine * t[1]) + turn * (t[2] * a0 - t[0] * a2)
        row[2] = by_e * (along_a * q[2] - cosine * t[2]) + turn * (t[0] * a1 - t[1] * a0)
        g0 = by_e * n0 - 2.0 * by_d * (along_a * a0 + along_q * q[0])
        g1 = by_e * n1 - 2.0 * by_d * (along_a * a1 + along_q * q[1])
        g2 = by_e * n2 - 2.0 * by_d * (along_a * a2 + along_q * q[2])
        row[3] = g0 * basis[0, 0] + g1 * basis[0, 1] + g2 * basis[0, 2]
        row[4] = g0 * basis[1, 0] + g1 * basis[1, 1] + g2 * basis[1, 2]
        weight = 1.0 / (1.0 + residual * residual / squared_scale)
        for i in range(5):
            weighted = weight * row[i]
            gradient[i] += weighted * residual
            for j in range(i + 1):
                hessian[i, j] += weighted * row[j]
    trace = hessian[0, 0] + hessian[1, 1] + hessian[2, 2] + hessian[3, 3] + hessian[4, 4]
    for i in range(5):
        hessian[i, i] += 1e-9 * trace


@kernel
def _solve(hessian: FloatArray, gradient: FloatArray, step: FloatArray) -> bool:
    """Write the solution of H s = −g by Cholesky's factors of H, and return whether H is positive."""
    for i in range(5):
        for j in range(i + 1):
            entry = hessian[i, j]
            for k in range(j):
                entry -= hessian[i, k] * hessian[j, k]
            if i != j:
                hessian[i, j] = entry / hessian[j, j]
            elif entry > 0.0:
                hessian[i, i] = math.sqrt(entry)
            else:
                return False
    for i in range(5):
        step[i] = -gradient[i]
        for k in range(i):
            step[i] -= hessian[i, k] * step[k]
        step[i] /= hessian[i, i]
    for i in range(4, -1, -1):
        for k in range(i + 1, 5):
            step[i] -= hessian[k, i] * step[k]
        step[i] /= hessian[i, i]
    return True


@kernel
def _move(
    rotation: FloatArray,
    t: FloatArray,
    step: FloatArray,
    shrink: float,
    moved_rotation: FloatArray,
    moved_t: FloatArray,
) -> None:
    """Write the pose after a step: exp(ω) R by Rodrigues' formula, and t moved along its tangents."""
    x, y, z = shrink * step[0], shrink * step[1], shrink * step[2]
    squared = x * x + y * y + z * z
    angle = math.sqrt(squared)
    sine = math.sin(angle) / angle if angle > 1e-9 else 1.0
    versine = 2.0 * (math.sin(0.5 * angle) / angle) ** 2 if angle > 1e-9 else 0.5
    for j in range(3):
        r0, r1, r2 = rotation[0, j], rotation[1, j], rotation[2, j]
        c0, c1, c2 = y * r2 - z * r1, z * r0 - x * r2, x * r1 - y * r0
        moved_rotation[0, j] = r0 + sine * c0 + versine * (y * c2 - z * c1)
        moved_rotation[1, j] = r1 + sine * c1 + versine * (z * c0 - x * c2)
        moved_rotation[2, j] = r2 + sine * c2 + versine * (x * c1 - y * c0)
    basis = np.empty((2, 3))
    _tangents(t, basis)
    length = 0.0
    for i in range(3):
        moved_t[i] = t[i] + shrink * (step[3] * basis[0, i] + step[4] * basis[1, i])
        length += moved_t[i] * moved_t[i]
    length = math.sqrt(length)
    for i in range(3):
        moved_t[i] /= length


@kernel
def refine_pose(
    rotation: FloatArray, t: FloatArray, first: FloatArray, second: FloatArray, scale: float, max_iterations: int
) -> None:
    """Minimise the Cauchy loss of a pose by Gauss–Newton with reweighting and step halving.

    Args:
        rotation: (3, 3) of second_from_first, overwritten.
        t: (3,) its unit translation, overwritten.
        first: (M, 3) unit bearings.
        second: (M, 3) unit bearings.
        scale: residual, in radians, with weight ½.
        max_iterations: maximum number of steps.
    """
    squared_scale = scale * scale
    hessian, gradient, step = np.empty((5, 5)), np.empty(5), np.empty(5)
    moved_rotation, moved_t = np.empty((3, 3)), np.empty(3)
    cost = _cost(rotation, t, first, second, squared_scale)
    for _ in range(max_iterations):
        _normal_equations(rotation, t, first, second, squared_scale, hessian, gradient)
        if not _solve(hessian, gradient, step):
            return
        shrink, moved_cost = 1.0, np.inf
        for attempt in range(4):
            shrink = 1.0 if attempt == 0 else 0.3 if attempt == 1 else 0.1 if attempt == 2 else 0.01
            _move(rotation, t, step, shrink, moved_rotation, moved_t)
            moved_cost = _cost(moved_rotation, moved_t, first, second, squared_scale)
            if moved_cost < cost:
                break
        if not moved_cost < cost:
            return
        gain = cost - moved_cost
        for i in range(3):
            t[i] = moved_t[i]
            for j in range(3):
                rotation[i, j] = moved_rotation[i, j]
        cost = moved_cost
        if gain < 1e-10 * cost:
            return
