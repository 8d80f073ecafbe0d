"""The frames, without poses, and the files that are exported for one panorama to nerfstudio or in a splat bundle."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any, ClassVar, Literal, Self

import numpy as np

from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Axis, FilePart, Files
from pano_mvs.scene.record import Parts

Variant = Literal["equirectangular", "faces"]


@dataclass(frozen=True, slots=True)
class NerfstudioFrame:
    """One frame without its pose.

    Attributes:
        variant: the transforms.json to which it belongs.
        image: path of the image relative to that file; `{name}` stands for the panorama's name.
        mask: path of the mask; empty if nothing is masked.
        depth: path of the depth; empty without one.
        size_wh: (width, height) in pixels.
        focal_xy: fl_x, fl_y in pixels; the principal point is the image centre.
        frame_from_cam: rotation from the panorama's camera frame (y down, z forward), as three rows.
        normal: path of the normals; empty without any.
        confidence: path of the confidence; empty without one.
        radial: coefficient k1 of the lens's distortion; only photographs have one.
    """

    variant: Variant
    image: str
    mask: str
    depth: str
    size_wh: tuple[int, int]
    focal_xy: tuple[float, float]
    frame_from_cam: tuple[tuple[float, ...], ...]
    normal: str = ""
    confidence: str = ""
    radial: float = 0.0

    def to_json(self) -> dict[str, Any]:
        """Return the frame as a JSON object, without the paths of layers that nerfstudio does not read if empty."""
        optional = ("normal", "confidence", "radial")
        return {key: value for key, value in asdict(self).items() if value or key not in optional}

    def cam_from_world(self, panorama_from_world: Rigid3) -> Rigid3:
        """Return the pose of the frame, from that of its panorama."""
        return Rigid3(np.array(self.frame_from_cam), np.zeros(3)) @ panorama_from_world

    @staticmethod
    def from_json(value: Mapping[str, Any]) -> NerfstudioFrame:
        """Return the frame that `to_json` gave."""
        rows = tuple(tuple(map(float, row)) for row in value["frame_from_cam"])
        size, focal = tuple(value["size_wh"]), tuple(value["focal_xy"])
        return NerfstudioFrame(**{**value, "size_wh": size, "focal_xy": focal, "frame_from_cam": rows})


@dataclass(frozen=True, eq=False)
class PanoramaFrames(Files):
    """The frames of one panorama, with their files.

    Attributes:
        pictures: target to source file of images that are exported unchanged.
        frames: the entries of transforms.json without poses.
        depth_unit: scene units of one step of the depths.
    """

    axis: ClassVar[Axis | None] = Axis.IMAGE

    pictures: Mapping[str, FilePart] = field(default_factory=dict)
    frames: tuple[NerfstudioFrame, ...] = ()
    depth_unit: float = 0.001

    def to_parts(self) -> Parts:
        """Return the files under numbers, their targets and the frames as JSON."""
        parts = {target: FilePart(path) for target, path in self.files.items()} | dict(self.pictures)
        targets = sorted(parts)
        meta = {
            "targets": targets,
            "pictures": sorted(self.pictures),
            "frames": [frame.to_json() for frame in self.frames],
            "depth_unit": self.depth_unit,
        }
        return {"meta": meta, **{str(number): parts[target] for number, target in enumerate(targets)}}

    @classmethod
    def from_parts(cls, parts: Parts) -> Self:
        """Return the frames that `to_parts` gave."""
        meta = parts["meta"]
        assert isinstance(meta, dict)
        files = {target: parts[str(number)] for number, target in enumerate(meta["targets"])}
        given = {target: part for target, part in files.items() if isinstance(part, FilePart)}
        return cls(
            {target: part.path for target, part in given.items() if target not in meta["pictures"]},
            {target: given[target] for target in meta["pictures"]},
            tuple(NerfstudioFrame.from_json(frame) for frame in meta["frames"]),
            float(meta["depth_unit"]),
        )


@dataclass(frozen=True, eq=False)
class NerfstudioFrames(PanoramaFrames):
    """The frames of one panorama for nerfstudio."""


@dataclass(frozen=True, eq=False)
class SplatFrames(PanoramaFrames):
    """The frames of one panorama for a splat bundle."""
