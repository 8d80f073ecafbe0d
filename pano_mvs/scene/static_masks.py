"""What moves with the cameras of a capture, as masks in the camera frame."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.scene.panorama import Panorama
from pano_mvs.scene.record import Axis, Record, require, require_array

Camera: TypeAlias = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class StaticMasks(Record):
    """The content that stays in place in the images while the world moves: tripod, rig, stick, hand.

    Attributes:
        pixels: (G, h, 2 h) uint8, one mask for each camera in which something was found: 1 where it is.
        cameras: the camera of each mask, see `camera_of`.
    """

    axis: ClassVar[Axis | None] = Axis.ONE

    pixels: NDArray[np.uint8]
    cameras: tuple[Camera, ...] = ()

    def check(self) -> None:
        """Raise ContractError unless there is one mask of a full sphere for each camera."""
        pixels = require_array(self, "pixels", dtype=np.uint8, shape=(len(self.cameras), None, None))
        require(pixels.shape[2] == 2 * pixels.shape[1], self, "the masks are not of full spheres")
        require(not pixels.size or int(pixels.max()) <= 1, self, "pixels are 0 or 1")

    def of(self, panorama: Panorama) -> NDArray[np.bool_] | None:
        """Return the pixels of a panorama that move with its camera, (H, W) bool at working resolution, or None."""
        camera = camera_of(panorama)
        if camera not in self.cameras:
            return None
        height, width = panorama.size_hw
        mask = self.pixels[self.cameras.index(camera)].astype(np.float32)
        wrapped = np.concatenate([mask[:, -1:], mask, mask[:, :1]], axis=1)  # so that the seam is interpolated as well
        columns = (np.arange(width, dtype=np.float32) + 0.5) * mask.shape[1] / width + 0.5
        rows = (np.arange(height, dtype=np.float32) + 0.5) * mask.shape[0] / height - 0.5
        at_xy = np.meshgrid(columns, np.clip(rows, 0, mask.shape[0] - 1))
        return np.asarray(cv2.remap(wrapped, at_xy[0], at_xy[1], cv2.INTER_LINEAR) >= 0.5)


def camera_of(panorama: Panorama) -> Camera:
    """Return what identifies a camera: the sizes of the sphere in its file and here, and the part that it covers."""
    return (*panorama.source_size_hw, *panorama.covers_ltwh, *panorama.size_hw)
