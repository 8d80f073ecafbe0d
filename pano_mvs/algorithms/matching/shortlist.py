"""Count matches between small samples of key points, for the pairs that look alike at first sight."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

_MIN_SHORTLIST, _SHORTLIST_PER_NEIGHBOUR = 400, 10
_RATIO_SQUARED = (16, 25)  # (4/5)², the ratio test of Lowe 2004, section 7.1, on squared distances in whole numbers
_BLOCK = 32  # images of a shortlist that are matched in one product
_EXACT = 1 << 24  # float32 holds every whole number up to here, in whatever order products are summed


def sample_matches(
    samples: Sequence[NDArray[np.int16]], dissimilarities: NDArray[np.float64], *, neighbours: int
) -> NDArray[np.float64]:
    """Return how many key points of two samples match, for the pairs on the shortlist of either image.

    Matching a few key points of coarse scales tells overlapping images from others before the rest is matched (Wu,
    "Towards linear-time incremental structure from motion", 2013, section 3.1). A match is mutual and passes the ratio
    test. Time is linear in the number of images once that exceeds the length of a shortlist.

    Args:
        samples: descriptors in whole numbers, (S, B) each; an empty one matches nothing.
        dissimilarities: (N, N), how unlike the images are at first sight; the shortlist is made by it.
        neighbours: number of neighbours that will be chosen; a shortlist has 10 times as many images, at least 400.

    Returns:
        (N, N) symmetric; zero for pairs on no shortlist and on the diagonal.
    """
    count = len(samples)
    length = min(count, max(_MIN_SHORTLIST, _SHORTLIST_PER_NEIGHBOUR * neighbours))
    listed = np.zeros((count, count), np.bool_)
    np.put_along_axis(listed, np.argsort(dissimilarities, axis=1, kind="stable")[:, :length], values=True, axis=1)
    listed = np.triu(listed | listed.T, 1)
    matches = np.zeros((count, count))
    values = [sample.astype(np.float32) for sample in samples]
    for idx in range(count):
        others = np.array(
            [other for other in np.flatnonzero(listed[idx]).tolist() if _comparable(samples[idx], samples[other])],
            np.intp,
        )
        for begin in range(0, len(others), _BLOCK):
            block = others[begin : begin + _BLOCK]
            matches[idx, block] = _count_matches(values[idx], [values[other] for other in block])
    return matches + matches.T


def _comparable(first: NDArray[np.int16], second: NDArray[np.int16]) -> bool:
    """Whether the ratio test can be made both ways, on descriptors of one kind."""
    return min(len(first), len(second)) >= 2 and first.shape[1] == second.shape[1]


def _count_matches(first: NDArray[np.float32], others: Sequence[NDArray[np.float32]]) -> list[int]:
    """Return the number of matches of one sample with each of some others."""
    stacked = np.concatenate(others)
    if _largest_square(first) * _largest_square(stacked) >= _EXACT**2:  # longer than any known descriptor
        first, stacked = first.astype(np.float64), stacked.astype(np.float64)
    products = first @ stacked.T
    own = np.sum(first.astype(np.float64) ** 2, axis=1)
    squared = own[:, None] + np.sum(stacked.astype(np.float64) ** 2, axis=1) - 2 * products.astype(np.float64)
    bounds = np.cumsum([0, *map(len, others)])
    return [_matches_of(squared[:, begin:end]) for begin, end in pairwise(bounds)]


def _matches_of(squared: NDArray[np.float64]) -> int:
    """Return how many mutual nearest neighbours pass the ratio test, from squared distances (M, N)."""
    nearest = squared.argmin(axis=1)
    rows = np.flatnonzero(squared.argmin(axis=0)[nearest] == np.arange(len(squared)))
    two = np.partition(squared[rows], 1, axis=1)[:, :2]
    near, far = _RATIO_SQUARED
    return int(np.count_nonzero(far * two[:, 0] < near * two[:, 1]))


def _largest_square(vectors: NDArray[np.float32]) -> float:
    """Return the largest squared length of some vectors (N, D)."""
    return float(np.max(np.sum(vectors.astype(np.float64) ** 2, axis=1), initial=0.0))
