"""One equirectangular picture, by reference to its file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.scene.cropping import inside_crop, placed_picture, same_shape
from pano_mvs.scene.image_files.decoding import MASK_BYTES_PER_PIXEL, MAX_PIXELS, decoding_bytes_per_pixel
from pano_mvs.scene.image_files.image_file import decode_image, write_png
from pano_mvs.scene.masking import decode_mask, painted_over, placed_mask
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
        mask_file: a picture, 0 where the panorama must be ignored, or None. It covers what the picture covers, at any
            resolution, or the whole sphere: its shape tells, and of a crop twice as wide as high only a mask of
            source_size_hw covers the sphere.
        nadir_deg: everything closer than this to the straight down direction is ignored (tripod, operator).
        zenith_deg: likewise around the straight up direction.
        up_in_cam: the direction away from gravity as the camera's own sensors saw it, unit (3,), or None.
        heading_deg: compass heading of the picture's centre, or None.
        position_lla: (latitude deg, longitude deg, altitude m) from GPS, or None.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE
    kind_version: ClassVar[int] = 2  # what is masked is not shown

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

    def loading_bytes(self) -> int:
        """Return the memory that `load` and `load_mask` take for a moment: the files at their own resolution."""
        _, _, width, height = self.covers_ltwh
        masked = 0
        if self.mask_file is not None:  # a stage's mask, which the store keeps, has the working resolution
            masked = height * width if self.mask_file.external else self.size_hw[0] * self.size_hw[1]
        return max(height * width * decoding_bytes_per_pixel(self.image.path), masked * MASK_BYTES_PER_PIXEL)

    def load(self) -> NDArray[np.uint8]:
        """Return the picture at working resolution, (H, W, 3) uint8 RGB, without what is masked.

        Masked pixels, and those that a cropped file does not have, show the colours of what is around them
        (`painted_over`): nothing that a stage makes of the picture depends on what they showed.

        Raises:
            ChangedFileError: if the file, or its mask, has changed since the run listed it.
            InputError: if one of them is gone, truncated or no picture, or has changed its size.
        """
        picture, valid = self.load_unmasked(), self.load_mask()
        return picture if valid.all() else painted_over(picture, valid)

    def load_unmasked(self) -> NDArray[np.uint8]:
        """Return the picture as it was taken, with all that is masked, (H, W, 3) uint8 RGB: for people to look at.

        Where a cropped file has nothing it is black.

        Raises:
            InputError: as `load`.
        """
        height, width = self.source_size_hw  # the source has accepted it, perhaps beyond the usual limit
        image = decode_image(self.image.path, self.image.read_bytes(), max_pixels=max(MAX_PIXELS, height * width))
        _, _, width, height = self.covers_ltwh
        if (not same_shape(image.shape[:2], (height, width))) or (
            self.crop_ltwh is None and image.shape[:2] != self.source_size_hw
        ):
            raise InputError(
                f"{self.image.path}: {image.shape[1]}×{image.shape[0]} px, but it had {width}×{height} "
                "when it was listed. Run again to read it anew"
            )
        if self.crop_ltwh is None:
            return _resized(image, self.size_hw)
        return placed_picture(image, self.size_hw, of=self.crop_ltwh, whole_hw=self.source_size_hw)

    def load_mask(self) -> NDArray[np.bool_]:
        """Return the valid pixels at working resolution, (H, W) bool: False is to be ignored by every stage.

        A pixel is valid if no part of it is masked, within the nadir's or the zenith's cut, or outside of the crop.

        Raises:
            ChangedFileError: if the mask file has changed since the run listed it.
            InputError: if it is gone or no picture, or covers neither the sphere nor the crop.
        """
        height = self.size_hw[0]
        valid = np.zeros(self.size_hw, np.bool_)
        valid[inside_crop(self.size_hw, self.covers_ltwh, self.source_size_hw)] = True
        nearest_deg = np.arange(height + 1) * 180 / height  # of the rows' upper edges, from straight up
        valid[(nearest_deg[:-1] < self.zenith_deg) | (nearest_deg[1:] > 180 - self.nadir_deg)] = False
        if self.mask_file is not None:
            mask = decode_mask(self.mask_file.path, self.mask_file.read_bytes())
            valid &= self._placed(mask, f"{self.mask_file.path}: the mask")
        return valid

    def with_mask(self, valid: NDArray[np.bool_], folder: Path) -> Panorama:
        """Return the panorama with more of it to be ignored, besides all that already is.

        Args:
            valid: bool, False is to be ignored: (H, W), or of any other size that a mask file may have.
            folder: where the mask file is written: `ctx.scratch` of a stage.

        Raises:
            InputError: if the size fits neither the sphere nor the crop.
        """
        further = np.asarray(valid, np.bool_)
        keep = self.load_mask() & (
            further if further.shape == self.size_hw else self._placed(further, "a stage's mask")
        )
        if self.crop_ltwh is not None and same_shape(self.size_hw, (self.crop_ltwh[3], self.crop_ltwh[2])):
            height, width = whole = self.source_size_hw  # at working resolution it would be taken for the crop's
            keep = placed_mask(keep, whole, of=(0, 0, width, height), whole_hw=whole)
        path = folder / f"{self.image.path.stem}.mask.png"
        write_png(path, np.where(keep, np.uint8(255), np.uint8(0)))
        return replace(self, mask_file=FilePart(path))

    @property
    def covers_ltwh(self) -> tuple[int, int, int, int]:
        """What the file covers: (left, top, width, height) in source pixels; the whole sphere unless it is cropped."""
        height, width = self.source_size_hw
        return self.crop_ltwh or (0, 0, width, height)

    def _placed(self, mask: NDArray[np.bool_], what: str) -> NDArray[np.bool_]:
        """Return a mask at working resolution; its size, or else its shape, says whether it is of sphere or crop."""
        height, width = self.source_size_hw
        sphere, crop = (0, 0, width, height), self.covers_ltwh
        size = mask.shape[0], mask.shape[1]
        if size == self.source_size_hw:
            covered = sphere
        elif same_shape(size, (crop[3], crop[2])):
            covered = crop
        elif same_shape(size, self.source_size_hw):
            covered = sphere
        else:
            of = f"{width}×{height} px" if crop == sphere else f"a part of {crop[2]}×{crop[3]} px of {width}×{height}"
            raise InputError(
                f"{what} has {size[1]}×{size[0]} px, which is the shape neither of the full sphere nor of the picture "
                f"({self.image.path.name}, {of}). Draw it over the picture itself; its resolution does not matter"
            )
        return placed_mask(mask, self.size_hw, of=covered, whole_hw=self.source_size_hw)


def _resized(image: NDArray[np.uint8], size_hw: tuple[int, int]) -> NDArray[np.uint8]:
    if image.shape[:2] == size_hw:
        return image
    resized: NDArray[np.uint8] = cv2.resize(image, size_hw[::-1], interpolation=cv2.INTER_AREA)
    return resized
