"""Points of the surfaces in one view, evenly distributed over its sphere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.record import Axis, Record, require, require_array


@dataclass(frozen=True, eq=False)
class SurfaceSamples(Record):
    """Points of the surfaces in one view.

    Attributes:
        bearings: (N, 3) float64 unit rays in the view's camera frame.
        ranges: (N,) float32 along the rays, scene units.
        colors_rgb: (N, 3) uint8.
        confidence: (N,) uint8, of the range map.
    """

    axis: ClassVar[Axis | None] = Axis.VIEW

    bearings: NDArray[np.float64]
    ranges: NDArray[np.float32]
    colors_rgb: NDArray[np.uint8]
    confidence: NDArray[np.uint8]

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.ranges)

    def check(self) -> None:
        """Raise ContractError unless all arrays agree and every range is positive."""
        count = len(self.ranges)
        require_array(self, "bearings", dtype=np.float64, shape=(count, 3))
        require_array(self, "ranges", dtype=np.float32, shape=(count,))
        require_array(self, "colors_rgb", dtype=np.uint8, shape=(count, 3))
        require_array(self, "confidence", dtype=np.uint8, shape=(count,))
        require(bool((self.ranges > 0).all()), self, "a range is zero or negative")
