"""Panoramas from the pictures of two calibrated fisheye lenses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.algorithms.stitching import stitch_lenses
from pano_mvs.api import (
    NOT_IN_KEY,
    Context,
    FilePart,
    InputError,
    Panorama,
    Params,
    SourceItem,
    SourcePath,
    source,
)
from pano_mvs.geometry import LensRig
from pano_mvs.io.images.captures import Layout, RigPictures, list_rig_pictures
from pano_mvs.io.images.metadata import position_from_exif, read_container
from pano_mvs.io.images.names import printable_name
from pano_mvs.io.rig_calibration import read_rig
from pano_mvs.scene.image_file import MAX_PIXELS, decode_image, decoding_bytes_per_pixel, readable_pixels, write_png
from pano_mvs.stages.source import working_size

_NO_CALIBRATION = (
    "calibration is not given. Estimate it from the pictures: pano-mvs calibrate {folder} --out rig.yaml, then --set "
    "images.calibration=rig.yaml. If the camera was calibrated with another program, give its numbers as a YAML file "
    "(docs/rigs.md); or export the images as panorama with the camera maker's program (stitching) and use source.folder"
)


class DualFisheyeParams(Params):
    """Settings of source.dual_fisheye."""

    path: SourcePath = Field(description="folder of the fisheye pictures, searched recursively")
    calibration: SourcePath | None = Field(
        default=None,
        description="YAML file with the parameters of both lenses and their poses, see pano-mvs calibrate; required",
    )
    layout: Annotated[Layout, NOT_IN_KEY] = Field(
        default="auto",
        description=(
            "side_by_side: both circles in one file, the first lens on the left; folders: front/000.jpg, back/000.jpg; "
            "suffixes: 000_front.jpg, 000_back.jpg, with the names of the lenses in the calibration"
        ),
    )
    stitch_distance_m: float | None = Field(
        default=3.0, gt=0, description="distance at which both lenses agree at the seam, in metres; null: infinite"
    )
    blend_deg: float = Field(
        default=2.0, ge=0, le=90, description="width of the strip at the seam where both are mixed"
    )
    width: int | None = Field(
        default=None, ge=16, description="width of the panoramas; by default that of the lenses at their axes"
    )
    max_width: int = Field(default=4096, ge=16, description="maximum width of the panoramas if width is not given")
    nadir_deg: float = Field(default=0.0, ge=0, le=90, description="ignore this angle around straight down (stick)")
    zenith_deg: float = Field(default=0.0, ge=0, le=90, description="ignore this angle around straight up")
    max_megapixels: Annotated[float, NOT_IN_KEY] = Field(
        default=MAX_PIXELS / 1e6, gt=0, description="larger files are rejected before they are decoded"
    )

    def rig(self, calibration: FilePart) -> LensRig:
        """Return the rig of a calibration file."""
        distance = float("inf") if self.stitch_distance_m is None else self.stitch_distance_m
        return read_rig(calibration, stitch_distance_m=distance, blend_deg=self.blend_deg)


def list_captures(params: DualFisheyeParams) -> Iterator[SourceItem]:
    """List the captures in a folder.

    Raises:
        InputError: if there is no calibration, it cannot be used, or there are fewer than two captures.
    """
    if params.calibration is None:
        raise InputError(_NO_CALIBRATION.format(folder=params.path))
    notes: list[str] = []
    rig = params.rig(FilePart(params.calibration))
    captures = list_rig_pictures(params.path, rig.names, params.layout, notes=notes)
    complete = [capture for capture in captures if not capture.problem]
    if len(complete) < 2:
        reason = next((f" ({capture.name}: {capture.problem})" for capture in captures if capture.problem), "")
        raise InputError(
            f"{params.path}: contains {len(complete)} complete captures of both lenses{reason}; depth needs two or "
            "more, taken from different positions"
        )
    for capture in captures:
        name, problem = printable_name(capture.name)
        yield SourceItem(
            name, _files(capture) | {"calibration": params.calibration}, capture.problem or problem, (*notes,)
        )


def stitching_memory_bytes(params: DualFisheyeParams, inputs: Mapping[str, Any]) -> int:
    """Return the memory for decoding the pictures of a capture and stitching them, from the headers of the files."""
    item: SourceItem = inputs["item"]
    decoded = 0
    for role in ("first", "second"):
        if role in item.files:
            pixels = readable_pixels(item.files[role], int(params.max_megapixels * 1e6))
            if pixels == 0:  # the unit will refuse it
                return 0
            decoded += pixels * (decoding_bytes_per_pixel(item.files[role]) + 3)
    columns = params.width or params.max_width
    return 60_000_000 + decoded + 8 * columns**2 // 2 + 40_000 * columns


@source("source.dual_fisheye", list_items=list_captures, memory=stitching_memory_bytes)
def dual_fisheye(item: SourceItem, params: DualFisheyeParams, ctx: Context) -> Panorama:
    """Stitch panoramas from the pictures of two calibrated fisheye lenses.

    Every pixel is looked up in the lens that sees it, at the stitching distance; directions that no lens sees are
    masked. The panorama knows its lenses: poses.refine uses the true ray of each observation, which starts at the
    centre of its lens, and export.colmap also writes a model of the fisheye pictures as a rig.
    """
    rig = params.rig(item.file("calibration"))
    first = item.file("first")
    second = item.file("second") if "second" in item.files else None
    data = first.read_bytes()
    pictures = [_decoded(first, data, params)]
    if second is not None:
        pictures.append(_decoded(second, second.read_bytes(), params))
    natural = round(2 * np.pi * max(max(lens.focal_xy) for lens in rig.lenses))
    width = params.width or min(natural, params.max_width)
    size_hw = working_size((width // 2, width), width)
    picture, valid = stitch_lenses(
        _by_lens(pictures, rig, item, params=params), rig, size_hw=size_hw, threads=ctx.threads
    )
    del pictures
    write_png(ctx.scratch / "panorama.png", picture)
    panorama = Panorama(
        image=FilePart(ctx.scratch / "panorama.png"),
        size_hw=size_hw,
        source_size_hw=size_hw,
        nadir_deg=params.nadir_deg,
        zenith_deg=params.zenith_deg,
        position_lla=position_from_exif(read_container(data).exif),
        rig=rig,
        first_lens=first,
        second_lens=second,
    )
    if not valid.all():
        panorama = panorama.with_mask(valid, ctx.scratch)
    ctx.metric("valid", float(panorama.load_mask().mean()))
    ctx.metric("lens_distance_m", 2 * rig.lens_offset_m)
    return panorama


def _files(capture: RigPictures) -> dict[str, Any]:
    return dict(zip(("first", "second"), capture.files, strict=False))


def _decoded(file: FilePart, data: bytes, params: DualFisheyeParams) -> NDArray[np.uint8]:
    return decode_image(file.path, data, max_pixels=int(params.max_megapixels * 1e6))


def _by_lens(
    pictures: list[NDArray[np.uint8]], rig: LensRig, item: SourceItem, *, params: DualFisheyeParams
) -> list[NDArray[np.uint8]]:
    assert params.calibration is not None
    sizes = [lens.size_hw for lens in rig.lenses]
    if len(pictures) == 2:
        wanted = sizes
    else:
        if sizes[0][0] != sizes[1][0]:
            raise InputError(
                f"{params.calibration}: the pictures of both lenses must have the same height if they are in one file"
            )
        wanted = [(sizes[0][0], sizes[0][1] + sizes[1][1])]
    for role, picture, (height, width) in zip(("first", "second"), pictures, wanted, strict=False):
        if picture.shape[:2] != (height, width):
            raise InputError(
                f"{item.files[role]}: {picture.shape[1]}×{picture.shape[0]} px, but {params.calibration.name} is for "
                f"{width}×{height} px{'' if len(pictures) == 2 else ' (both lenses side by side)'}. Calibrate the "
                "camera in the mode in which it took these pictures, see docs/rigs.md"
            )
    return pictures if len(pictures) == 2 else [pictures[0][:, : sizes[0][1]], pictures[0][:, sizes[0][1] :]]
