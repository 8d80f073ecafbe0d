"""A coloured point cloud with normals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import accumulate
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.record import Axis, Record, require, require_array


@dataclass(frozen=True, eq=False)
class PointCloud(Record):
    """A coloured point cloud with normals, in the world frame.

    Where the cameras are in several groups, the points of each group are in that group's own world; `groups`
    separates them.

    Attributes:
        points_in_world: (N, 3) float32, scene units.
        normals_in_world: (N, 3) float32 unit vectors, on the side of the surface that was seen.
        colors_rgb: (N, 3) uint8.
        view_counts: (N,) uint8 number of views that agree on the point.
        confidence: (N,) uint8, the largest confidence in the range maps of the views that agree; None if unknown.
        group_sizes: number of points of each group, in the order of the points; empty with one group.
        uncertainty: (N,) float32 standard deviation of the position in scene units; None if unknown.
    """

    axis: ClassVar[Axis | None] = Axis.ONE
    kind_version: ClassVar[int] = 2

    points_in_world: NDArray[np.float32]
    normals_in_world: NDArray[np.float32]
    colors_rgb: NDArray[np.uint8]
    view_counts: NDArray[np.uint8]
    confidence: NDArray[np.uint8] | None = None
    group_sizes: tuple[int, ...] = ()
    uncertainty: NDArray[np.float32] | None = None

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
        if self.uncertainty is not None:
            require_array(self, "uncertainty", dtype=np.float32, shape=(count,))
        if self.group_sizes:
            fits = min(self.group_sizes) >= 0 and sum(self.group_sizes) == count
            require(fits, self, f"groups of {self.group_sizes} points do not make up {count}")

    def groups(self) -> list[PointCloud]:
        """Return the cloud of each group, the largest group of cameras first; arrays are views of this cloud's."""
        if not self.group_sizes:
            return [self]
        ends = zip(self.group_sizes, accumulate(self.group_sizes), strict=True)
        return [self.some(slice(end - size, end)) for size, end in ends]

    def some(self, chosen: slice | NDArray[np.bool_] | NDArray[np.integer]) -> PointCloud:
        """Return the points at a slice, a mask or positions, as one group."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self) if field.name != "group_sizes"}
        some = {name: array[chosen] for name, array in arrays.items() if array is not None}
        return replace(self, group_sizes=(), **some)

    @staticmethod
    def of_groups(clouds: Sequence[PointCloud]) -> PointCloud:
        """Join the clouds of all groups, beginning with group 0; confidence is kept if all have it."""
        confidences = [cloud.confidence for cloud in clouds if cloud.confidence is not None]
        if len(clouds) == 1:
            return clouds[0]
        return PointCloud(
            np.concatenate([cloud.points_in_world for cloud in clouds]),
            np.concatenate([cloud.normals_in_world for cloud in clouds]),
            np.concatenate([cloud.colors_rgb for cloud in clouds]),
            np.concatenate([cloud.view_counts for cloud in clouds]),
            np.concatenate(confidences) if len(confidences) == len(clouds) else None,
            tuple(len(cloud) for cloud in clouds),
            joined_uncertainty(clouds),
        )


def joined_uncertainty(clouds: Sequence[PointCloud]) -> NDArray[np.float32] | None:
    """Return the uncertainties of the points of several clouds, in order; None unless all clouds have them."""
    known = [cloud.uncertainty for cloud in clouds if cloud.uncertainty is not None]
    return np.concatenate([np.zeros(0, np.float32), *known]) if len(known) == len(clouds) else None
