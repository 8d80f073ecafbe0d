"""The poses of the panoramas, and the sparse points and tracks behind them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import ClassVar, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3
from pano_mvs.scene.record import Axis, Parts, Record, positions_fit, require, require_array


@dataclass(frozen=True, eq=False)
class Pose(Record):
    """The pose of one registered image.

    Attributes:
        cam_from_world: the rigid transform into the camera frame.
        group: number of the group whose world this is (see `Poses.group_idx`). Poses of different groups are
            unrelated.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE

    cam_from_world: Rigid3
    group: int = 0

    def check(self) -> None:
        """Raise ContractError unless the pose is a finite rigid transform."""
        require(self.group >= 0, self, "the number of the group is negative")
        rotation = self.cam_from_world.rotation
        require(bool(np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)), self, "the rotation is not orthonormal")
        require(bool(np.linalg.det(rotation) > 0), self, "the rotation is a reflection (its determinant is negative)")
        require(bool(np.isfinite(self.cam_from_world.translation).all()), self, "the translation is not finite")

    def to_parts(self) -> Parts:
        """Return the pose as one JSON object (floats without loss of precision)."""
        pose = self.cam_from_world
        meta = {"rotation": pose.rotation.tolist(), "translation": pose.translation.tolist()}
        return {"meta": meta | ({"group": self.group} if self.group else {})}

    @classmethod
    def from_parts(cls, parts: Parts) -> Self:
        """Return the pose from the result of `to_parts`."""
        meta = parts["meta"]
        assert isinstance(meta, dict)
        pose = Rigid3(np.array(meta["rotation"], np.float64), np.array(meta["translation"], np.float64))
        return cls(pose, meta.get("group", 0))


PER_CAMERA = ("center_stds", "rotation_stds_rad", "confirmed_shares", "expected_shares", "right_probabilities")
"""Fields of `Poses` that may hold a number for each camera."""


class WorldAxes(StrEnum):
    """What is known of the directions of the axes of a world."""

    UNKNOWN = "unknown"
    LEVEL = "level"
    """y points down along gravity."""
    NORTH = "north"
    """y points down along gravity, z north, and therefore x east."""

    @property
    def is_level(self) -> bool:
        """Whether y is known to point down along gravity."""
        return self is not WorldAxes.UNKNOWN


class World(NamedTuple):
    """The world of one group of cameras.

    Attributes:
        frame: description of the world frame, for readers; nothing is decided by it.
        scale: description of the source of the unit of length.
        metric: whether the unit of length is the metre.
        axes: what is known of the directions of the axes.
        origin_lla: latitude (deg), longitude (deg) and altitude (m) of the origin, with the axes `NORTH` alone; None if
            they are not known.
    """

    frame: str
    scale: str
    metric: bool
    axes: WorldAxes = WorldAxes.UNKNOWN
    origin_lla: tuple[float, float, float] | None = None


