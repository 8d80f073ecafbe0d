"""A coloured point cloud with normals."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.record import Axis, Record, require_array


@dataclass(frozen=True, eq=False)
class PointCloud(Record):
    """A coloured point cloud with normals, in the world frame.

    Attributes:
        points_in_world: (N, 3) float32, scene units.
        normals_in_world: (N, 3) float32 unit vectors towards the side from which the surface was seen.
        colors_rgb: (N, 3) uint8.
        view_counts: (N,) uint8 number of views that agree on the point.
        confidence: (N,) uint8, as of the range maps: the largest of the views that agree; None if not known.
    """

    axis: ClassVar[Axis | None] = Axis.ONE
    kind_version: ClassVar[int] = 2

    points_in_world: NDArray[np.float32]
    normals_in_world: NDArray[np.float32]
    colors_rgb: NDArray[np.uint8]
    view_counts: NDArray[np.uint8]
    confidence: NDArray[np.uint8] | None = None

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points_in_world)

    def check(self) -> None:
        """Raise ContractError unless all arrays agree."""
        count = len(self.points_in_world)
        require_array(self, "points_in_world", dtype=np.float32, shape=(count, 3))
        require_array(self, "normals_in_world", dtype=np.float32, shape=(count, 3))
        require_array(self, "colors_rgb", dtype=np.uint8, shape=(count, 3))
        require_array(self, "view_counts", dtype=np.uint8, shape=(count,))
        if self.confidence is not None:
            require_array(self, "confidence", dtype=np.uint8, shape=(count,))
