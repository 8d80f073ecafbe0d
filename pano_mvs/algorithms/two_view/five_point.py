"""Essential matrices from five pairs of bearings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_SAMPLE = 5
_MAX_SOLUTIONS = 10  # maximum number of essential matrices from one sample


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
    essentials, sample_idx = np.empty((_MAX_SOLUTIONS * count, 3, 3)), np.empty(_MAX_SOLUTIONS * count, np.int64)
    samples = np.arange(_SAMPLE * count).reshape(count, _SAMPLE)
    found = solve_five(
        np.ascontiguousarray(first, np.float64).reshape(-1, 3),
        np.ascontiguousarray(second, np.float64).reshape(-1, 3),
        samples,
        essentials,
        sample_idx,
    )
    return essentials[:found], sample_idx[:found]
