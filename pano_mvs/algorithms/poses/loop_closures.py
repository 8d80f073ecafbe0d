"""Find false loop closures of a walk: pairs of places that look the same, but are far apart along the path."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.core.arrays import FloatArray
from pano_mvs.scene import Features, Poses, TwoView

Pair = tuple[str, str]

# Pairs of images at most this number of places apart are in sequence; all others are closures. Only captures are tested
# that have at least this number of images, in which most consecutive images are paired and most pairs are in sequence.
_WINDOW, _MIN_IMAGES = 10, 20
_CONSECUTIVE_SHARE, _SEQUENCE_SHARE = 0.8, 0.5


@dataclass(frozen=True)
class FalseClosure:
    """A loop closure that contradicts the path."""

    pair: Pair  # the images
    steps: float  # distance between the two places of the same points, in median steps of the path


def find_false_closures(features: Mapping[str, Features], two_views: Mapping[Pair, TwoView]) -> list[FalseClosure]:
    """Return the pairs that join places which are far apart, by the path of the cameras.

    The poses are solved from the pairs in sequence alone. Points that a closure matches have two positions in this
    model, one from either stretch of the path. For a true closure, they differ by the drift of the path, at most 2 % of
    its length between the two images. Rooms that look the same give matches that agree perfectly with each other, but
    their points are elsewhere. Captures that were not taken along a path are not tested, nor are closures with too few
    points that are known twice.

    Args:
        features: key points by image name, in the order in which the images were taken.
        two_views: verified pairs.
    """
    place = {name: idx for idx, name in enumerate(features)}
    if not _may_be_walk(place, two_views):
        return []
    # Views are read one by one, because those of a large capture do not fit into memory.
    valid = [pair for pair, view in two_views.items() if view]
    sequence = [pair for pair in valid if _is_near(place, pair)]
    closures = [pair for pair in valid if not _is_near(place, pair)]
    if not closures or not _is_walk(place, sequence, count=len(valid)):
        return []
    # The random generator is not used; see `solve_scaled_translation`.
    poses = solve_scaled_translation(features, _Selected(two_views, sequence), rng=np.random.default_rng(0))
    known = _KnownPoints(poses, features)
    along = _path_lengths(poses)
    found = []
    for pair in closures:
        if not all(name in known.position for name in pair):
            continue
        first, second = (known.position[name] for name in pair)
        if poses.groups[first] != poses.groups[second]:
            continue
        apart = known.distances(pair, two_views[pair])
        step = along.step[poses.groups[first]]
        # A closure contradicts the path if its points are farther apart than this share of the path between both
        # images, and than this number of steps.
        allowed = max(2.0 * step, 0.02 * abs(along.at[first] - along.at[second]))
        if len(apart) >= 8 and float(np.median(apart)) > allowed:
            found.append(FalseClosure(pair, float(np.median(apart)) / step))
    return found


class _Selected(Mapping[Pair, TwoView]):
    """Some of the pairs, which are read on access."""

    def __init__(self, two_views: Mapping[Pair, TwoView], pairs: Collection[Pair]) -> None:
        self._two_views = two_views
        self._pairs = dict.fromkeys(pairs)

    def __getitem__(self, pair: Pair) -> TwoView:
        if pair not in self._pairs:
            raise KeyError(pair)
        return self._two_views[pair]

    def __iter__(self) -> Iterator[Pair]:
        return iter(self._pairs)

    def __len__(self) -> int:
        return len(self._pairs)


def _is_near(place: Mapping[str, int], pair: Pair) -> bool:
    return abs(place[pair[0]] - place[pair[1]]) <= _WINDOW


def _may_be_walk(place: Mapping[str, int], pairs: Collection[Pair]) -> bool:
    """Return whether the pairs, valid or not, may be those of a walk with closures."""
    consecutive = sum(abs(place[a] - place[b]) == 1 for a, b in pairs)
    return (
        len(place) >= _MIN_IMAGES
        and consecutive >= _CONSECUTIVE_SHARE * (len(place) - 1)
        and not all(_is_near(place, pair) for pair in pairs)
    )


def _is_walk(place: Mapping[str, int], sequence: Collection[Pair], *, count: int) -> bool:
    consecutive = sum(abs(place[a] - place[b]) == 1 for a, b in sequence)
    return (
        len(place) >= _MIN_IMAGES
        and consecutive >= _CONSECUTIVE_SHARE * (len(place) - 1)
        and len(sequence) >= _SEQUENCE_SHARE * count
    )


@dataclass(frozen=True, eq=False)
class _Path:
    """Where cameras are along the path of their group, (N,), and the median step of each group."""

    at: FloatArray
    step: dict[int, float]


def _path_lengths(poses: Poses) -> _Path:
    at, step = np.zeros(len(poses.names)), {}
    for group in np.unique(poses.groups).tolist():
        members = np.flatnonzero(poses.groups == group)
        steps = np.linalg.norm(np.diff(poses.centers[members], axis=0), axis=1)
        at[members] = np.concatenate([[0.0], np.cumsum(steps)])
        step[group] = float(np.median(steps)) if len(steps) else 1.0
    return _Path(at, step)


class _KnownPoints:
    """The points of a model that show key points of an image."""

    def __init__(self, poses: Poses, features: Mapping[str, Features]) -> None:
        self.poses = poses
        self.features = features
        self.position = {name: idx for idx, name in enumerate(poses.names)}
        order = np.argsort(poses.track_image_idx, kind="stable")
        self._observations = np.split(
            order, np.searchsorted(poses.track_image_idx[order], np.arange(1, len(poses.names)))
        )
        self._points: dict[str, NDArray[np.intp]] = {}

    def distances(self, pair: Pair, view: TwoView) -> FloatArray:
        """Return the distances between the two positions of the matched points that are known from either image."""
        points = [self._of_keypoints(name)[view.matches_idx[:, side]] for side, name in enumerate(pair)]
        both = (points[0] >= 0) & (points[1] >= 0)
        apart = self.poses.points_in_world[points[0][both]] - self.poses.points_in_world[points[1][both]]
        return np.asarray(np.linalg.norm(apart, axis=1), np.float64)

    def _of_keypoints(self, name: str) -> NDArray[np.intp]:
        """Return the point of each key point of an image; −1 without one."""
        if name not in self._points:
            own = self._observations[self.position[name]]
            bearings = self.features[name].bearings
            found = np.full(len(bearings), -1, np.intp)
            if len(own) and len(bearings):
                distance, nearest = cKDTree(self.poses.track_bearings[own]).query(bearings)
                is_same = np.asarray(distance) < 1e-5
                found[is_same] = self.poses.track_point_idx[own[np.asarray(nearest)[is_same]]]
            self._points[name] = found
        return self._points[name]
