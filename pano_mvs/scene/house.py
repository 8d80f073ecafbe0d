"""Where all panoramas of a capture stand in one house."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.scene.record import Axis, Record, require, require_array


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
        require(self.camera_height is None or self.camera_height > 0, self, "camera_height is not positive")
