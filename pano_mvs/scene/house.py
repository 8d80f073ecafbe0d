"""Where all panoramas of a capture stand in one house."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.scene.record import Axis, Record, require, require_array
from pano_mvs.scene.rooms import OUTLINE_AZIMUTHS, RoomOutline


class PlacedBy(StrEnum):
    """What says where a panorama stands in a house."""

    MATCHES = "matches"
    """It is in the largest part, whose frame and unit are those of the house."""
    LINKS = "links"
    """Links of a tour join its part, or the single panorama, with the largest part."""
    NOTHING = "nothing"
    """It stands beside the house."""


@dataclass(frozen=True, eq=False)
class House(Record):
    """Where all panoramas of a capture stand in one house.

    Its parts are groups of cameras without those that are doubtful, which are single panoramas here. The frame and the
    unit are those of the group of the largest part. Poses within a part are as exact as those of `Poses`; between
    parts, they are only good enough for plans and for walking from room to room.

    Attributes:
        names: (N) names of the images, in the capture's order.
        rotations: (N, 3, 3) float64 of cam_from_house.
        translations: (N, 3) float64 of cam_from_house, units of the house.
        parts: (N,) int32 the part of each image; 0 is the largest.
        groups: (N,) int32 the group of each image in `Poses`; -1 for a single panorama.
        scales: (N,) float64 the unit of the group's world in units of the house; 1 for a single panorama.
        placed_by: (N) what says where it stands, one of `PlacedBy`.
        center_stds: (N,) float64 standard deviation of the position of its part relative to the largest one, units of
            the house; infinite if unknown.
        turn_stds_rad: (N,) float64 likewise of its rotation around the vertical.
        links: (N) names of the panoramas to which links of each one lead.
        camera_height: height of the cameras above the floor in units of the house; None if unknown.
        room_names: (R) names of the images whose rooms are known, see `RoomOutline`, whose fields the others are.
        room_rotations: (R, 3, 3) float64 of cam_from_level.
        room_walls_rad: (R,) float64 azimuths of walls.
        room_ceilings: (R,) float64 heights of the ceilings above the camera, in heights of the camera.
        room_distances: (R, 360) float32 distances of the walls, in heights of the camera; NaN where unknown.
        room_probabilities: (R, 360) float32 probabilities that these are within 5 % of the truth.
    """

    axis: ClassVar[Axis | None] = Axis.ONE

    names: tuple[str, ...]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    parts: NDArray[np.int32]
    groups: NDArray[np.int32]
    scales: NDArray[np.float64]
    placed_by: tuple[str, ...]
    center_stds: NDArray[np.float64]
    turn_stds_rad: NDArray[np.float64]
    links: tuple[tuple[str, ...], ...]
    camera_height: float | None = None
    room_names: tuple[str, ...] = ()
    room_rotations: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3, 3)))
    room_walls_rad: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    room_ceilings: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    room_distances: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, OUTLINE_AZIMUTHS), np.float32))
    room_probabilities: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, OUTLINE_AZIMUTHS), np.float32))

    def with_rooms(self, rooms: Mapping[str, RoomOutline]) -> House:
        """Return the house with the rooms of its panoramas that are known, by image name."""
        known = {name: rooms[name] for name in self.names if name in rooms and rooms[name].ceiling is not None}
        outlines = list(known.values())
        return replace(
            self,
            room_names=tuple(known),
            room_rotations=np.array([one.cam_from_level for one in outlines]).reshape(-1, 3, 3),
            room_walls_rad=np.array([one.wall_rad for one in outlines], np.float64),
            room_ceilings=np.array([one.ceiling for one in outlines], np.float64),
            room_distances=np.array([one.distances for one in outlines], np.float32).reshape(-1, OUTLINE_AZIMUTHS),
            room_probabilities=np.array([one.probabilities for one in outlines], np.float32).reshape(
                -1, OUTLINE_AZIMUTHS
            ),
        )

    @property
    def rooms(self) -> dict[str, RoomOutline]:
        """The rooms of the panoramas whose rooms are known, by image name."""
        return {
            name: RoomOutline(
                np.asarray(self.room_rotations[row]),
                float(self.room_walls_rad[row]),
                float(self.room_ceilings[row]),
                np.asarray(self.room_distances[row]),
                np.asarray(self.room_probabilities[row]),
            )
            for row, name in enumerate(self.room_names)
        }

    def cam_from_house(self, image_idx: int) -> Rigid3:
        """Return the pose of the image at a position in `names`."""
        return Rigid3(np.asarray(self.rotations[image_idx]), np.asarray(self.translations[image_idx]))

    def house_from_world(self, name: str, cam_from_world: Rigid3) -> Similarity3:
        """Return the similarity from the world of a group into the house, by the name and the pose of one camera."""
        idx = self.names.index(name)
        house = self.cam_from_house(idx)
        rotation, scale = house.rotation.T @ cam_from_world.rotation, float(self.scales[idx])
        return Similarity3(scale, rotation, house.center - scale * rotation @ cam_from_world.center)

    def check(self) -> None:
        """Raise ContractError unless all arrays agree."""
        images = len(self.names)
        require(len(set(self.names)) == images, self, "an image is listed twice")
        require(len(self.placed_by) == len(self.links) == images, self, "a field has another length than names")
        require({*self.placed_by} <= {*map(str, PlacedBy)}, self, "placed_by has an unknown value")
        require_array(self, "rotations", dtype=np.float64, shape=(images, 3, 3))
        require_array(self, "translations", dtype=np.float64, shape=(images, 3))
        require_array(self, "parts", dtype=np.int32, shape=(images,))
        require_array(self, "groups", dtype=np.int32, shape=(images,))
        scales = require_array(self, "scales", dtype=np.float64, shape=(images,))
        require(bool((scales > 0).all()), self, "a scale is not positive")
        for name in ("center_stds", "turn_stds_rad"):
            require_array(self, name, dtype=np.float64, shape=(images,), finite=False)
        require(self.camera_height is None or 0 < self.camera_height < np.inf, self, "camera_height is not positive")
        rooms = len(self.room_names)
        require({*self.room_names} <= {*self.names}, self, "a room is of an image that is not listed")
        require(len({*self.room_names}) == rooms, self, "an image has two rooms")
        require_array(self, "room_rotations", dtype=np.float64, shape=(rooms, 3, 3))
        require_array(self, "room_walls_rad", dtype=np.float64, shape=(rooms,))
        require_array(self, "room_ceilings", dtype=np.float64, shape=(rooms,))
        for name in ("room_distances", "room_probabilities"):
            require_array(self, name, dtype=np.float32, shape=(rooms, OUTLINE_AZIMUTHS), finite=False)
        for room in self.rooms.values():
            room.check()