@dataclass(frozen=True, eq=False)
class Poses(Record):
    """The poses of all registered images of a capture, with the sparse points and tracks behind them.

    Attributes:
        names: (N) names of the registered images, in the capture's order.
        rotations: (N, 3, 3) float64 of cam_from_world.
        translations: (N, 3) float64 of cam_from_world, scene units.
        points_in_world: (P, 3) float64.
        point_colors_rgb: (P, 3) uint8.
        point_errors_rad: (P,) float32 mean angular reprojection error.
        track_point_idx: (T,) int32: observation t is of this point …
        track_image_idx: (T,) int32: … in this image (a position in `names`) …
        track_bearings: (T, 3) float64: … along this unit ray in the camera frame.
        rejected: name of every image that could not be registered, with the reason.
        frame: description of the world frame; with several groups, of group 0, as `scale`, `metric`, `axes` and
            `origin_lla`, which `World` explains.
        scale: description of the source of the unit of length.
        metric: whether the unit of length is the metre.
        center_stds: (N,) float64 standard deviation of each camera's centre, scene units, relative to the first camera
            and the first baseline, from noise in the rays only; NaN where unknown; None if not computed.
        rotation_stds_rad: (N,) float64, the same for each camera's rotation.
        group_idx: (N,) int32 the group of each camera: 0 is the largest. Cameras of different groups are not connected
            by any reliable pair; each group has a world frame and a unit of length of its own, and no point is seen
            from two groups. None: one group. `pano_mvs.scene.pose_groups` splits and joins groups.
        other_worlds: the worlds of groups 1, 2, …; empty with one group.
        confirmed_shares: (N,) float64 share of each image's textured pixels, by solid angle, whose ranges other images
            confirm in a small sweep with these poses; NaN where too few pixels can be judged; None if not computed.
        expected_shares: (N,) float64 the expected share, from the neighbouring cameras.
        right_probabilities: (N,) float64 probability that each pose is right, by all that was measured about it; NaN
            where nothing was; None if not computed.
        evidence: name of each image to what was measured for and against its pose, by measurement; None where it is
            missing. `pano_mvs.algorithms.poses.verification.belief.evidence` says what is measured.
        doubts: name of every registered image whose pose is doubtful, with the reason.
        track_sigmas_rad: (T,) float32 standard deviation of each observation's ray, positive; the adjustment weighs
            observations by it. None: unknown, equal weights.
        axes: what is known of the directions of the world's axes.
        origin_lla: latitude (deg), longitude (deg) and altitude (m) of the world's origin; None if they are not known.
    """

    axis: ClassVar[Axis | None] = Axis.ONE
    kind_version: ClassVar[int] = 5  # since `axes` and `origin_lla`, which were sentences in `frame`
    explodes_into: ClassVar[type[Record] | None] = Pose

    names: tuple[str, ...]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    points_in_world: NDArray[np.float64]
    point_colors_rgb: NDArray[np.uint8]
    point_errors_rad: NDArray[np.float32]
    track_point_idx: NDArray[np.int32]
    track_image_idx: NDArray[np.int32]
    track_bearings: NDArray[np.float64]
    rejected: dict[str, str]
    frame: str = "the first registered camera"
    scale: str = "the first reference–neighbour baseline is 1"
    metric: bool = False
    center_stds: NDArray[np.float64] | None = None
    rotation_stds_rad: NDArray[np.float64] | None = None
    group_idx: NDArray[np.int32] | None = None
    confirmed_shares: NDArray[np.float64] | None = None
    expected_shares: NDArray[np.float64] | None = None
    right_probabilities: NDArray[np.float64] | None = None
    evidence: dict[str, dict[str, float | None]] = field(default_factory=dict)
    doubts: dict[str, str] = field(default_factory=dict)
    other_worlds: tuple[World, ...] = ()
    track_sigmas_rad: NDArray[np.float32] | None = None
    axes: WorldAxes = WorldAxes.UNKNOWN
    origin_lla: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        """Convert the axes and the worlds, which are stored as text and lists."""
        object.__setattr__(self, "axes", WorldAxes(self.axes))
        others = (World(*world) for world in self.other_worlds)
        object.__setattr__(self, "other_worlds", tuple(one._replace(axes=WorldAxes(one.axes)) for one in others))

    @staticmethod
    def without_points(
        poses: Mapping[str, Rigid3],
        *,
        rejected: Mapping[str, str] | None = None,
        frame: str,
        scale: str,
        metric: bool,
        axes: WorldAxes = WorldAxes.UNKNOWN,
        origin_lla: tuple[float, float, float] | None = None,
    ) -> Poses:
        """Return poses without sparse points, such as poses from a file; see `World` for the last five arguments."""
        count = len(poses)
        return Poses(
            names=tuple(poses),
            rotations=np.array([pose.rotation for pose in poses.values()]).reshape(count, 3, 3),
            translations=np.array([pose.translation for pose in poses.values()]).reshape(count, 3),
            points_in_world=np.zeros((0, 3)),
            point_colors_rgb=np.zeros((0, 3), np.uint8),
            point_errors_rad=np.zeros(0, np.float32),
            track_point_idx=np.zeros(0, np.int32),
            track_image_idx=np.zeros(0, np.int32),
            track_bearings=np.zeros((0, 3)),
            rejected=dict(rejected or {}),
            frame=frame,
            scale=scale,
            metric=metric,
            axes=axes,
            origin_lla=origin_lla,
        )

    def cam_from_world(self, image_idx: int) -> Rigid3:
        """Return the pose of the image at a position in `names`."""
        return Rigid3(np.asarray(self.rotations[image_idx]), np.asarray(self.translations[image_idx]))

    @property
    def cameras(self) -> dict[str, Rigid3]:
        """The cam_from_world of each registered image, by name."""
        return {name: self.cam_from_world(idx) for idx, name in enumerate(self.names)}

    @property
    def centers(self) -> NDArray[np.float64]:
        """The camera centres, (N, 3), in the world."""
        # Subtracted from zero, so that no centre is at -0.0.
        centers: NDArray[np.float64] = 0.0 - np.einsum("nji,nj->ni", self.rotations, self.translations)
        return centers

    @property
    def groups(self) -> NDArray[np.int32]:
        """The group of each camera, (N,); zeros with one group."""
        return np.zeros(len(self.names), np.int32) if self.group_idx is None else self.group_idx

    @property
    def worlds(self) -> tuple[World, ...]:
        """The world of each group, beginning with the largest."""
        return (World(self.frame, self.scale, self.metric, self.axes, self.origin_lla), *self.other_worlds)

    def explode(self) -> Mapping[str, Pose]:
        """Return the pose of each registered image."""
        groups = self.groups.tolist()
        return {name: Pose(self.cam_from_world(idx), groups[idx]) for idx, name in enumerate(self.names)}

    def doubted(self) -> Mapping[str, str]:
        """Return the images whose poses are doubtful, with the reason."""
        return self.doubts

    def check(self) -> None:
        """Raise ContractError unless all arrays agree."""
        images, points, tracks = len(self.names), len(self.points_in_world), len(self.track_point_idx)
        require(len(set(self.names)) == images, self, "an image is listed twice")
        require_array(self, "rotations", dtype=np.float64, shape=(images, 3, 3))
        require_array(self, "translations", dtype=np.float64, shape=(images, 3))
        require_array(self, "points_in_world", dtype=np.float64, shape=(points, 3))
        require_array(self, "point_colors_rgb", dtype=np.uint8, shape=(points, 3))
        require_array(self, "point_errors_rad", dtype=np.float32, shape=(points,))
        require_array(self, "track_point_idx", dtype=np.int32, shape=(tracks,))
        require_array(self, "track_image_idx", dtype=np.int32, shape=(tracks,))
        require_array(self, "track_bearings", dtype=np.float64, shape=(tracks, 3))
        if self.track_sigmas_rad is not None:
            sigmas = require_array(self, "track_sigmas_rad", dtype=np.float32, shape=(tracks,))
            require(bool((sigmas > 0).all()), self, "an observation has a sigma that is not positive")
        for name in PER_CAMERA:
            if getattr(self, name) is not None:
                require_array(self, name, dtype=np.float64, shape=(images,), finite=False)
        placed = all(world.axes is WorldAxes.NORTH for world in self.worlds if world.origin_lla is not None)
        require(placed, self, "a world with origin_lla must have the axes NORTH")
        require(self.doubts.keys() <= set(self.names), self, "an image that is not registered is doubted")
        require(self.evidence.keys() <= set(self.names), self, "there is evidence for an image that is not registered")
        if tracks:
            require(positions_fit(self.track_point_idx, points), self, "a track has no point")
            require(positions_fit(self.track_image_idx, images), self, "a track has no image")
        self._check_groups()

    def _check_groups(self) -> None:
        if self.group_idx is None:
            require(not self.other_worlds, self, "worlds of other groups are given, but no groups")
            return
        groups = require_array(self, "group_idx", dtype=np.int32, shape=(len(self.names),))
        require(bool((groups >= 0).all()), self, "a group has a negative number")
        sizes = np.bincount(groups)
        require(len(sizes) == len(self.worlds), self, f"{len(sizes)} groups, but {len(self.worlds)} worlds")
        require(bool((sizes > 0).all()) and sizes.argmax() == 0, self, "group 0 must be the largest, and none empty")
        seen_from = groups[self.track_image_idx]
        first = np.full(len(self.points_in_world), -1, np.int32)
        first[self.track_point_idx] = seen_from
        require(bool((first[self.track_point_idx] == seen_from).all()), self, "a point is seen from two groups")
