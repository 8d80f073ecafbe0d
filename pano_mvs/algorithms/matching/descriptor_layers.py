"""Match key points that have several descriptors, such as those of tiles squeezed in different ways."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.matching.brute_force import nearest_descriptors, one_to_one
from pano_mvs.algorithms.matching.nearest_two import NearestTwo
from pano_mvs.scene import Features


@dataclass(frozen=True, slots=True, eq=False)
class DescriptorLayer:
    """Further descriptors of some key points of an image, at most one for each.

    Attributes:
        keypoint_idx: (M,) intp positions of the key points, ascending.
        descriptors: (M, D) of the same kind as those of the key points.
    """

    keypoint_idx: NDArray[np.intp]
    descriptors: NDArray[np.generic]

    def __len__(self) -> int:
        """Return the number of descriptors."""
        return len(self.keypoint_idx)


Layers = Sequence[DescriptorLayer]


@dataclass(frozen=True, slots=True, eq=False)
class RatedMatches:
    """Matches that are each other's best, before the ratio test.

    Attributes:
        matches_idx: (M, 2) int32 positions in the first and second image, by ascending position in the first.
        squared: (M,) float32 squared distance.
        next_squared: (M,) float32 squared distance of the second-best key point.
    """

    matches_idx: NDArray[np.int32]
    squared: NDArray[np.float32]
    next_squared: NDArray[np.float32]

    def below(self, ratio: float) -> NDArray[np.int32]:
        """Return the matches that pass the ratio test, (K, 2)."""
        return self.matches_idx[self.squared < np.float32(ratio**2) * self.next_squared]


def match_layers(
    first: Features, second: Features, *, first_layers: Layers = (), second_layers: Layers = ()
) -> RatedMatches:
    """Match the key points of two images by the nearest of all their descriptors.

    The key points' own descriptors are compared with one another and with the further ones of the other image; further
    ones are not compared with each other, since a surface is seen obliquely in one of the images only. The second-best
    distance is that of another key point. Without layers, matches below a ratio are those of `match_features`.

    Args:
        first: key points of the first image, with descriptors compared by Euclidean distance.
        second: those of the second image.
        first_layers: further descriptors of the first image.
        second_layers: further descriptors of the second image.
    """
    rows = _Nearest.of(len(first))
    best_back = np.full(len(second), np.inf, np.float32)
    for one, other in _compared(_own(first), _own(second), first_layers=first_layers, second_layers=second_layers):
        if len(one) and len(other) > 1:
            found = nearest_descriptors(one.descriptors, other.descriptors)
            rows.note(one, replace(found, nearest=other.keypoint_idx[found.nearest]))
            best_back[other.keypoint_idx] = np.minimum(best_back[other.keypoint_idx], found.squared_back)
    kept = np.flatnonzero(np.isfinite(rows.squared))
    kept = kept[rows.squared[kept] <= best_back[rows.nearest[kept]]]
    matches = one_to_one(kept, rows.nearest, rows.squared)
    return RatedMatches(matches, rows.squared[matches[:, 0]], rows.next_squared[matches[:, 0]])


@dataclass(slots=True, eq=False)
class _Nearest:
    """The nearest key point of the other image for each key point, and the distance of the second nearest one."""

    nearest: NDArray[np.intp]
    squared: NDArray[np.float32]
    next_squared: NDArray[np.float32]

    @staticmethod
    def of(count: int) -> _Nearest:
        far = np.full(count, np.inf, np.float32)
        return _Nearest(np.full(count, -1, np.intp), far, far.copy())

    def note(self, layer: DescriptorLayer, found: NearestTwo) -> None:
        """Note the nearest two of the key points of a layer; `found.nearest` are positions of key points."""
        keypoints, squared = layer.keypoint_idx, found.squared
        before, best_before, next_before = (a[keypoints] for a in (self.nearest, self.squared, self.next_squared))
        closer = squared < best_before
        same = found.nearest == before
        loser = np.where(closer, best_before, squared)
        runner_up = np.minimum(next_before, found.next_squared)
        self.next_squared[keypoints] = np.where(same, runner_up, np.minimum(runner_up, loser))
        self.squared[keypoints] = np.where(closer, squared, best_before)
        self.nearest[keypoints] = np.where(closer, found.nearest, before)


def _own(features: Features) -> DescriptorLayer:
    return DescriptorLayer(np.arange(len(features)), features.descriptors)


def _compared(
    first: DescriptorLayer, second: DescriptorLayer, *, first_layers: Layers, second_layers: Layers
) -> Iterator[tuple[DescriptorLayer, DescriptorLayer]]:
    yield first, second
    yield from ((first, layer) for layer in second_layers)
    yield from ((layer, second) for layer in first_layers)
