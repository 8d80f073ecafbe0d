"""The essential matrix on the sphere: residual, linear solution, decomposition."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3

FloatArray = NDArray[np.float64]

_DIAGONAL = np.array([1.0, 1.0, 0.0])
_QUARTER_TURN = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def sampson_angles(essentials: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the spherical Sampson error |e| / √(|E p|² + |Eᵀ q|² − 2 e²), e = qᵀ E p, in radians.

    To first order this is the angle by which the two rays together must move to meet.

    Args:
        essentials: (..., 3, 3) essential matrices E = [t]× R of second_from_first, of any scale.
        first: (M, 3) unit bearings p in the first image.
        second: (M, 3) unit bearings q in the second.

    Returns:
        (..., M); zero where both rays lie on the baseline and say nothing.
    """
    flat = essentials.reshape(-1, 3, 3)
    # Three matrix products in place of one loop: e is linear in E, the squared lengths in EᵀE and EEᵀ.
    algebraic = flat.reshape(-1, 9) @ _products(second, first).T
    squares = _symmetric(np.swapaxes(flat, 1, 2) @ flat) @ _quadratics(first).T
    squares += _symmetric(flat @ np.swapaxes(flat, 1, 2)) @ _quadratics(second).T
    squared = algebraic**2
    squares -= 2 * squared
    residuals = np.sqrt(squared / np.maximum(squares, 1e-300))
    return residuals.reshape(*essentials.shape[:-2], len(first))


def msac_costs(essentials: FloatArray, first: FloatArray, second: FloatArray, threshold_rad: float) -> FloatArray:
    """Return Σ min(r² / threshold², 1) over all matches, for each of the essential matrices (..., 3, 3)."""
    residuals = sampson_angles(essentials, first, second)
    costs: FloatArray = np.sum(np.minimum((residuals / threshold_rad) ** 2, 1.0), axis=-1)
    return costs


def essential_from_bearings(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the essential matrices that solve qᵀ E p = 0 in the least-squares sense (8-point method).

    On the sphere the coordinates are of unit size already, so no normalisation of Hartley's is needed.

    Args:
        first: (..., M, 3) unit bearings p, M ≥ 8.
        second: (..., M, 3) unit bearings q.

    Returns:
        (..., 3, 3) matrices with singular values 1, 1, 0.
    """
    products = _products(second, first)
    vectors = np.linalg.eigh(np.swapaxes(products, -1, -2) @ products)[1]
    u, _, vt = np.linalg.svd(vectors[..., 0].reshape(*products.shape[:-2], 3, 3))
    essential: FloatArray = (u * _DIAGONAL) @ vt
    return essential


def poses_from_essential(essential: FloatArray) -> list[Rigid3]:
    """Return the four second_from_first poses, |t| = 1, that share an essential matrix (3, 3)."""
    u, _, vt = np.linalg.svd(essential)
    u, vt = u * np.sign(np.linalg.det(u)), vt * np.sign(np.linalg.det(vt))
    rotations = (u @ _QUARTER_TURN @ vt, u @ _QUARTER_TURN.T @ vt)
    return [Rigid3(rotation, sign * u[:, 2]) for rotation in rotations for sign in (1.0, -1.0)]


def in_front(first: FloatArray, second: FloatArray, second_from_first: Rigid3) -> NDArray[np.bool_]:
    """Return whether each pair of rays, (M, 3) and (M, 3), meets at positive range from both centres, (M,).

    The signs of `ranges_from_bearings`' numerators, with C the second centre in the first frame and q de-rotated:
    (C × q)·(p × q) = C·p − (C·q)(p·q) and (C × p)·(p × q) = (C·p)(p·q) − C·q. Parallel rays do not meet.
    """
    q = second @ second_from_first.rotation
    center = second_from_first.center
    along_p, along_q, cosine = first @ center, q @ center, np.einsum("ni,ni->n", first, q)
    front: NDArray[np.bool_] = (along_p > along_q * cosine) & (along_p * cosine > along_q)
    return front


def _products(second: FloatArray, first: FloatArray) -> FloatArray:
    """Return the coefficients of E's nine entries in qᵀ E p, (..., M, 9)."""
    return (second[..., :, None] * first[..., None, :]).reshape(*first.shape[:-1], 9)


def _quadratics(vectors: FloatArray) -> FloatArray:
    """Return the coefficients of a symmetric matrix's six entries in vᵀ S v, (M, 6)."""
    x, y, z = vectors.T
    return np.stack([x * x, y * y, z * z, 2 * x * y, 2 * x * z, 2 * y * z], axis=1)


def _symmetric(matrices: FloatArray) -> FloatArray:
    """Return the six entries of symmetric matrices in the order of `_quadratics`, (N, 6)."""
    rows, columns = np.array([0, 1, 2, 0, 0, 1]), np.array([0, 1, 2, 1, 2, 2])
    entries: FloatArray = matrices[:, rows, columns]
    return entries
