"""The panoramas among which photographs are localised, of which few are in memory at a time."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.photograph_candidates import similar_panoramas
from pano_mvs.algorithms.poses.photograph_points import KnownPoints, has_sift, known_points
from pano_mvs.algorithms.poses.photograph_surface import SurfacePoints, surface_points
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
