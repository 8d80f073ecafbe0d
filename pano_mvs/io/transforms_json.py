"""The frames, without poses, and the files that are exported for one panorama to nerfstudio or in a splat bundle."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Axis, FilePart, Files
from pano_mvs.scene.image_header import JPEG_FRAMES, JPEG_START, PNG_START, jpeg_segments
from pano_mvs.scene.photographs import Photographs
from pano_mvs.scene.record import Parts

Variant = Literal["equirectangular", "faces"]


@dataclass(frozen=True, slots=True)
class NerfstudioFrame:
    """One frame without its pose."""

    variant: Variant  # the transforms.json to which it belongs
    image: str  # path of the image relative to that file; `{name}` stands for the panorama's name
    mask: str  # path of the mask; empty if nothing is masked
    depth: str  # path of the depth; empty without one
    size_wh: tuple[int, int]  # (width, height) in pixels
    focal_xy: tuple[float, float]  # fl_x, fl_y in pixels; the principal point is the image centre
    # rotation from the panorama's camera frame (y down, z forward), as three rows
    frame_from_cam: tuple[tuple[float, ...], ...]
    normal: str = ""  # path of the normals; empty without any
    confidence: str = ""  # path of the confidence; empty without one
    radial: float = 0.0  # coefficient k1 of the lens's distortion; only photographs have one

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
        return _FRAME.validate_python(value)


_FRAME = TypeAdapter(NerfstudioFrame)


@dataclass(frozen=True, eq=False)
class PanoramaFrames(Files):
    """The frames of one panorama, with their files."""

    axis: ClassVar[Axis | None] = Axis.IMAGE

    # target to source file of images that are exported unchanged
    pictures: Mapping[str, FilePart] = field(default_factory=dict)
    frames: tuple[NerfstudioFrame, ...] = ()  # the entries of transforms.json without poses
    depth_unit: float = 0.001  # scene units of one step of the depths

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


CAMERA_MODELS = {"equirectangular": "EQUIRECTANGULAR", "faces": "PINHOLE"}
_DISTORTED = "OPENCV"
_DEPTHS = {"equirectangular": "distance along the ray", "faces": "z, along the camera's axis"}


def transforms_document(
    variant: Variant,
    frames: Sequence[tuple[str, Rigid3, NerfstudioFrame]],
    *,
    depth_unit: float,
    about: Mapping[str, Any] = MappingProxyType({}),
    file_from_world: NDArray[np.float64] | None = None,
    seed: str = "",
) -> dict[str, Any]:
    """Return the contents of a transforms.json.

    Intrinsics are stated once if all frames share them, otherwise per frame. If some frames have masks, the others have
    the mask of `open_mask`. `panorama` is the name of the image in the capture, which our own reader uses.

    Args:
        variant: the camera model; a file has only one.
        frames: frames with their panorama's name and cam_from_world.
        depth_unit: scene units per step of the depths.
        about: further entries for readers, which nerfstudio ignores.
        file_from_world: rotation (3, 3) of the cameras, which the file states; None: they stay in the world frame.
        seed: path of the initial points relative to the file; empty without points.
    """
    if file_from_world is not None:
        world_from_file = Rigid3(file_from_world.T, np.zeros(3))
        frames = [(name, cam_from_world @ world_from_file, frame) for name, cam_from_world, frame in frames]
    masked = any(frame.mask for _, _, frame in frames)
    with_depth = all(frame.depth for _, _, frame in frames)
    listed = [_listed(*each, masked=masked, with_depth=with_depth) for each in frames]
    each_intrinsics = [_intrinsics(frame) for _, _, frame in frames]
    if all(intrinsics == each_intrinsics[0] for intrinsics in each_intrinsics):
        common = each_intrinsics[0]
    else:
        common = {}
        listed = [intrinsics | entry for intrinsics, entry in zip(each_intrinsics, listed, strict=True)]
    model = _DISTORTED if any(frame.radial for _, _, frame in frames) else CAMERA_MODELS[variant]
    document = {"camera_model": model, **common, "applied_transform": np.eye(4)[:3].tolist(), **about}
    if file_from_world is not None:
        document["file_from_world"] = file_from_world.tolist()
    if with_depth:
        document |= {"depth_unit_scale_factor": depth_unit, "depth": _DEPTHS[variant]}
    return document | ({"ply_file_path": seed} if seed else {}) | {"frames": listed}


def open_mask(size_wh: tuple[int, int]) -> str:
    """Return the path, relative to a transforms.json, of the mask of frames of a size without masked pixels."""
    return f"masks/none_{size_wh[0]}x{size_wh[1]}.png"


def is_common_picture(path: Path) -> bool:
    """Return whether a file is a JPEG or an 8-bit PNG with three channels, which every trainer can read.

    A JPEG with four channels is CMYK, which trainers would read as red, green, blue and alpha.
    """
    with path.open("rb") as stream:
        start = stream.read(26)
        if start[:2] == JPEG_START:
            data = start + stream.read()
            frame = next((at for marker, at, _ in jpeg_segments(data) if marker in JPEG_FRAMES), None)
            return frame is not None and data[frame + 5] == 3  # channels (ITU-T T.81, B.2.2)
    return start[:8] == PNG_START and start[24:26] == bytes([8, 2])  # 8 bits, RGB


def _listed(
    name: str, cam_from_world: Rigid3, frame: NerfstudioFrame, *, masked: bool, with_depth: bool
) -> dict[str, Any]:
    world_from_frame = frame.cam_from_world(cam_from_world).inverse()
    matrix = np.eye(4)
    matrix[:3, :3] = world_from_frame.rotation @ np.diag([1.0, -1.0, -1.0])  # from OpenGL's camera frame
    matrix[:3, 3] = world_from_frame.translation
    entry: dict[str, Any] = {"file_path": frame.image.replace("{name}", name)}
    if masked:
        entry["mask_path"] = frame.mask.replace("{name}", name) or open_mask(frame.size_wh)
    if with_depth:
        entry["depth_file_path"] = frame.depth.replace("{name}", name)
    return entry | {"panorama": name, "transform_matrix": matrix.tolist()}


def _intrinsics(frame: NerfstudioFrame) -> dict[str, Any]:
    width, height = frame.size_wh
    return {
        "w": width,
        "h": height,
        "fl_x": frame.focal_xy[0],
        "fl_y": frame.focal_xy[1],
        "cx": width / 2,
        "cy": height / 2,
    } | ({"k1": frame.radial} if frame.radial else {})


ROOT = "splat_bundle"  # folder of the bundle in the output folder

_MANIFEST_DEPTHS = {"equirectangular": "range along the ray", "faces": "z-depth"}
_CONVENTIONS = {
    "camera": "x right, y down, z forward (as in OpenCV and COLMAP); transforms.json has OpenGL's axes instead",
    "cam_from_world": "x_in_cam = R x_in_world + t, as the rows [R | t]",
    "pixel": "(0, 0) is the upper left corner of the first pixel, whose centre is (0.5, 0.5)",
    "ray": {
        "PINHOLE": "((x - cx) / fx, (y - cy) / fy, 1)",
        "EQUIRECTANGULAR": "(cos(v) sin(u), -sin(v), cos(v) cos(u)) with u = 2 pi (x / width - 1/2) and "
        "v = pi (1/2 - y / height)",
    },
    "depth": {
        "z-depth": "a point is z-depth times the PINHOLE ray, which has z = 1",
        "range along the ray": "a point is range times the EQUIRECTANGULAR ray, which has length 1",
    },
}


@dataclass(frozen=True, slots=True)
class BundleView:
    """One image of a bundle."""

    panorama: str
    group: int
    frame: NerfstudioFrame
    cam_from_world: Rigid3


def manifest_document(
    views: Sequence[BundleView],
    groups: Sequence[Mapping[str, Any]],
    *,
    depth_unit: float,
    photographs: Photographs | None = None,
) -> dict[str, Any]:
    """Return the contents of manifest.json.

    Args:
        groups: by number: frame and unit of the world, and the files of each variant.
        depth_unit: scene units per step of the depths.
        photographs: photographs without distortion beside the faces, in the world of group 0.
    """
    masked = {view.frame.variant for view in views if view.frame.mask}
    document = {
        "schema": 1,
        "program": "pano_mvs",
        "conventions": _CONVENTIONS,
        "layers": {
            "depth": {"format": "16-bit PNG", "unit": depth_unit, "of": "scene units per step", "unknown": 0},
            "normal": {
                "format": "16-bit PNG, RGB",
                "value": "(step - 1) / 65534 * 2 - 1 for x, y, z in the axes of the camera; towards the camera",
                "unknown": [0, 0, 0],
            },
            "confidence": {
                "format": "8-bit PNG",
                "value": "1 the pane of a mirror, 2 of a window, 3-63 filled in, 64-127 seen but not confirmed, "
                "128-255 consistent with other views",
                "unknown": 0,
            },
            "mask": {"format": "8-bit PNG", "used": 255, "ignored": 0},
        },
        "groups": list(groups),
        "views": [_entry(view, masked) for view in views],
    }
    if photographs is not None:
        document["photographs"] = [
            _photograph(photographs, idx, masked="faces" in masked) for idx in range(len(photographs))
        ]
    return document


def _entry(view: BundleView, masked: Iterable[Variant]) -> dict[str, Any]:
    """Return the entry of one image. Files are relative to the manifest's folder; null if there is no such file."""
    frame, pose = view.frame, view.cam_from_world
    mask = frame.mask or (open_mask(frame.size_wh) if frame.variant in masked else "")
    files = {
        "image": frame.image,
        "mask": mask,
        "depth": frame.depth,
        "normal": frame.normal,
        "confidence": frame.confidence,
    }
    camera: dict[str, Any] = {"model": CAMERA_MODELS[frame.variant], "width": frame.size_wh[0]}
    camera["height"] = frame.size_wh[1]
    if frame.variant == "faces":
        camera |= {"fx": frame.focal_xy[0], "fy": frame.focal_xy[1]}
        camera |= {"cx": frame.size_wh[0] / 2, "cy": frame.size_wh[1] / 2}
    placed = {
        key: f"{frame.variant}/{path.replace('{name}', view.panorama)}" if path else None for key, path in files.items()
    }
    return {
        "variant": frame.variant,
        "panorama": view.panorama,
        "group": view.group,
        **placed,
        "depth_semantics": _MANIFEST_DEPTHS[frame.variant] if frame.depth else None,
        "camera": camera,
        "cam_from_world": np.column_stack([pose.rotation, pose.translation]).tolist(),
    }


def _photograph(photographs: Photographs, idx: int, *, masked: bool) -> dict[str, Any]:
    """Return the entry of a photograph, which has no layers."""
    height, width = photographs.sizes_hw[idx].tolist()
    focal, pose = float(photographs.focals_px[idx]), photographs.cam_from_world(idx)
    size = {"width": width, "height": height}
    return {
        "variant": "faces",
        "group": 0,
        "image": f"faces/images/{photographs.names[idx]}",
        "mask": f"faces/{open_mask((width, height))}" if masked else None,
        "camera": {"model": "PINHOLE", **size, "fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2},
        "cam_from_world": np.column_stack([pose.rotation, pose.translation]).tolist(),
    }
