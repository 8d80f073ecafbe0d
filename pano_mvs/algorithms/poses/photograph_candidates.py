"""Choose the panoramas with which a photograph is matched, in captures of many panoramas."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.brute_force import match_l2

# VLAD vectors hardly separate the panoramas of a photograph's place from others, because a panorama's describes the
# whole sphere (docs/benchmarks.md). The strongest key points do, with a fraction of the comparisons.
_SAMPLE = 300
_RATIO = 0.8  # threshold of the ratio test of Lowe 2004, section 7.1


def similar_panoramas(
    descriptors: NDArray[np.generic], panoramas: Mapping[str, NDArray[np.generic]], *, count: int
) -> list[str]:
    """Return the names of the panoramas that match the strongest key points of a photograph best, in given order.

    As in `shortlist.sample_matches`, the number of mutual matches of a sample decides; here, the sample of the
    photograph is matched with all key points of each panorama, of which a photograph shows a small part. Of equal
    panoramas, the first are taken.

    Args:
        descriptors: (N, 128) of the photograph's key points, strongest first.
        panoramas: (M, 128) descriptors of each panorama, by name.
        count: number of panoramas; all are returned if there are no more than these, or if it is 0.
    """
    names = list(panoramas)
    if not 0 < count < len(names):
        return names
    sample = descriptors[:_SAMPLE]
    matches = [_count_matches(sample, known) for known in panoramas.values()]
    best = np.argsort(np.negative(matches), kind="stable")[:count]
    return [names[idx] for idx in sorted(best.tolist())]


def _count_matches(sample: NDArray[np.generic], known: NDArray[np.generic]) -> int:
    return len(match_l2(sample, known, ratio=_RATIO)) if min(len(sample), len(known)) >= 2 else 0
