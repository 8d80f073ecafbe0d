"""Choose the panoramas with which photographs are matched, in captures of many panoramas."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.integer_descriptors import (
    PackedDescriptors,
    can_compare_as_integers,
    nearest_two_packed,
)
from pano_mvs.algorithms.matching.nearest_two import NearestTwo, nearest_two


def similar_panoramas(
    photographs: Sequence[NDArray[np.generic]], panoramas: Iterable[tuple[str, NDArray[np.generic]]], *, count: int
) -> list[list[str]]:
    """Return, for each photograph, the names of the panoramas that match its strongest key points best, in given order.

    As in `neighbours.sample_matches`, the number of mutual matches of a sample decides; here, the sample of the
    photograph is matched with all key points of each panorama, of which a photograph shows a small part. Of equal
    panoramas, the first are taken. The panoramas are iterated over once, and no descriptors of theirs are kept.

    Args:
        photographs: (N, 128) descriptors of each photograph's key points, strongest first.
        panoramas: the name and the (M, 128) descriptors of each panorama.
        count: number of panoramas; all are returned if there are no more than these, or if it is 0.
    """
    # VLAD vectors hardly separate the panoramas of a photograph's place from others, because a panorama's describes the
    # whole sphere (docs/benchmarks.md). The strongest key points do, with a fraction of the comparisons.
    samples = [_Sample(descriptors[:300]) for descriptors in photographs]
    names: list[str] = []
    matches: list[list[int]] = []
    for name, descriptors in panoramas:
        known = _Sample(descriptors)
        names.append(name)
        matches.append([_count_matches(sample, known) for sample in samples])
    return [_best(names, [row[idx] for row in matches], count) for idx in range(len(samples))]


def _best(names: list[str], matches: list[int], count: int) -> list[str]:
    if not 0 < count < len(names):
        return list(names)
    best = np.argsort(np.negative(matches), kind="stable")[:count]
    return [names[idx] for idx in sorted(best.tolist())]


class _Sample:
    """Descriptors (N, D), packed once for many comparisons if the machine compares integers."""

    def __init__(self, descriptors: NDArray[np.generic]) -> None:
        self.descriptors = descriptors
        whole = descriptors.size > 0 and can_compare_as_integers(descriptors)
        self.packed = PackedDescriptors.of(descriptors) if whole else None


def _count_matches(sample: _Sample, known: _Sample) -> int:
    """Return the number of mutual nearest neighbours that pass the ratio test, as `match_l2` finds them."""
    if min(len(sample.descriptors), len(known.descriptors)) < 2:
        return 0
    found = _nearest_two(sample, known)
    # Threshold of the ratio test of Lowe 2004, section 7.1.
    kept = found.squared < np.float32(0.8**2) * found.next_squared
    kept &= found.squared <= found.squared_back[found.nearest]
    return len(np.unique(found.nearest[kept]))


def _nearest_two(sample: _Sample, known: _Sample) -> NearestTwo:
    if sample.packed is not None and known.packed is not None:
        return nearest_two_packed(sample.packed, known.packed)
    return nearest_two(sample.descriptors, known.descriptors)
