"""The large level and upright planes of a place: floors, ceilings and walls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.record import Axis, Record, require, require_array


@dataclass(frozen=True, eq=False)
class Structure(Record):
    """Planes that a place consists of, n · X = offset in the world, unbounded.

    Attributes:
        normals_in_world: (K, 3) float64 unit normals n, towards the side from which the plane was seen.
        offsets: (K,) float64 in scene units.
        uncertainties: (K,) float64 standard deviation of ranges on the plane, relative to them.
        group_idx: (K,) int32 group of the poses in whose world the plane is.
    """

    axis: ClassVar[Axis | None] = Axis.ONE

    normals_in_world: NDArray[np.float64]
    offsets: NDArray[np.float64]
    uncertainties: NDArray[np.float64]
    group_idx: NDArray[np.int32]

    def __len__(self) -> int:
        """Return the number of planes."""
        return len(self.offsets)

    def check(self) -> None:
        """Raise ContractError unless there is one entry per plane, and normals are of unit length."""
        count = len(self.offsets)
        normals = require_array(self, "normals_in_world", dtype=np.float64, shape=(count, 3))
        require_array(self, "offsets", dtype=np.float64, shape=(count,))
        positive = require_array(self, "uncertainties", dtype=np.float64, shape=(count,)) > 0
        require_array(self, "group_idx", dtype=np.int32, shape=(count,))
        require(bool(positive.all()), self, "an uncertainty is not positive")
        require(bool(np.allclose(np.linalg.norm(normals, axis=1), 1)), self, "a normal is not of unit length")
