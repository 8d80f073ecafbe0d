"""How far a cloud is from the true surface, and how much of it it covers."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.algorithms.metrics.surface import TrueSurface
from pano_mvs.core.errors import UsageError

DEFAULT_THRESHOLDS = 0.05, 0.02


@dataclass(frozen=True, slots=True)
class CloudScore:
    """How good a cloud is at one tolerance.

    Attributes:
        threshold: the tolerance t, in the truth's unit.
        accuracy: share of the cloud's points within t of the true surface.
        completeness: share, by area, of the true surface that should be found within t of the cloud.
        f_score: harmonic mean of the two (Knapitsch et al., "Tanks and Temples", 2017, section 5).
    """

    threshold: float
    accuracy: float
    completeness: float
    f_score: float

    def as_dict(self) -> dict[str, float]:
        """Return all figures by name."""
        return dataclasses.asdict(self)


@dataclass(frozen=True, slots=True, eq=False)
class CloudDistances:
    """Distances between a cloud and the true surface; infinite where larger than any tolerance.

    Attributes:
        of_points: (N,) float32, from each point of the cloud to the nearest sample of the whole true surface.
        of_surface: (M,) float32, from each sample of the surface that should be found to the nearest point.
    """

    of_points: NDArray[np.float32]
    of_surface: NDArray[np.float32]


def cloud_distances(
    points_in_world: NDArray[np.float32],
    true_points: Iterable[NDArray[np.float32]],
    surface: TrueSurface,
    *,
    limit: float,
) -> CloudDistances:
    """Return the distances from a cloud to the truth and back.

    Args:
        points_in_world: (N, 3) the cloud, in the truth's frame and unit.
        true_points: the whole true surface in pieces (K, 3), one in memory at a time: all that any view sees.
        surface: what should be found.
        limit: larger distances need not be told apart.

    Raises:
        UsageError: if the limit is not positive.
    """
    if not limit > 0:
        raise UsageError(f"the largest tolerance must be positive, got {limit}")
    of_points = np.full(len(points_in_world), np.inf, np.float32)
    for piece in true_points:
        np.minimum(of_points, _nearest(points_in_world, piece, limit), out=of_points)
    return CloudDistances(of_points, _nearest(surface.points_in_world, points_in_world, limit))


def score_cloud(
    distances: CloudDistances, surface: TrueSurface, thresholds: Sequence[float] = DEFAULT_THRESHOLDS
) -> tuple[CloudScore, ...]:
    """Return the scores at each tolerance; an empty cloud scores 0.

    Args:
        distances: as of `cloud_distances`, with a limit of at least the largest tolerance.
        surface: what should be found.
        thresholds: tolerances, in the truth's unit.
    """
    area = surface.area.sum()
    scores = []
    for threshold in thresholds:
        accuracy = float((distances.of_points <= threshold).mean()) if len(distances.of_points) else 0.0
        found = float(surface.area[distances.of_surface <= threshold].sum())
        completeness = found / float(area) if area > 0 else 0.0
        both = accuracy + completeness
        f_score = 2 * accuracy * completeness / both if both > 0 else 0.0
        scores.append(CloudScore(threshold, accuracy, completeness, f_score))
    return tuple(scores)


def _nearest(points: NDArray[np.float32], others: NDArray[np.float32], limit: float) -> NDArray[np.float32]:
    """Return the distance, (N,), from each point to the nearest other; infinite beyond the limit or without others."""
    if not len(others) or not len(points):
        return np.full(len(points), np.inf, np.float32)
    # Split in the middle of the box, not at the median: as good for points on surfaces, and built in half the time.
    tree = cKDTree(others, balanced_tree=False, compact_nodes=False)
    distance, _ = tree.query(points, distance_upper_bound=np.nextafter(limit, np.inf))
    return np.asarray(distance, np.float32)
