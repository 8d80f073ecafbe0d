"""The large level and upright planes of a place: floors, ceilings and walls."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.poses import Poses
from pano_mvs.scene.record import Axis, Record, positions_fit, require, require_array


@dataclass(frozen=True, eq=False)
class Structure(Record):
    """Planes that a place consists of, n · X = offset in the world, unbounded, and its mirrors."""

    axis: ClassVar[Axis | None] = Axis.ONE
    kind_version: ClassVar[int] = 2

    # (K, 3) float64 unit normals n, towards the side from which the plane was seen
    normals_in_world: NDArray[np.float64]
    offsets: NDArray[np.float64]  # (K,) float64 in scene units
    # (K,) float64 standard deviation of ranges on the plane, relative to them
    uncertainties: NDArray[np.float64]
    group_idx: NDArray[np.int32]  # (K,) int32 group of the poses in whose world the plane is
    # (M, 4, 3) float64 corners in the world of mirrors; seen from the front, clockwise from the upper left
    mirror_corners: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 4, 3)))
    mirror_group_idx: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))  # (M,) as group_idx

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
        mirrors = require_array(self, "mirror_corners", dtype=np.float64, shape=(None, 4, 3))
        require_array(self, "mirror_group_idx", dtype=np.int32, shape=(len(mirrors),))
        require(bool(positive.all()), self, "an uncertainty is not positive")
        require(bool(np.allclose(np.linalg.norm(normals, axis=1), 1)), self, "a normal is not of unit length")


@dataclass(frozen=True, eq=False)
class SurfaceSamples(Record):
    """Points of the surfaces in one view."""

    axis: ClassVar[Axis | None] = Axis.VIEW

    bearings: NDArray[np.float64]  # (N, 3) float64 unit rays in the view's camera frame
    ranges: NDArray[np.float32]  # (N,) float32 along the rays, scene units
    colors_rgb: NDArray[np.uint8]  # (N, 3) uint8
    confidence: NDArray[np.uint8]  # (N,) uint8, of the range map

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


@dataclass(frozen=True, eq=False)
class TrackedPoints(Record):
    """Points with tracks as in `Poses`, but from range maps."""

    axis: ClassVar[Axis | None] = Axis.ONE

    names: tuple[str, ...]  # (N) names of the images that the tracks refer to
    points_in_world: NDArray[np.float64]  # (P, 3) float64
    colors_rgb: NDArray[np.uint8]  # (P, 3) uint8
    # (P,) float32 mean angle, in the image of whose range map the point is, to the positions from the range maps of the
    # other images of its track
    errors_rad: NDArray[np.float32]
    track_point_idx: NDArray[np.int32]  # (T,) int32: observation t is of this point …
    track_image_idx: NDArray[np.int32]  # (T,) int32: … in this image (a position in `names`) …
    track_bearings: NDArray[np.float64]  # (T, 3) float64: … along this unit ray in the camera frame

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.points_in_world)

    def check(self) -> None:
        """Raise ContractError unless all arrays agree."""
        points, tracks = len(self.points_in_world), len(self.track_point_idx)
        require_array(self, "points_in_world", dtype=np.float64, shape=(points, 3))
        require_array(self, "colors_rgb", dtype=np.uint8, shape=(points, 3))
        require_array(self, "errors_rad", dtype=np.float32, shape=(points,))
        require_array(self, "track_point_idx", dtype=np.int32, shape=(tracks,))
        require_array(self, "track_image_idx", dtype=np.int32, shape=(tracks,))
        require_array(self, "track_bearings", dtype=np.float64, shape=(tracks, 3))
        if tracks:
            require(positions_fit(self.track_point_idx, points), self, "a track has no point")
            require(positions_fit(self.track_image_idx, len(self.names)), self, "a track has no image")

    def joined_to(self, poses: Poses, *, keep_points: bool) -> Poses:
        """Return poses with these points, after their own points or instead of them.

        Tracks in images that the poses do not have are removed. With several groups of poses, points without tracks
        are removed too, since their world is unknown. `track_sigmas_rad` is None, as the new observations
        have none.
        """
        position = {name: idx for idx, name in enumerate(poses.names)}
        image_idx = np.array([position.get(name, -1) for name in self.names], np.int32)[self.track_image_idx]
        known = image_idx >= 0
        placed = np.ones(len(self), np.bool_)
        if len(poses.worlds) > 1:
            placed = np.bincount(self.track_point_idx[known], minlength=len(self)) > 0
        point_idx = (np.cumsum(placed) - 1).astype(np.int32)[self.track_point_idx[known]]
        own = slice(None) if keep_points else slice(0)
        first = len(poses.points_in_world[own])
        return replace(
            poses,
            points_in_world=np.concatenate([poses.points_in_world[own], self.points_in_world[placed]]),
            point_colors_rgb=np.concatenate([poses.point_colors_rgb[own], self.colors_rgb[placed]]),
            point_errors_rad=np.concatenate([poses.point_errors_rad[own], self.errors_rad[placed]]),
            track_point_idx=np.concatenate([poses.track_point_idx[own], point_idx + np.int32(first)]),
            track_image_idx=np.concatenate([poses.track_image_idx[own], image_idx[known]]),
            track_bearings=np.concatenate([poses.track_bearings[own], self.track_bearings[known]]),
            track_sigmas_rad=None,
        )
