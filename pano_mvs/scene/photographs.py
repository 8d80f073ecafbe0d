"""Ordinary photographs whose poses among the panoramas are known."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3
from pano_mvs.scene.record import Axis, FilePart, Parts, Record, require, require_array


@dataclass(frozen=True, eq=False)
class Photographs(Record):
    """Localised photographs, each with a camera of its own: COLMAP's SIMPLE_RADIAL.

    A point (x, y, z) of the camera frame has the pixel f (1 + k r²) (x / z, y / z) + c with r² = (x² + y²) / z², where
    c is the centre of the picture.
    """

    axis: ClassVar[Axis | None] = Axis.ONE
    kind_version: ClassVar[int] = 2  # since the pictures are part of it

    names: tuple[str, ...]  # (N) paths of the files, relative to the folder of the photographs' folder
    # (N, 2) int32 height and width as stored, whatever EXIF says about the orientation
    sizes_hw: NDArray[np.int32]
    focals_px: NDArray[np.float64]  # (N,) float64 focal length f
    radials: NDArray[np.float64]  # (N,) float64 coefficient k
    rotations: NDArray[np.float64]  # (N, 3, 3) float64 of cam_from_world
    translations: NDArray[np.float64]  # (N, 3) float64 of cam_from_world, scene units
    inliers: NDArray[np.int32]  # (N,) int32 number of key points that agree with the pose
    errors_px: NDArray[np.float32]  # (N,) float32 median reprojection error of the inliers
    pictures: tuple[FilePart, ...] = ()  # (N) the files
    # name of every photograph that could not be localised, with the reason
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
        require(len(self.pictures) == count, self, f"{count} photographs need as many files")
        require(bool((self.focals_px > 0).all()), self, "focal lengths must be positive")

    def to_parts(self) -> Parts:
        """Return the record as arrays and JSON, and the files under their positions."""
        parts = dict(super().to_parts())
        meta = parts["meta"]
        assert isinstance(meta, dict)
        parts["meta"] = {name: value for name, value in meta.items() if name != "pictures"}
        return parts | {f"picture_{idx}": picture for idx, picture in enumerate(self.pictures)}

    @classmethod
    def from_parts(cls, parts: Parts) -> Self:
        """Return the record that `to_parts` gave."""
        files = {name: part for name, part in parts.items() if isinstance(part, FilePart)}
        bare = super().from_parts({name: part for name, part in parts.items() if name not in files})
        return replace(bare, pictures=tuple(files[f"picture_{idx}"] for idx in range(len(files))))

    def cam_from_world(self, idx: int) -> Rigid3:
        """Return the pose of a photograph."""
        return Rigid3(self.rotations[idx], self.translations[idx])
