"""Frames for trainers: the files of one panorama, and the transforms.json that lists them with poses.

Shared by export.nerfstudio and export.splat_bundle, whose folders differ in name and in the layers that they contain.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.faces.layout import Face, panorama_faces
from pano_mvs.algorithms.faces.render import face_confidence, face_image, face_mask, face_normals, face_z_depth
from pano_mvs.api import (
    Context,
    FilePart,
    InputError,
    Panorama,
    Params,
    PointCloud,
    Poses,
    arguments_from,
    params_from,
    write_png,
)
from pano_mvs.core.text import plural
from pano_mvs.geometry import Rigid3
from pano_mvs.io.colmap.workspace import write_picture
from pano_mvs.io.ply import write_ply
from pano_mvs.io.point_selection import Selection, select_points
from pano_mvs.io.ranges import write_confidence_png, write_normals_png, write_range_png
from pano_mvs.io.transforms_json import (
    NerfstudioFrame,
    PanoramaFrames,
    Variant,
    is_common_picture,
    open_mask,
    transforms_document,
)
from pano_mvs.scene.files import group_file
from pano_mvs.scene.photographs import Photographs
from pano_mvs.scene.pose_groups import split_groups

PosedFrame = tuple[str, Rigid3, NerfstudioFrame]
_NO_TURN = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


@params_from(panorama_faces)
class _CutParams(Params):
    variants: tuple[Variant, ...] = Field(
        default=("equirectangular", "faces"), min_length=1, description="whole panoramas, pinhole faces, or both"
    )


class FramesParams(_CutParams):
    """Settings of stages that write the frames of one panorama."""

    image_format: Literal["jpg", "png"] = Field(
        default="jpg", description="format of images that are not copied unchanged"
    )
    depth_unit: float = Field(
        default=0.001, gt=0, description="scene units per step of the 16-bit depths; pass other values to nerfstudio"
    )
    min_confidence: int = Field(default=64, ge=0, le=255, description="minimum confidence of depths")


class SeedParams(Params):
    """Settings of stages that list frames with poses and initial points."""

    seed_points: int = Field(
        default=500_000, ge=0, description="initial points for splats, thinned evenly from the cloud; 0: none"
    )
    min_views: int = Field(
        default=2, ge=0, le=255, description="minimum number of views that agree on an initial point"
    )


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """What is known about a panorama besides its colours; only `valid` is always known."""

    valid: NDArray[np.bool_]  # (H, W) bool, False is masked
    ranges: NDArray[np.float32] | None = None  # (H, W) float32, NaN unknown
    normals_in_cam: NDArray[np.float32] | None = None  # (H, W, 3) float32, NaN unknown
    confidence: NDArray[np.uint8] | None = None  # (H, W) uint8, 0 unknown


class FrameFiles:
    """The files of one panorama below a folder of the output."""

    def __init__(self, root: str, params: FramesParams, ctx: Context) -> None:
        self.root = root
        self.params = params
        self.ctx = ctx
        self.files: dict[str, Path] = {}
        self.pictures: dict[str, FilePart] = {}
        self.frames: list[NerfstudioFrame] = []
        self.beyond = 0
        self.depths = 0

    def add(self, image: Panorama, picture: NDArray[np.uint8], layers: Layers) -> None:
        """Write all variants that the settings name, and report depths that 16 bits do not hold."""
        if "equirectangular" in self.params.variants:
            self._add_panorama(image, picture, layers)
        if "faces" in self.params.variants:
            for face in panorama_faces(image.size_hw, **arguments_from(panorama_faces, self.params)):
                self._add_face(face, picture, layers)
        share = self.beyond / self.depths if self.depths else 0.0
        self.ctx.metric("beyond_depth", share)
        if share > 0.01:
            unit = self.params.depth_unit
            self.ctx.note(
                f"some depths exceed the {65535 * unit:g} scene units that 16 bits hold in steps of {unit:g}, and are "
                "left out; use a larger depth_unit to include them"
            )

    def _add_panorama(self, image: Panorama, picture: NDArray[np.uint8], layers: Layers) -> None:
        height, width = image.size_hw
        whole = image.crop_ltwh is None and image.size_hw == image.source_size_hw
        path, suffix = "images/{name}", f".{self.params.image_format}"
        if whole and layers.valid.all() and is_common_picture(image.image.path):
            self.pictures[f"{self.root}/equirectangular/{path}"] = image.image
        else:
            path += suffix
            write_picture(self._file("equirectangular", path, suffix), picture)
        camera = {"size_wh": (width, height), "focal_xy": (width / 2, float(height)), "frame_from_cam": _NO_TURN}
        self._add_layers("equirectangular", "{name}", layers, image=path, **camera)

    def _add_face(self, face: Face, picture: NDArray[np.uint8], layers: Layers) -> None:
        view, suffix = face.view, f".{self.params.image_format}"
        name = f"{{name}}.{face.name}"
        path = f"images/{name}{suffix}"
        write_picture(self._file("faces", path, suffix), face_image(picture, view))
        seen = _seen_by(face, layers, threads=self.ctx.threads)
        turn = tuple(tuple(map(float, row)) for row in view.view_from_cam)
        focal = (view.focal_px, view.focal_px)
        self._add_layers(
            "faces", name, seen, image=path, size_wh=view.size_hw[::-1], focal_xy=focal, frame_from_cam=turn
        )

    def _add_layers(self, variant: Variant, name: str, layers: Layers, **frame: Any) -> None:
        """Write mask, depth, normals and confidence where there are any, and add the frame with their paths."""
        paths: dict[str, Any] = {"mask": "", "depth": ""}
        if not layers.valid.all():
            paths["mask"] = f"masks/{name}.png"
            write_png(self._file(variant, paths["mask"]), np.where(layers.valid, np.uint8(255), np.uint8(0)))
        if layers.ranges is not None:
            paths["depth"] = f"depths/{name}.png"
            self.depths += int(np.isfinite(layers.ranges).sum())
            file = self._file(variant, paths["depth"])
            self.beyond += write_range_png(file, layers.ranges, unit=self.params.depth_unit)
        if layers.normals_in_cam is not None:
            paths["normal"] = f"normals/{name}.png"
            write_normals_png(self._file(variant, paths["normal"]), layers.normals_in_cam)
        if layers.confidence is not None:
            paths["confidence"] = f"confidence/{name}.png"
            write_confidence_png(self._file(variant, paths["confidence"]), layers.confidence)
        self.frames.append(NerfstudioFrame(variant, **paths, **frame))

    def _file(self, variant: Variant, path: str, suffix: str = ".png") -> Path:
        """Return where to write the file for a target."""
        file = self.files[f"{self.root}/{variant}/{path}"] = self.ctx.scratch / f"{len(self.files)}{suffix}"
        return file


def _seen_by(face: Face, layers: Layers, *, threads: int) -> Layers:
    """Return the layers of a face: z-depths, and normals in the face's own camera frame."""
    valid = face_mask(layers.valid, face.view)
    if layers.ranges is None:
        return Layers(valid)
    depths = np.where(valid, face_z_depth(layers.ranges, face.view, threads=threads), np.float32(np.nan))
    known = np.isfinite(depths)
    normals = confidence = None
    if layers.normals_in_cam is not None:
        normals = np.where(known[..., None], face_normals(layers.normals_in_cam, face.view), np.float32(np.nan))
    if layers.confidence is not None:
        confidence = np.where(known, face_confidence(layers.confidence, face.view), np.uint8(0))
    return Layers(valid, depths, normals, confidence)


