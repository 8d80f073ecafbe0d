"""Points of a cloud that need not fit in memory."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Similarity3

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
