"""Congruent copies of the objects of a place."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pano_mvs.core.arrays import FloatArray
from pano_mvs.testing.surfaces import Ball, Cuboid, Quad, Surface, Vector
from tests.synthetic.bounded import Bounded
from tests.synthetic.rod import Rod
from tools.benchmarks.repeating.fittings import Painted, Wall, corners, vector
from tools.benchmarks.repeating.prints import Print
from tools.benchmarks.repeating.walks import Rect


@dataclass(frozen=True)
class Move:
    """A shift, or half a turn about the vertical axis through the world's origin, including textures.

    Attributes:
        step: vector of the shift.
        half_turn: whether it is half a turn; the step is then zero.
    """

    step: Vector = (0.0, 0.0, 0.0)
    half_turn: bool = False

    def point(self, point: Vector) -> Vector:
        """Return a moved point."""
        return vector(self._signs * point + np.array(self.step))

    def direction(self, direction: Vector) -> Vector:
        """Return a moved direction."""
        return vector(self._signs * direction)

    def thing(self, thing: Painted) -> Painted:
        """Return a moved surface with its print."""
        surface, pattern = thing
        if not isinstance(pattern, Print):
            raise TypeError(f"a texture {pattern!r} cannot be moved; only prints can")
        if self.half_turn:
            return self.surface(surface), replace(pattern, half_turn=True)
        return self.surface(surface), replace(pattern, origin=self.point(pattern.origin))

    def wall(self, wall: Wall) -> Wall:
        """Return a moved wall."""
        return replace(wall, foot=self.point(wall.foot), along=self.direction(wall.along))

    def rect(self, rect: Rect) -> Rect:
        """Return a moved rectangle."""
        low, high = corners(self.point((rect[0], 0.0, rect[1])), self.point((rect[2], 0.0, rect[3])))
        return low[0], low[2], high[0], high[2]

    def surface(self, surface: Surface) -> Surface:
        """Return a moved surface."""
        match surface:
            case Bounded():
                return replace(surface, surface=self.surface(surface.surface), center=self.point(surface.center))
            case Ball():
                return replace(surface, center=self.point(surface.center))
            case Rod():
                return replace(surface, foot=self.point(surface.foot), head=self.point(surface.head))
            case Quad():
                edges = self.direction(surface.edge_u), self.direction(surface.edge_v)
                return replace(surface, corner=self.point(surface.corner), edge_u=edges[0], edge_v=edges[1])
            case Cuboid():
                low, high = corners(self.point(surface.low), self.point(surface.high))
                return replace(surface, low=low, high=high)
        raise TypeError(f"{type(surface).__name__} cannot be moved")

    @property
    def _signs(self) -> FloatArray:
        return np.array([-1.0, 1.0, -1.0] if self.half_turn else [1.0, 1.0, 1.0])
