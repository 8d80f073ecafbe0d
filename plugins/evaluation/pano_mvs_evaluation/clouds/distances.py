"""Distances between a cloud and the true surface, and the scores that follow from them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Similarity3
from pano_mvs_evaluation.clouds.true_surface import TrueSurface
from pano_mvs_evaluation.ranges.view_scores import weighted_quantile

DEFAULT_THRESHOLDS = 0.05, 0.02


@dataclass(frozen=True, slots=True)
class CloudScore:
    """Scores of a cloud at one tolerance."""

    threshold: float  # the tolerance t, in the truth's unit
    accuracy: float  # share of the cloud's points within t of the true surface
    completeness: float  # share, by area, of the surface to be covered that is within t of the cloud
    f_score: float  # harmonic mean of the two (Knapitsch et al., "Tanks and Temples", 2017, section 5)

    def as_dict(self) -> dict[str, float]:
        """Return all figures by name."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, slots=True, eq=False)
class CloudDistances:
    """Distances between a cloud and the true surface; infinite beyond the limit of the search."""

    # (N,) float32, from each point of the cloud to the nearest sample of the whole true surface
    of_points: NDArray[np.float32]
    # (M,) float32, from each sample of the surface to be covered to the nearest point
    of_surface: NDArray[np.float32]

    def quantiles(self, surface: TrueSurface, shares: Sequence[float] = (0.5, 0.9)) -> dict[str, tuple[float, ...]]:
        """Return quantiles: "accuracy" over the points, "completeness" by area of the surface; NaN of nothing."""
        count = len(self.of_points)
        at = [max(0, int(np.ceil(share * count - 1e-9)) - 1) for share in shares]
        ordered = np.partition(self.of_points, at) if count else np.full(1, np.nan)
        return {
            "accuracy": tuple(float(ordered[idx]) for idx in at),
            "completeness": tuple(weighted_quantile(self.of_surface, surface.area, share) for share in shares),
        }


def cloud_distances(
    cloud: PointSource, true_points: Iterable[NDArray[np.float32]], surface: TrueSurface, *, limit: float
) -> CloudDistances:
    """Return the distances from a cloud to the truth and back.

    Search trees are built of one piece of the truth, or one chunk of the cloud, at a time. Memory is that of one of
    them, and four bytes per point and sample.

    Args:
        cloud: the points, in the truth's frame and unit.
        true_points: the whole true surface in pieces (K, 3): everything that any view sees.
        surface: the part to be covered.
        limit: larger distances count as infinite.
    """
    if not limit > 0:
        raise UsageError(f"the largest distance to measure must be positive, got {limit}")
    of_points = np.full(cloud.count, np.inf, np.float32)
    for piece in true_points:
        tree = _tree(piece)
        for part, chunk in _parts(cloud):
            np.minimum(of_points[part], _nearest(chunk, tree, limit), out=of_points[part])
    of_surface = np.full(len(surface.points_in_world), np.inf, np.float32)
    for _, chunk in _parts(cloud):
        np.minimum(of_surface, _nearest(surface.points_in_world, _tree(chunk), limit), out=of_surface)
    return CloudDistances(of_points, of_surface)


def score_cloud(
    distances: CloudDistances, surface: TrueSurface, thresholds: Sequence[float] = DEFAULT_THRESHOLDS
) -> tuple[CloudScore, ...]:
    """Return the scores at each tolerance; an empty cloud scores 0."""
    area = float(surface.area.sum())
    scores = []
    for threshold in thresholds:
        accuracy = float((distances.of_points <= threshold).mean()) if len(distances.of_points) else 0.0
        found = float(surface.area[distances.of_surface <= threshold].sum())
        completeness = found / area if area > 0 else 0.0
        both = accuracy + completeness
        f_score = 2 * accuracy * completeness / both if both > 0 else 0.0
        scores.append(CloudScore(threshold, accuracy, completeness, f_score))
    return tuple(scores)


def _parts(cloud: PointSource) -> Iterator[tuple[slice, NDArray[np.float32]]]:
    """Return the points in chunks of at most `CHUNK_POINTS`, with their positions in the cloud."""
    start, size = 0, CHUNK_POINTS
    for chunk in cloud.chunks():
        for first in range(0, len(chunk), size):
            part = chunk[first : first + size]
            yield slice(start, start + len(part)), part
            start += len(part)


def _tree(points: NDArray[np.float32]) -> scipy.spatial.cKDTree | None:
    """Return a search tree of points; None without points."""
    # Split in the middle of the box, not at the median: as fast for points on surfaces, and built in half the time.
    return scipy.spatial.cKDTree(points, balanced_tree=False, compact_nodes=False) if len(points) else None


def _nearest(points: NDArray[np.float32], others: scipy.spatial.cKDTree | None, limit: float) -> NDArray[np.float32]:
    """Return the distance, (N,), from each point to the nearest other; infinite beyond the limit or without others."""
    if others is None or not len(points):
        return np.full(len(points), np.inf, np.float32)
    distance, _ = others.query(points, distance_upper_bound=np.nextafter(limit, np.inf))
    return np.asarray(distance, np.float32)


CHUNK_POINTS = 2_000_000
"""Largest number of points that are in memory, and in a search tree, at a time."""

Points = NDArray[np.float32]


class PointSource(Protocol):
    """Points on disk or in memory; `PlyPoints` is one too."""

    @property
    def count(self) -> int:
        """Number of points."""

    def chunks(self) -> Iterator[Points]:
        """Return the positions in chunks (K, 3), in order."""

    def some(self, step: int) -> tuple[Points, Points]:
        """Return positions and normals, both (K, 3), of every step-th point; unknown normals are 0."""


@dataclass(frozen=True, eq=False)
class PointsInMemory:
    """Positions (N, 3) and normals (N, 3), None if unknown."""

    positions: Points
    normals: Points | None = None

    @property
    def count(self) -> int:
        """Number of points."""
        return len(self.positions)

    def chunks(self) -> Iterator[Points]:
        """Return the positions in chunks (K, 3)."""
        return (self.positions[at : at + CHUNK_POINTS] for at in range(0, self.count, CHUNK_POINTS))

    def some(self, step: int) -> tuple[Points, Points]:
        """Return positions and normals of every step-th point; unknown normals are 0."""
        positions = self.positions[::step]
        return positions, np.zeros_like(positions) if self.normals is None else self.normals[::step]


@dataclass(frozen=True, eq=False)
class MovedPoints:
    """Points brought into another frame by a similarity transform."""

    source: PointSource
    target_from_source: Similarity3

    @property
    def count(self) -> int:
        """Number of points."""
        return self.source.count

    def chunks(self) -> Iterator[Points]:
        """Return the positions in chunks (K, 3), in the target's frame."""
        return (self.target_from_source.apply(chunk).astype(np.float32) for chunk in self.source.chunks())

    def some(self, step: int) -> tuple[Points, Points]:
        """Return positions and normals of every step-th point, in the target's frame."""
        positions, normals = self.source.some(step)
        moved = self.target_from_source
        return moved.apply(positions).astype(np.float32), (normals @ moved.rotation.T).astype(np.float32)
