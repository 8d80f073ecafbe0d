"""The room around a single panorama, in heights of its camera above the floor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.record import Axis, Record, require, require_array

OUTLINE_AZIMUTHS = 360
CEILINGS = np.geomspace(0.25, 2.0, 60)
"""Heights of ceilings above the camera that are tried, in heights of the camera above the floor."""


@dataclass(frozen=True, eq=False)
class RoomLines(Record):
    """What the lines of a panorama say of the room around it.

    Attributes:
        cam_from_level: (3, 3) rotation from a level frame, whose y points down, turned as little as possible
            against the camera: of one that stands upright, z is the direction of the picture's middle.
        wall_rad: azimuth of a wall in that frame, from z towards x, from 0 to π/2; None without walls at right angles.
        ceiling_clarity: (K,) float32 how clear the creases of walls are with the floor and with a ceiling at each of
            `CEILINGS`, from 0 to 2; empty without walls.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE

    cam_from_level: NDArray[np.float64]
    wall_rad: float | None
    ceiling_clarity: NDArray[np.float32]

    @classmethod
    def unknown(cls) -> Self:
        """Return the lines of a panorama that were not looked for."""
        return cls(np.eye(3), None, np.zeros(0, np.float32))

    def check(self) -> None:
        """Raise ContractError unless the arrays have their shapes and types."""
        require_array(self, "cam_from_level", dtype=np.float64, shape=(3, 3))
        ceilings = 0 if self.wall_rad is None else len(CEILINGS)
        require_array(self, "ceiling_clarity", dtype=np.float32, shape=(ceilings,))


@dataclass(frozen=True, eq=False)
class Ceilings(Record):
    """What the lines of all panoramas of a capture say of the height of its ceilings.

    Attributes:
        clarity: (K,) float32 mean of the `ceiling_clarity` of all panoramas with walls, each less its median; zero
            without any.
    """

    axis: ClassVar[Axis | None] = Axis.ONE

    clarity: NDArray[np.float32]

    def check(self) -> None:
        """Raise ContractError unless the array has its shape and type."""
        require_array(self, "clarity", dtype=np.float32, shape=(len(CEILINGS),))


@dataclass(frozen=True, eq=False)
class RoomOutline(Record):
    """The outline of the room around a panorama: upright walls of four directions at right angles.

    The unit is the height of the camera above the floor. Where a wall has an opening, the outline may follow what is
    seen through it.

    Attributes:
        cam_from_level: (3, 3) rotation from a level frame, whose y points down, turned as little as possible
            against the camera: of one that stands upright, z is the direction of the picture's middle.
        wall_rad: azimuth of a wall in that frame, from z towards x; None if the outline is unknown.
        ceiling: height of the ceiling above the camera; None if the outline is unknown.
        distances: (360,) float32 level distance of the wall at each degree of azimuth, from z towards x; NaN where it
            is unknown.
        probabilities: (360,) float32 probability that the distance is within 5 % of the truth; NaN where it is unknown.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE

    cam_from_level: NDArray[np.float64]
    wall_rad: float | None
    ceiling: float | None
    distances: NDArray[np.float32]
    probabilities: NDArray[np.float32]

    @classmethod
    def unknown(cls, cam_from_level: NDArray[np.float64] | None = None) -> Self:
        """Return an outline of which nothing is known."""
        nothing = np.full(OUTLINE_AZIMUTHS, np.nan, np.float32)
        return cls(np.eye(3) if cam_from_level is None else cam_from_level, None, None, nothing, nothing)

    def check(self) -> None:
        """Raise ContractError unless the arrays agree."""
        require_array(self, "cam_from_level", dtype=np.float64, shape=(3, 3))
        for name in ("distances", "probabilities"):
            require_array(self, name, dtype=np.float32, shape=(OUTLINE_AZIMUTHS,), finite=False)
        turn = self.cam_from_level
        require(bool(np.allclose(turn @ turn.T, np.eye(3), atol=1e-4)), self, "cam_from_level is not a rotation")
        require(
            (self.ceiling is None) == (self.wall_rad is None), self, "a ceiling without walls, or walls without one"
        )
        require(self.ceiling is None or 0 < self.ceiling < np.inf, self, "the ceiling is not above the camera")
        known = np.isfinite(self.distances)
        require(bool((self.distances[known] > 0).all()), self, "a distance is not positive")
        right = self.probabilities[known]
        require(bool((np.isnan(self.probabilities) == ~known).all()), self, "distances and probabilities differ")
        require(bool(((right >= 0) & (right <= 1)).all()), self, "a probability is not from 0 to 1")
        require(self.ceiling is not None or not known.any(), self, "distances without a ceiling")
