"""The panoramas among which photographs are localised: their key points, and surfaces around these."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.fusion.view import normals_from_range
from pano_mvs.algorithms.matching.nearest_two import Comparable
from pano_mvs.algorithms.ranges.agreement import pixels_containing
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, ray_from_pixel
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

    As in `pair_selection.sample_matches`, the number of mutual matches of a sample decides; here, the sample of the
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


# A patch is used if most of 5 × 5 ranges around its middle, two pixels apart, are on its tangent plane within 2 %.
_OFFSETS_PX = (-4, -2, 0, 2, 4)


@dataclass(frozen=True, slots=True, eq=False)
class SurfacePoints:
    """Points of surfaces that a panorama sees."""

    cam_from_world: Rigid3  # the panorama's pose
    bearings: FloatArray  # (N, 3) float64 unit, in its camera frame
    ranges: FloatArray  # (N,) float64
    normals_in_cam: FloatArray  # (N, 3) float64 unit, towards the camera
    range_stds: FloatArray  # (N,) float64 standard deviations of the logarithms of the ranges

    @property
    def points_in_world(self) -> FloatArray:
        """The points, (N, 3)."""
        return self.cam_from_world.inverse().apply(self.bearings * self.ranges[:, None])

    def __getitem__(self, chosen: NDArray[np.generic]) -> SurfacePoints:
        """Return some of the points."""
        return SurfacePoints(
            self.cam_from_world,
            self.bearings[chosen],
            self.ranges[chosen],
            self.normals_in_cam[chosen],
            self.range_stds[chosen],
        )


def surface_points(
    features: Features, cam_from_world: Rigid3, range_map: RangeMap, *, min_confidence: int
) -> SurfacePoints:
    """Return the points of flat surfaces at a panorama's key points; ranges are those of the tangent planes.

    Args:
        features: key points of the panorama, of which only the bearings are used.
        cam_from_world: the panorama's pose.
        range_map: its ranges.
        min_confidence: smallest confidence of a range that is used.
    """
    size_hw = (range_map.range.shape[0], range_map.range.shape[1])
    y, x = pixels_containing(features.bearings, size_hw)
    good = np.flatnonzero(np.isfinite(range_map.range[y, x]) & (range_map.confidence[y, x] >= min_confidence))
    x, y, bearings = x[good], y[good], features.bearings[good]
    wanted = np.zeros(size_hw, np.bool_)
    wanted[y, x] = True
    given = None if range_map.normals_in_cam is None else range_map.normals_in_cam.astype(np.float32)
    normals = normals_from_range(range_map, given=given, wanted=wanted)[y, x].astype(np.float64)
    centers = ray_from_pixel(np.stack([x + 0.5, y + 0.5], axis=-1), size_hw)
    heights = (normals * centers).sum(axis=1) * range_map.range[y, x]
    slopes = (normals * bearings).sum(axis=1)
    with np.errstate(invalid="ignore"):
        flat = _planar_share(range_map.range, (x, y), (normals, heights)) >= 0.8
        keep = flat & (slopes < -0.1)
    stds = np.full(len(good), 0.005)
    if range_map.uncertainty is not None:
        stds = np.clip(np.nan_to_num(range_map.uncertainty[y, x].astype(np.float64), nan=1.0), 0.003, 0.05)
    return SurfacePoints(cam_from_world, bearings[keep], (heights / slopes)[keep], normals[keep], stds[keep])


def _planar_share(
    ranges: NDArray[np.float32],
    pixels: tuple[NDArray[np.intp], NDArray[np.intp]],
    planes: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Return the share of the ranges around pixels (x, y) that are on planes n · X = h, given as (n, h); (N,)."""
    normals, heights = planes
    height, width = ranges.shape
    x, y = pixels
    stretch = 1 / np.maximum(np.sin(np.pi * (y + 0.5) / height), 0.1)
    share = np.zeros(len(x))
    for down in _OFFSETS_PX:
        for across in _OFFSETS_PX:
            row = np.clip(y + down, 0, height - 1)
            column = (x + np.rint(across * stretch).astype(np.intp)) % width
            rays = ray_from_pixel(np.stack([column + 0.5, row + 0.5], axis=-1), (height, width))
            on_plane = heights / (normals * rays).sum(axis=1)
            share += np.abs(ranges[row, column] / on_plane - 1) < 0.02
    return share / len(_OFFSETS_PX) ** 2


_BESIDE = ((-1, 0), (1, 0), (0, -1), (0, 1))


@dataclass(frozen=True, slots=True, eq=False)
class KnownPoints:
    """The key points of a panorama whose position is known."""

    descriptors: NDArray[np.generic]  # (N, D)
    points_in_world: NDArray[np.float64]  # (N, 3) float64
    keypoints_idx: NDArray[np.intp]  # (N,) their positions among all key points of the panorama


def has_sift(features: Features) -> bool:
    """Return whether key points can be compared with those of photographs."""
    return features.metric == "l2" and features.descriptors.shape[1] == 128


def known_points(
    features: Features, cam_from_world: Rigid3, range_map: RangeMap, *, min_confidence: int
) -> KnownPoints:
    """Return the key points of a panorama that its range map places in the world.

    Key points at edges of surfaces, whose range is uncertain, are left out.

    Args:
        features: key points by `extract_sift`.
        cam_from_world: the panorama's pose.
        range_map: its ranges.
        min_confidence: smallest confidence of a range that is used.
    """
    height, width = range_map.range.shape
    y, x = pixels_containing(features.bearings, (height, width))
    ranges = range_map.range[y, x].astype(np.float64)
    beside = np.stack([range_map.range[np.clip(y + dy, 0, height - 1), (x + dx) % width] for dx, dy in _BESIDE])
    with np.errstate(invalid="ignore"):
        # Ranges are used where the surface is continuous: the relative difference to the pixels beside it.
        smooth = (np.abs(beside - ranges) <= 0.03 * ranges).all(axis=0)
    keep = smooth & np.isfinite(ranges) & (range_map.confidence[y, x] >= min_confidence)
    points = cam_from_world.inverse().apply(features.bearings[keep] * ranges[keep, None])
    return KnownPoints(features.descriptors[keep], points, np.flatnonzero(keep))
