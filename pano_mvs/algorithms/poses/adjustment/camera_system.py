"""The reduced camera system of bundle adjustment as a banded matrix, with cameras that share points close together.

For a path of N cameras, memory and time are then about proportional to N, where the full matrix needs N² and N³. The
band is stored by columns: band[j, d] is the entry in row j + d, column j (LAPACK's lower band storage, transposed).
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray, IndexArray


def camera_order(point_idx: IndexArray, image_idx: IndexArray, count: int) -> NDArray[np.intp]:
    """Return the order of cameras, (count,), in which cameras that share points are close to each other.

    Cuthill & McKee, "Reducing the bandwidth of sparse symmetric matrices", 1969, reversed (George 1971).

    Args:
        point_idx: (T,) point of every observation.
        image_idx: (T,) its camera.
        count: number of cameras.
    """
    seen = scipy.sparse.csr_array(
        (np.ones(len(point_idx), np.float32), (point_idx, image_idx)), shape=(int(point_idx[-1]) + 1, count)
    )
    shared = scipy.sparse.csr_array(seen.T @ seen)
    return np.asarray(scipy.sparse.csgraph.reverse_cuthill_mckee(shared, symmetric_mode=True), np.intp)


def camera_span(starts: NDArray[np.intp], image_idx: IndexArray) -> int:
    """Return the largest distance in positions of two cameras that share a point.

    Args:
        starts: (P + 1,) the first observation of every point, then the number of observations; every point has one.
        image_idx: (T,) camera of every observation, sorted by point.
    """
    last = np.maximum.reduceat(image_idx, starts[:-1])
    return int((last - np.minimum.reduceat(image_idx, starts[:-1])).max())


def held(band: FloatArray, gradient: FloatArray, camera: int) -> tuple[FloatArray, FloatArray]:
    """Return the system in which a camera does not move: its rows and columns are those of the identity."""
    band, gradient = band.copy(), gradient.copy()
    own = np.arange(6 * camera, 6 * camera + 6)
    band[own] = 0
    for row in own:
        columns = np.arange(max(0, row - band.shape[1] + 1), row)
        band[columns, row - columns] = 0
    band[own, 0] = 1
    gradient[own] = 0
    return band, gradient


def camera_solver(band: FloatArray) -> Callable[[FloatArray], FloatArray]:
    """Return a function that solves the symmetric positive definite system for right-hand sides (6N,) or (6N, K).

    Raises:
        LinAlgError: if the system is not positive definite.
    """
    size, width = band.shape
    # A band wider than this share of the matrix is solved faster as a full matrix.
    if width > 0.4 * size:
        whole = scipy.linalg.cho_factor(dense_from_band(band), lower=True, overwrite_a=True)
        return lambda right: np.asarray(scipy.linalg.cho_solve(whole, right), np.float64)
    factor = scipy.linalg.cholesky_banded(band.T, lower=True)
    return lambda right: np.asarray(scipy.linalg.cho_solve_banded((factor, True), right), np.float64)


def dense_from_band(band: FloatArray) -> FloatArray:
    """Return the lower half of the matrix, (6N, 6N), zero above the diagonal."""
    size, width = band.shape
    matrix = np.zeros((size, size))
    for d in range(min(width, size)):
        np.fill_diagonal(matrix[d:], band[: size - d, d])
    return matrix
