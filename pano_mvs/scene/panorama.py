"""One equirectangular picture, by reference to its file."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.scene.image_file import decode_image
from pano_mvs.scene.record import Axis, FilePart, Record, require


@dataclass(frozen=True, eq=False)
class Panorama(Record):
    """One equirectangular picture, decoded on demand.

    Attributes:
        image: the picture's file.
        size_hw: (height, width) of the full sphere at working resolution, width = 2 × height.
        source_size_hw: (height, width) of the full sphere at the file's own resolution.
        crop_ltwh: (left, top, width, height) in source pixels of the part of the sphere that the file holds, if it is
            not all of it (GPano's CroppedArea).
        mask_file: a picture, 0 where the panorama must be ignored, or None.
        nadir_deg: everything closer than this to the straight down direction is ignored (tripod, operator).
        zenith_deg: likewise around the straight up direction.
        up_in_cam: the direction away from gravity as the camera's own sensors saw it, unit (3,), or None.
        heading_deg: compass heading of the picture's centre, or None.
        position_lla: (latitude deg, longitude deg, altitude m) from GPS, or None.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE

    image: FilePart
    size_hw: tuple[int, int]
    source_size_hw: tuple[int, int]
    crop_ltwh: tuple[int, int, int, int] | None = None
    mask_file: FilePart | None = None
    nadir_deg: float = 0.0
    zenith_deg: float = 0.0
    up_in_cam: tuple[float, float, float] | None = None
    heading_deg: float | None = None
    position_lla: tuple[float, float, float] | None = None

    def check(self) -> None:
        """Raise ContractError unless the sizes are those of full spheres."""
        height, width = self.size_hw
        require(width == 2 * height and height > 0, self, f"size_hw {self.size_hw} is not that of a full sphere")

    def load(self) -> NDArray[np.uint8]:
        """Return the picture at working resolution, (H, W, 3) uint8 RGB; black where a cropped file has nothing.

        Raises:
            InputError: if the file is gone, truncated or no picture.
        """
        image = decode_image(self.image.path)
        if self.crop_ltwh is not None:
            left, top, width, height = self.crop_ltwh
            sphere = np.zeros((*self.source_size_hw, 3), np.uint8)
            sphere[top : top + height, left : left + width] = image
            image = sphere
        if image.shape[:2] != self.source_size_hw:
            raise InputError(f"{self.image.path}: {image.shape[1]}×{image.shape[0]} px, but it had "
                             f"{self.source_size_hw[1]}×{self.source_size_hw[0]} when it was listed. "
                             "Run again to read it anew")  # fmt: skip
        return _resized(image, self.size_hw)

    def load_mask(self) -> NDArray[np.bool_]:
        """Return the valid pixels at working resolution, (H, W) bool: False is to be ignored by every stage."""
        height, width = self.size_hw
        valid = np.ones((height, width), np.bool_)
        elevation_deg = 90 - (np.arange(height) + 0.5) * 180 / height
        valid[(elevation_deg < self.nadir_deg - 90) | (elevation_deg > 90 - self.zenith_deg)] = False
        if self.crop_ltwh is not None:
            left, top, crop_width, crop_height = self.crop_ltwh
            inside = np.zeros(self.source_size_hw, np.uint8)
            inside[top : top + crop_height, left : left + crop_width] = 255
            valid &= _resized(inside, self.size_hw) == 255
        if self.mask_file is not None:
            mask = decode_image(self.mask_file.path).max(axis=-1)
            valid &= cv2.resize(mask, (width, height), interpolation=cv2.INTER_NEAREST) > 0
        return valid


def _resized(image: NDArray[np.uint8], size_hw: tuple[int, int]) -> NDArray[np.uint8]:
    if image.shape[:2] == size_hw:
        return image
    resized: NDArray[np.uint8] = cv2.resize(image, size_hw[::-1], interpolation=cv2.INTER_AREA)
    return resized
