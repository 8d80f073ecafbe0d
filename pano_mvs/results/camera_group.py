"""The cameras of one group: their neighbours, the distances between them, and the ranges that they see."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.core.arrays import FloatArray
from pano_mvs.results.coverage import ViewCoverage
from pano_mvs.results.figures import significant
from pano_mvs.results.records import PosesSummary

_KNOWN_NEIGHBOURS = 6


@dataclass(frozen=True, eq=False)
class CameraGroup:
    """The cameras of a group, with what is known of their surroundings.

    Attributes:
        number: of the group.
        poses: of the group; the centres of all cameras are known.
        centers: (N, 3), N > 1.
        neighbours: (N, K) up to six nearest other cameras, nearest first.
        coverage: what the views see, as far as known.
    """

    number: int
    poses: PosesSummary
    centers: FloatArray
    neighbours: NDArray[np.intp]
    coverage: Mapping[str, ViewCoverage]

    @staticmethod
    def of(number: int, poses: PosesSummary, coverage: Mapping[str, ViewCoverage]) -> CameraGroup | None:
        """Return a group; None if it has fewer than two cameras, or not all their centres are known."""
        centers = np.array(poses.centers, np.float64).reshape(-1, 3)
        if len(centers) != len(poses.registered) or len(centers) < 2 or not np.isfinite(centers).all():
            return None
        return CameraGroup(number, poses, centers, nearest_neighbours(centers), coverage)

    @property
    def names(self) -> tuple[str, ...]:
        """The images, in the order of `centers`."""
        return self.poses.registered

    @property
    def unit(self) -> str:
        """The unit of length."""
        return "m" if self.poses.metric else "scene units"

    def length(self, value: float) -> str:
        """Return a length with its unit."""
        return f"{significant(value)} {self.unit}"

    def nearest(self, idx: int) -> NDArray[np.intp]:
        """Return up to six other cameras, nearest first."""
        return np.asarray(self.neighbours[idx])

    def distance(self, first: int, second: int) -> float:
        """Return the distance between two cameras."""
        return float(np.linalg.norm(self.centers[first] - self.centers[second]))

    def typical_range(self, idx: int) -> float | None:
        """Return the median range of a view, or None if it is unknown."""
        known = self.coverage.get(self.names[idx])
        return None if known is None else known.typical_range


def nearest_neighbours(centers: FloatArray) -> NDArray[np.intp]:
    """Return up to six nearest others of each point (N, 3), (N, K), nearest first; N > 1."""
    count = len(centers)
    found = cKDTree(centers).query(centers, k=min(count, _KNOWN_NEIGHBOURS + 1))
    distance, unordered = np.asarray(found[0], np.float64), np.asarray(found[1], np.intp)
    near: NDArray[np.intp] = np.take_along_axis(unordered, np.lexsort((unordered, distance)), axis=1)
    own = near == np.arange(count)[:, None]
    own[~own.any(axis=1), -1] = True  # of many points in one place, the point itself may not be among the nearest
    neighbours: NDArray[np.intp] = near[~own].reshape(count, -1)
    return neighbours


def shortest_tree(centers: FloatArray) -> list[tuple[int, int, float]]:
    """Return (first, second, length) of the edges of the minimum spanning tree of points (N, 3), by Prim's method."""
    count = len(centers)
    length = np.full(count, np.inf)
    nearest = np.zeros(count, np.int64)
    outside = np.ones(count, np.bool_)
    edges: list[tuple[int, int, float]] = []
    current = 0
    for _ in range(count - 1):
        outside[current] = False
        distance = np.linalg.norm(centers - centers[current], axis=1)
        closer = outside & (distance < length)
        length[closer], nearest[closer] = distance[closer], current
        current = int(np.argmin(np.where(outside, length, np.inf)))
        edges.append((int(nearest[current]), current, float(length[current])))
    return edges