def frames_with_poses(poses: Poses, frames: Mapping[str, PanoramaFrames], ctx: Context) -> Mapping[str, PanoramaFrames]:
    """Return the frames of all registered panoramas, and report those that have no frames."""
    loaded = {name: frames[name] for name in poses.names if name in frames}
    if not loaded:
        raise InputError("no panorama has both a pose and frames: nothing can be listed in transforms.json")
    if len(loaded) < len(poses.names):
        without = len(poses.names) - len(loaded)
        ctx.note(
            f"{without} of {len(poses.names)} registered panoramas {plural(without, 'has', 'have')} no ranges and "
            f"{plural(without, 'is', 'are')} not in transforms.json"
        )
    return loaded


@dataclass(frozen=True, slots=True, eq=False)
class PosedGroup:
    """One group of poses with the frames of its panoramas, its cloud, and photographs in its world."""

    number: int
    poses: Poses
    frames: Mapping[str, PanoramaFrames]
    cloud: PointCloud | None = None
    photographs: Photographs | None = None

    @staticmethod
    def all_of(
        poses: Poses,
        frames: Mapping[str, PanoramaFrames],
        cloud: PointCloud | None,
        *,
        photographs: Photographs | None,
    ) -> list[PosedGroup]:
        """Return all groups of the poses; photographs are in the world of the first."""
        clouds = [] if cloud is None else cloud.groups()
        return [
            PosedGroup(
                number,
                group,
                {name: frames[name] for name in group.names if name in frames},
                clouds[number] if number < len(clouds) else None,
                None if number else photographs,
            )
            for number, group in enumerate(split_groups(poses))
        ]

    @property
    def depth_unit(self) -> float:
        """Scene units of one step of the depths."""
        return next(iter(self.frames.values())).depth_unit

    def listed(self) -> dict[Variant, list[tuple[str, NerfstudioFrame]]]:
        """Return the frames of each variant, in order, with the names of their panoramas."""
        found: dict[Variant, list[tuple[str, NerfstudioFrame]]] = {}
        for name, each in self.frames.items():
            for frame in each.frames:
                found.setdefault(frame.variant, []).append((name, frame))
        return dict(sorted(found.items()))


