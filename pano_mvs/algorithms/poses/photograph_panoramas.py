"""The panoramas among which photographs are localised, of which few are in memory at a time."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.nearest_two import Comparable
from pano_mvs.algorithms.poses.photograph_surface import (
    KnownPoints,
    SurfacePoints,
    has_sift,
    known_points,
    surface_points,
)
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Features, RangeMap


class LocatedPanoramas:
    """The points of panoramas with known poses and ranges, computed when they are needed.

    The points of at most `kept` panoramas stay in memory: those of one photograph and of the one before.

    Args:
        poses: camera from world by name; panoramas without key points or ranges are left out.
        features: key points by name.
        ranges: range maps by name.
        min_confidence: smallest confidence of a range that is used.
        candidates: number of most similar panoramas that each photograph is matched with; 0: all.
    """

    def __init__(
        self,
        poses: Mapping[str, Rigid3],
        features: Mapping[str, Features],
        ranges: Mapping[str, RangeMap],
        *,
        min_confidence: int,
        candidates: int,
    ) -> None:
        self._poses = {name: pose for name, pose in poses.items() if name in features and name in ranges}
        self._features, self._ranges = features, ranges
        self._min_confidence, self._candidates = min_confidence, candidates
        self._points = lru_cache(maxsize=self.kept(candidates, len(self._poses)))(self._read_points)
        self.surface = lru_cache(maxsize=self.kept(candidates, len(self._poses)))(self._read_surface)

    @staticmethod
    def kept(candidates: int, count: int) -> int:
        """Return how many of a number of panoramas stay in memory."""
        return min(2 * candidates, count) if candidates else count

    @property
    def chooses(self) -> bool:
        """Whether there are more panoramas than each photograph is matched with."""
        return 0 < self._candidates < len(self._poses)

    def __bool__(self) -> bool:
        """Return whether any panorama can be used."""
        return any(has_sift(self._features[name]) for name in self._poses)

    def most_similar(self, photographs: Sequence[NDArray[np.generic]]) -> list[list[str]]:
        """Return the names of the panoramas that each photograph is matched with.

        If there are more than these, all panoramas are read once, one at a time.

        Args:
            photographs: (N, 128) descriptors of each photograph, strongest key points first.
        """
        if not photographs:
            return []
        if self.chooses:
            return similar_panoramas(photographs, self._descriptors(), count=self._candidates)
        usable = [name for name in self._poses if self._points(name) is not None]
        return [usable] * len(photographs)

    def points(self, names: Sequence[str]) -> dict[str, KnownPoints]:
        """Return the key points of panoramas that `most_similar` returned."""
        found = {name: self._points(name) for name in names}
        return {name: points for name, points in found.items() if points is not None}

    def _descriptors(self) -> Iterator[tuple[str, NDArray[np.generic]]]:
        for name in self._poses:
            if (points := self._read_points(name)) is not None:
                yield name, points.descriptors

    def _read_points(self, name: str) -> KnownPoints | None:
        features = self._features[name]
        if not has_sift(features):
            return None
        return known_points(features, self._poses[name], self._ranges[name], min_confidence=self._min_confidence)

    def _read_surface(self, name: str) -> SurfacePoints:
        given = self._features[name], self._poses[name], self._ranges[name]
        return surface_points(*given, min_confidence=self._min_confidence)


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
    samples = [Comparable(descriptors[:300]) for descriptors in photographs]
    names: list[str] = []
    matches: list[list[int]] = []
    for name, descriptors in panoramas:
        known = Comparable(descriptors)
        names.append(name)
        matches.append([_count_matches(sample, known) for sample in samples])
    if not 0 < count < len(names):
        return [list(names) for _ in samples]
    order = np.argsort(-np.array(matches).T, axis=1, kind="stable")[:, :count]
    return [[names[idx] for idx in sorted(best)] for best in order.tolist()]


def _count_matches(sample: Comparable, known: Comparable) -> int:
    """Return the number of mutual nearest neighbours that pass the ratio test, as `match_l2` finds them."""
    if min(len(sample.descriptors), len(known.descriptors)) < 2:
        return 0
    found = sample.nearest_two(known)
    return len(np.unique(found.nearest[found.mutual()]))
