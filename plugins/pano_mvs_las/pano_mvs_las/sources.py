"""The stages source.e57 and poses.e57."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from pano_mvs.api import (
    All,
    Context,
    FilePart,
    InputError,
    InputPath,
    Panorama,
    Params,
    Poses,
    Rigid3,
    SourceItem,
    SourcePath,
    decode_image,
    source,
    stage,
)
from pydantic import Field

from pano_mvs_las.e57_panoramas import list_panoramas, read_picture

# Farther from the origin, points in single precision are no longer accurate to a millimetre.
_FAR_M = 10_000.0
_STEP_M = 1000.0


class SourceParams(Params):
    """Settings of source.e57."""

    path: SourcePath = Field(description="the E57 file")
    nadir_deg: float = Field(default=0.0, ge=0, le=90, description="ignore this angle around straight down (tripod)")
    zenith_deg: float = Field(default=0.0, ge=0, le=90, description="ignore this angle around straight up")
    max_width: int = Field(default=4096, ge=16, description="wider panoramas are scaled down to this width")


def list_items(params: SourceParams) -> Iterator[SourceItem]:
    """List the spherical images of an E57 file.

    Raises:
        InputError: if it has fewer than two.
    """
    panoramas, notes = list_panoramas(params.path)
    if len(panoramas) < 2:
        raise InputError(
            f"{params.path}: contains {len(panoramas)} spherical images; depth needs two or more. "
            + " ".join(f"{note}." for note in notes)
            + " Export the panoramas of all stations into it"
        )
    for panorama in panoramas:
        yield SourceItem(panorama.name, {"e57": params.path}, notes=tuple(notes))


@source("source.e57", list_items=list_items, memory="1GB")
def source_e57(item: SourceItem, params: SourceParams, ctx: Context) -> Panorama:
    """Read the panoramas of an E57 file: its spherical images (ASTM E2807, 8.4.14), whole or cropped, with their masks.

    `poses.e57` reads their poses. Images of other kinds, such as those of a scanner's pinhole cameras, are named.
    """
    path = item.file("e57").path
    panorama = next(found for found in list_panoramas(path)[0] if found.name == item.name)
    picture, mask = read_picture(path, item.name)
    kept = ctx.scratch / f"panorama{item.name[item.name.rindex('.') :]}"
    kept.write_bytes(picture)
    height, width = decode_image(kept, picture).shape[:2]
    if (height, width) != panorama.size_hw:
        raise InputError(
            f"{path}: image {item.name} decodes to {width}×{height} px, the file says "
            f"{panorama.size_hw[1]}×{panorama.size_hw[0]}. Export it again"
        )
    mask_file = None
    if mask is not None:
        (ctx.scratch / "mask.png").write_bytes(mask)
        mask_file = FilePart(ctx.scratch / "mask.png")
    working_width = min(panorama.source_size_hw[1], params.max_width) // 4 * 4
    if working_width < 16:
        raise InputError(f"{path}: image {item.name} is too small; a panorama needs at least 16 columns")
    found = Panorama(
        image=FilePart(kept),
        size_hw=(working_width // 2, working_width),
        source_size_hw=panorama.source_size_hw,
        crop_ltwh=panorama.crop_ltwh,
        mask_file=mask_file,
        nadir_deg=params.nadir_deg,
        zenith_deg=params.zenith_deg,
    )
    ctx.metric("valid", float(found.load_mask().mean()))
    return found


class PosesParams(Params):
    """Settings of poses.e57."""

    path: InputPath = Field(description="the E57 file")


@stage("poses.e57")
def poses_e57(images: All[Panorama], params: PosesParams, ctx: Context) -> Poses:
    """Read the poses of the panoramas of an E57 file, which `source.e57` reads; the unit is the metre.

    The world is that of the file. If it is far from its origin, as on a map, whole kilometres are subtracted, and a
    note says how many. Panoramas without a pose are named.
    """
    panoramas, _ = list_panoramas(params.path)
    stated = {panorama.name: panorama.cam_from_world for panorama in panoramas}
    placed = {name: pose for name in images if (pose := stated.get(name)) is not None}
    if len(placed) < 2:
        raise InputError(
            f"{params.path}: has poses of {len(placed)} images of this capture; two or more are needed. Read the "
            "images from the same file (source.e57), or let a preset find the poses"
        )
    rejected = {
        name: f"{params.path.name} has {'no pose of it' if name in stated else 'no image of this name'}"
        for name in images
        if name not in placed
    }
    for name, reason in rejected.items():
        ctx.reject(name, reason)
    ctx.metric("registered", len(placed) / len(images))
    centers = np.array([pose.center for pose in placed.values()])
    if np.ptp(centers, axis=0).max() <= 1e-9 * max(1.0, float(np.abs(centers).max())):
        raise InputError(
            f"{params.path}: all {len(placed)} panoramas are in the same place, as if the poses were not exported; "
            "depth needs different places. Export them again, or let a preset find the poses"
        )
    middle = np.median(centers, axis=0)
    offset = np.where(np.abs(middle) > _FAR_M, np.round(middle / _STEP_M) * _STEP_M, 0.0)
    frame = f"the world of {params.path.name}"
    if offset.any():
        frame += f" minus ({', '.join(f'{value:.0f}' for value in offset)}) m"
        ctx.note(f"the world of the poses is {frame}")
    moved = {name: Rigid3(pose.rotation, -pose.rotation @ (pose.center - offset)) for name, pose in placed.items()}
    return Poses.without_points(moved, rejected=rejected, frame=frame, scale="metres, as E57 has them", metric=True)
