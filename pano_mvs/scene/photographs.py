"""Ordinary photographs whose poses among the panoramas are known."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3
from pano_mvs.scene.record import Axis, Record, require, require_array


@dataclass(frozen=True, eq=False)
class Photographs(Record):
    """Localised photographs, each with a camera of its own: COLMAP's SIMPLE_RADIAL.

    A point (x, y, z) of the camera frame has the pixel f (1 + k r²) (x / z, y / z) + c with r² = (x² + y²) / z², where
    c is the centre of the picture.

    Attributes:
        names: (N) paths of the files, relative to the folder of the photographs' folder.
        sizes_hw: (N, 2) int32 height and width as stored, whatever EXIF says about the orientation.
        focals_px: (N,) float64 focal length f.
        radials: (N,) float64 coefficient k.
        rotations: (N, 3, 3) float64 of cam_from_world.
        translations: (N, 3) float64 of cam_from_world, scene units.
        inliers: (N,) int32 number of key points that agree with the pose.
        errors_px: (N,) float32 median reprojection error of the inliers.
        rejected: name of every photograph that could not be localised, with the reason.
    """

    axis: ClassVar[Axis | None] = Axis.ONE

    names: tuple[str, ...]
    sizes_hw: NDArray[np.int32]
    focals_px: NDArray[np.float64]
    radials: NDArray[np.float64]
    rotations: NDArray[np.float64]
    translations: NDArray[np.float64]
    inliers: NDArray[np.int32]
    errors_px: NDArray[np.float32]
    rejected: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of localised photographs."""
        return len(self.names)

    def check(self) -> None:
        """Raise ContractError unless all arrays agree."""
        count = len(self.names)
        require_array(self, "sizes_hw", dtype=np.int32, shape=(count, 2))
        require_array(self, "focals_px", dtype=np.float64, shape=(count,))
        require_array(self, "radials", dtype=np.float64, shape=(count,))
        require_array(self, "rotations", dtype=np.float64, shape=(count, 3, 3))
        require_array(self, "translations", dtype=np.float64, shape=(count, 3))
        require_array(self, "inliers", dtype=np.int32, shape=(count,))
        require_array(self, "errors_px", dtype=np.float32, shape=(count,))
        require(bool((self.focals_px > 0).all()), self, "focal lengths must be positive")

    def cam_from_world(self, idx: int) -> Rigid3:
        """Return the pose of a photograph."""
        return Rigid3(self.rotations[idx], self.translations[idx])