def write_transforms(
    root: str,
    group: PosedGroup,
    params: SeedParams,
    *,
    ctx: Context,
    file_from_world: NDArray[np.float64] | None = None,
) -> dict[str, Path]:
    """Write transforms.json of each variant and the initial points of a group; return the targets of the files.

    Photographs are listed after the faces, in a file of their own: they have no depths, and a list has depths of all
    frames or of none.

    Args:
        root: folder of the variants in the output folder.
        file_from_world: rotation (3, 3) of cameras and points; None: they stay in the world of the poses.
    """
    files: dict[str, Path] = {}
    scratch = ctx.scratch / str(group.number)
    scratch.mkdir()
    poses = group.poses
    seed = _write_seed(group, params, ctx=ctx, file_from_world=file_from_world)
    seed_name = "" if seed is None else group_file("seed.ply", group.number)
    cameras = poses.cameras

    def write(name: str, variant: Variant, frames: list[PosedFrame], **about: str) -> None:
        document = transforms_document(
            variant,
            frames,
            depth_unit=group.depth_unit,
            about=about | {"world_frame": poses.frame},
            file_from_world=file_from_world,
            seed=seed_name,
        )
        path = files[f"{root}/{variant}/{name}"] = scratch / f"{variant}_{name}"
        path.write_text(json.dumps(document, indent=1), encoding="utf-8")
        files.update(_open_masks([frame for *_, frame in frames], f"{root}/{variant}", scratch))

    for variant, listed in group.listed().items():
        frames = [(name, cameras[name], frame) for name, frame in listed]
        unit = "metre" if poses.metric else poses.scale
        write(group_file("transforms.json", group.number), variant, frames, scene_unit=unit)
        if seed is not None:
            files[f"{root}/{variant}/{seed_name}"] = seed
        ctx.metric(variant, ctx.metrics.get(variant, 0) + len(listed))
        if variant == "faces" and group.photographs is not None and len(group.photographs):
            shown = _listed_photographs(group.photographs)
            files |= {
                f"{root}/faces/{frame.image}": picture.path
                for (*_, frame), picture in zip(shown, group.photographs.pictures, strict=True)
            }
            write("transforms_photographs.json", "faces", frames + shown)
    return files


def _listed_photographs(photographs: Photographs) -> list[PosedFrame]:
    found = []
    for idx, name in enumerate(photographs.names):
        height, width = photographs.sizes_hw[idx].tolist()
        focal, radial = float(photographs.focals_px[idx]), float(photographs.radials[idx])
        frame = NerfstudioFrame(
            "faces", f"images/{name}", "", "", (width, height), (focal, focal), _NO_TURN, radial=radial
        )
        found.append((name, photographs.cam_from_world(idx), frame))
    return found


def _write_seed(
    group: PosedGroup, params: SeedParams, *, ctx: Context, file_from_world: NDArray[np.float64] | None
) -> Path | None:
    """Write the initial points; return None if there are none."""
    poses, cloud, scratch = group.poses, group.cloud, ctx.scratch / str(group.number)
    if cloud is None or not len(cloud):
        count = len(poses.points_in_world)
        cloud = PointCloud(
            poses.points_in_world.astype(np.float32),
            np.zeros((count, 3), np.float32),
            poses.point_colors_rgb,
            np.full(count, 255, np.uint8),
        )
    if not params.seed_points or not len(cloud):
        return None
    selection = Selection(min_views=params.min_views, max_points=params.seed_points)
    kept = select_points(cloud, selection, scratch)
    ctx.metric("seed_points", ctx.metrics.get("seed_points", 0) + (len(cloud) if kept is None else kept.count))
    path = scratch / "seed.ply"
    write_ply(path, cloud, kept=kept, file_from_world=file_from_world)
    return path


def _open_masks(listed: Sequence[NerfstudioFrame], folder: str, scratch: Path) -> dict[str, Path]:
    """Write masks of frames without masked pixels if other frames have masks: nerfstudio needs one for each frame."""
    if not any(frame.mask for frame in listed):
        return {}
    files = {}
    for width, height in {frame.size_wh for frame in listed if not frame.mask}:
        path = files[f"{folder}/{open_mask((width, height))}"] = scratch / f"open_{width}x{height}.png"
        write_png(path, np.full((height, width), 255, np.uint8))
    return files
