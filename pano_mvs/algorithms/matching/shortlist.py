"""Count matches between small samples of key points, for pairs that look similar at first."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.integer_descriptors import (
    PackedDescriptors,
    can_compare_as_integers,
    nearest_two_packed,
)
from pano_mvs.algorithms.matching.nearest_two import NearestTwo, nearest_two

_MIN_SHORTLIST, _SHORTLIST_PER_NEIGHBOUR = 300, 10
_RATIO = 0.8  # threshold of the ratio test of Lowe 2004, section 7.1


def sample_matches(
    samples: Sequence[NDArray[np.int16]], dissimilarities: NDArray[np.float64], *, neighbours: int
) -> NDArray[np.float64]:
    """Return the number of matching key points of two samples, for pairs on the shortlist of either image.

    Matching a few key points of coarse scales separates overlapping images from others before the rest is matched (Wu,
    "Towards linear-time incremental structure from motion", 2013, section 3.1). A match is mutual and passes the ratio
    test. Time is linear in the number of images once it exceeds the length of a shortlist.

    Args:
        samples: descriptors as integers, (S, B) each; an empty one matches nothing.
        dissimilarities: (N, N), approximate dissimilarity of the images, by which shortlists are made.
        neighbours: number of neighbours that will be chosen; a shortlist has 10 times as many images, at least 300.

    Returns:
        (N, N) symmetric; zero for pairs on no shortlist and on the diagonal.
    """
    count = len(samples)
    length = min(count, max(_MIN_SHORTLIST, _SHORTLIST_PER_NEIGHBOUR * neighbours))
    listed = np.zeros((count, count), np.bool_)
    np.put_along_axis(listed, np.argsort(dissimilarities, axis=1, kind="stable")[:, :length], values=True, axis=1)
    listed = np.triu(listed | listed.T, 1)
    matches = np.zeros((count, count))
    compare = _comparison(samples)
    for first, second in np.argwhere(listed).tolist():
        if _comparable(samples[first], samples[second]):
            matches[first, second] = _count_matches(compare(first, second))
    return matches + matches.T


def _comparison(samples: Sequence[NDArray[np.int16]]) -> Callable[[int, int], NearestTwo]:
    """Return a function that compares two samples given by their positions, compiled if the machine supports it."""
    if all(map(can_compare_as_integers, samples)):
        packed = {idx: PackedDescriptors.of(sample) for idx, sample in enumerate(samples) if sample.size}
        return lambda first, second: nearest_two_packed(packed[first], packed[second])
    return lambda first, second: nearest_two(samples[first], samples[second])


def _comparable(first: NDArray[np.int16], second: NDArray[np.int16]) -> bool:
    """Return whether two samples have the same kind of descriptor and are large enough for a ratio test."""
    return len(first) > 0 and len(second) >= 2 and first.shape[1] == second.shape[1]


def _count_matches(found: NearestTwo) -> int:
    """Return the number of mutual nearest neighbours that pass the ratio test."""
    distinct = found.squared < np.float32(_RATIO**2) * found.next_squared
    return int(np.count_nonzero(distinct & (found.squared <= found.squared_back[found.nearest])))
