"""Essential matrices on the sphere: residual and linear solution."""

from __future__ import annotations

import numpy as np

from pano_mvs.core.arrays import FloatArray

_DIAGONAL = np.array([1.0, 1.0, 0.0])


def sampson_angles(essentials: FloatArray, first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the spherical Sampson error |e| / √(|E p|² + |Eᵀ q|² − 2 e²), e = qᵀ E p, in radians.

    To first order this is the total angle by which the two rays must move to intersect.

    Args:
        essentials: (..., 3, 3) essential matrices E = [t]× R of second_from_first, of any scale.
        first: (M, 3) unit bearings p in the first image.
        second: (M, 3) unit bearings q in the second.

    Returns:
        (..., M); zero if both rays lie on the baseline.
    """
    flat = essentials.reshape(-1, 3, 3)
    # Three matrix products replace a loop: e is linear in E, the squared lengths in EᵀE and EEᵀ.
    algebraic = flat.reshape(-1, 9) @ _products(second, first).T
    squares = _symmetric(np.swapaxes(flat, 1, 2) @ flat) @ _quadratics(first).T
    squares += _symmetric(flat @ np.swapaxes(flat, 1, 2)) @ _quadratics(second).T
    squared = algebraic**2
    squares -= 2 * squared
    residuals = np.sqrt(squared / np.maximum(squares, 1e-300))
    return residuals.reshape(*essentials.shape[:-2], len(first))


def essential_from_bearings(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the essential matrices that solve qᵀ E p = 0 in the least-squares sense (8-point method).

    Unit bearings need no normalisation as in Hartley's method.

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
