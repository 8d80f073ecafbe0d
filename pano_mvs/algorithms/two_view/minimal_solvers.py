"""Minimal samples of matches, and essential matrices from them: the five-point and the eight-point solver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray

Solver: TypeAlias = Literal["five_point", "eight_point"]


@dataclass(frozen=True)
class MinimalSolver:
    """A minimal solver."""

    sample: int  # number of matches in a sample
    batch: int  # number of samples that are drawn together
    # (N, sample, 3) bearings of the first and of the second image to (K, 3, 3) essential matrices
    solve: Callable[[FloatArray, FloatArray], FloatArray]
    models: int  # maximum number of essential matrices from one sample


def essentials_from_five(first: FloatArray, second: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return all essential matrices that satisfy qᵀ E p = 0 for five pairs of bearings.

    E = x X + y Y + z Z + W over the null space of the five equations; det E = 0 and 2 E Eᵀ E − tr(E Eᵀ) E = 0 are ten
    cubic equations in x, y, z, and lead to one of degree ten in z (Nistér 2004, "An efficient solution to the
    five-point relative pose problem"). Points on a plane need no special treatment.

    Args:
        first: (N, 5, 3) unit bearings p of N samples.
        second: (N, 5, 3) unit bearings q.

    Returns:
        (K, 3, 3) matrices of Frobenius norm √2, at most ten for each sample, and the sample of each, (K,), ascending.
        Samples with dependent equations give no matrix.
    """
    from pano_mvs.algorithms.two_view.kernels_five_point import solve_five

    count = len(first)
    essentials, sample_idx = np.empty((10 * count, 3, 3)), np.empty(10 * count, np.int64)
    samples = np.arange(5 * count).reshape(count, 5)
    found = solve_five(
        np.ascontiguousarray(first, np.float64).reshape(-1, 3),
        np.ascontiguousarray(second, np.float64).reshape(-1, 3),
        samples,
        essentials,
        sample_idx,
    )
    return essentials[:found], sample_idx[:found]


def essential_from_bearings(first: FloatArray, second: FloatArray) -> FloatArray:
    """Return the essential matrices that solve qᵀ E p = 0 in the least-squares sense (8-point method).

    Unit bearings need no normalisation as in Hartley's method.

    Args:
        first: (..., M, 3) unit bearings p, M ≥ 8.
        second: (..., M, 3) unit bearings q.

    Returns:
        (..., 3, 3) matrices with singular values 1, 1, 0.
    """
    # The coefficients of E's nine entries in qᵀ E p.
    products = (second[..., :, None] * first[..., None, :]).reshape(*first.shape[:-1], 9)
    vectors = np.linalg.eigh(np.swapaxes(products, -1, -2) @ products)[1]
    u, _, vt = np.linalg.svd(vectors[..., 0].reshape(*products.shape[:-2], 3, 3))
    essential: FloatArray = (u * [1.0, 1.0, 0.0]) @ vt
    return essential


SOLVERS: dict[Solver, MinimalSolver] = {
    "five_point": MinimalSolver(
        sample=5, batch=64, solve=lambda first, second: essentials_from_five(first, second)[0], models=10
    ),
    "eight_point": MinimalSolver(8, 256, essential_from_bearings, models=1),
}


def draw_samples(rng: np.random.Generator, count: int, *, batch: int, sample: int) -> NDArray[np.int64]:
    """Return positions of distinct matches among `count` matches, (batch, sample)."""
    samples = rng.integers(count, size=(batch, sample))
    repeated = np.flatnonzero((np.diff(np.sort(samples, axis=1), axis=1) == 0).any(axis=1))
    for row in repeated:
        samples[row] = rng.choice(count, sample, replace=False)
    return samples


def samples_needed(inlier_ratio: float, confidence: float, *, sample: int) -> float:
    """Return the number of samples after which one without outliers has been drawn with the given probability."""
    clean = inlier_ratio**sample
    if clean >= 1:
        return 0.0
    return float(np.log1p(-confidence) / np.log1p(-clean)) if clean > 0 else np.inf
