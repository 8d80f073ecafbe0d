"""Sources: read the panoramas of a capture."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from pano_mvs.algorithms.stitching import is_dual_fisheye
from pano_mvs.api import (
    NOT_IN_KEY,
    Context,
    FilePart,
    InputError,
    Panorama,
    Params,
    SourceItem,
    SourcePath,
    is_only_planned,
    source,
)
from pano_mvs.core.arrays import Mask
from pano_mvs.core.paths import is_folder
from pano_mvs.io.images.captures import describe_picture, list_pictures
from pano_mvs.io.images.copies import find_copies
from pano_mvs.io.images.metadata import find_gpano, position_from_exif, read_container
from pano_mvs.io.images.names import find_mask, printable_name, require_masks
from pano_mvs.scene.image_file import (
    ALPHA_BYTES_PER_PIXEL,
    MASK_BYTES_PER_PIXEL,
    MAX_PIXELS,
    decode_image,
    decode_opacity,
    decoding_bytes_per_pixel,
    readable_pixels,
    write_png,
)
from pano_mvs.scene.image_header import has_alpha, of_file, stated_size
from pano_mvs.scene.masking import MEANING_OF_MASKS
from pano_mvs.scene.stereo import StereoLayout, StereoSetting, one_eye, stereo_layout

STEREO: Any = Field(
    default="auto",
    description="how a stereo panorama shows both eyes, of which one is used; auto: by its metadata and its shape",
)


class FolderParams(Params):
    """Settings of source.folder."""

    path: SourcePath = Field(description="folder of the images, searched recursively")
    masks: SourcePath | None = Field(default=None, description="folder of masks <image name>.png; 0 is ignored")
    mask: SourcePath | None = Field(default=None, description="one mask for all images; 0 is ignored")
    nadir_deg: float = Field(
        default=0.0, ge=0, le=90, description="ignore this angle around straight down (tripod); 45: the lowest quarter"
    )
    zenith_deg: float = Field(default=0.0, ge=0, le=90, description="ignore this angle around straight up")
    max_width: int = Field(default=4096, ge=16, description="wider panoramas are scaled down to this width")
    stereo: StereoSetting = STEREO
    max_megapixels: Annotated[float, NOT_IN_KEY] = Field(
        default=MAX_PIXELS / 1e6, gt=0, description="larger files are rejected before they are decoded"
    )

    @property
    def max_pixels(self) -> int:
        """Maximum number of pixels of a file."""
        return int(self.max_megapixels * 1e6)


def list_folder(params: FolderParams) -> Iterator[SourceItem]:
    """List the images of a folder with their masks.

    Raises:
        InputError: if the folder contains fewer than two images.
    """
    unread: list[str] = []
    pictures = [path for path in list_pictures(params.path, unread) if not _is_mask(path, params)]
    if not pictures:
        raise InputError(f"{params.path}: all images in it are masks. Give the folder that contains the panoramas")
    if len(pictures) < 2:
        raise InputError(
            f"{params.path}: contains only one image ({pictures[0].name}); depth needs two or more panoramas of the "
            "same place, taken from different positions"
        )
    if params.masks is not None:
        require_masks(params.masks, [path.relative_to(params.path).as_posix() for path in pictures])
    names = [printable_name(path.relative_to(params.path).as_posix()) for path in pictures]
    usable = {name: path for path, (name, problem) in zip(pictures, names, strict=True) if not problem}
    copies = find_copies(usable, max_pixels=params.max_pixels, read=not is_only_planned.get())
    if len(pictures) - len(copies) < 2:
        raise InputError(
            f"{params.path}: all images are copies of one ({pictures[0].name}); depth needs two or more panoramas of "
            "the same place, taken from different positions"
        )
    for path, (name, problem) in zip(pictures, names, strict=True):
        files = {"image": path}
        mask = None if problem else (params.masks and find_mask(params.masks, name)) or params.mask
        if mask is not None:
            files["mask"] = mask
        if name in copies:
            copy = copies[name]
            turned = f", turned by {copy.turn_deg:.0f}°" if copy.turn_deg else ""
            problem = (
                f"it is a copy of {copy.original}{turned}, which is used alone, as a copy adds nothing; "
                "remove one of them"
            )
        yield SourceItem(name, files, problem, (*unread, *_notes_on_masks(name, mask, params)))


def folder_memory_bytes(params: FolderParams, inputs: Mapping[str, Any]) -> int:
    """Return the memory for reading an image and its mask, from the header of the file; 0 for files to be rejected."""
    item: SourceItem = inputs["item"]
    image = item.files["image"]
    masked = MASK_BYTES_PER_PIXEL if "mask" in item.files else 0
    alpha = ALPHA_BYTES_PER_PIXEL if of_file(image, has_alpha) else 0
    return readable_pixels(image, params.max_pixels) * max(decoding_bytes_per_pixel(image), masked, alpha)


@source("source.folder", list_items=list_folder, memory=folder_memory_bytes)
def folder(item: SourceItem, params: FolderParams, ctx: Context) -> Panorama:
    """Read the panoramas of a folder and its subfolders.

    An image is a panorama if its GPano metadata say so (full or cropped), or if it is twice as wide as high. Masks are
    searched as `<masks>/<image name>.png`, then `<masks>/<name without extension>.png`, then `mask`; they cover the
    same part of the sphere as the image, or the full sphere, at any resolution. Transparent pixels of an image are
    masked too. Of stereo panoramas, the left eye is used.
    """
    image = item.file("image")
    path, data = image.path, image.read_bytes()
    layout = params.stereo
    if layout == "auto":
        layout = stereo_layout(
            path,
            stated_size(data) or (0, 0),
            data,
            picture=partial(decode_image, path, data, max_pixels=params.max_pixels),
        )
    if layout != "none":
        return _left_eye(item, layout, data, params=params, ctx=ctx)
    info = describe_picture(path, data, max_pixels=params.max_pixels)
    for warning in info.warnings:
        ctx.note(f"{item.name}: {warning}")
    for trait in info.traits:
        ctx.note(f"{{count}} images have {trait}")
    opaque = decode_opacity(path, data, max_pixels=params.max_pixels)
    picture = decode_image(path, data, max_pixels=params.max_pixels)
    height, width = picture.shape[:2]
    if (height, width) != info.file_size_hw:
        raise InputError(
            f"{path}: decodes to {width}×{height} px, its header says {info.file_size_hw[::-1]}. Save it again"
        )
    if info.gpano is None and is_dual_fisheye(picture):
        raise InputError(
            f"{path}: two fisheye images side by side, not an equirectangular panorama. Export it as a panorama with "
            "the camera maker's program (stitching), or, if the calibration of the lenses is known, use "
            "source.dual_fisheye (docs/rigs.md)"
        )
    del data
    panorama = Panorama(
        image=image,
        size_hw=working_size(info.size_hw, min(params.max_width, info.full_width_px)),
        source_size_hw=info.size_hw,
        crop_ltwh=info.crop_ltwh,
        mask_file=item.file("mask") if "mask" in item.files else None,
        nadir_deg=params.nadir_deg,
        zenith_deg=params.zenith_deg,
        up_in_cam=info.gpano.up_in_cam if info.gpano else None,
        heading_deg=info.gpano.heading_deg if info.gpano else None,
        position_lla=info.position_lla,
    )
    return masked_panorama(panorama, opaque, name=item.name, ctx=ctx)


def masked_panorama(panorama: Panorama, opaque: Mask | None, *, name: str, ctx: Context) -> Panorama:
    """Return a panorama whose transparent pixels are masked too, and report how much of it is masked.

    Args:
        opaque: (h, w) bool, False where its image is transparent; None if it is opaque.
    """
    if opaque is not None and opaque.any():
        ctx.note("{count} images have transparent pixels, which are ignored like masked ones")
        panorama = panorama.with_mask(opaque, ctx.scratch)
    elif opaque is not None:
        ctx.note(f"{name}: all of it is transparent, so its alpha channel was not used as a mask")
    valid = panorama.load_mask()
    ctx.metric("valid", float(valid.mean()))
    if not valid.any():
        ctx.note(f"{name}: everything in it is masked")
    if panorama.mask_file is not None:
        shown = replace(panorama, mask_file=None).load_mask()
        height = panorama.size_hw[0]
        areas = np.sin((np.arange(height) + 0.5) * np.pi / height)  # of the pixels of each row
        masked = float(areas @ (shown & ~valid).sum(axis=1) / max(areas @ shown.sum(axis=1), 1e-9))
        ctx.metric("masked", masked)
        if masked > 0.5:
            ctx.note(f"{{count}} images have masks that hide most of what they show. {MEANING_OF_MASKS}")
    return panorama


def _left_eye(item: SourceItem, layout: StereoLayout, data: bytes, *, params: FolderParams, ctx: Context) -> Panorama:
    """Store the picture of one eye without loss, and return it."""
    path = item.files["image"]
    opaque = decode_opacity(path, data, max_pixels=params.max_pixels)
    if opaque is not None:
        opaque = one_eye(opaque.astype(np.uint8) * np.uint8(255), layout) == 255
    eye = one_eye(decode_image(path, data, max_pixels=params.max_pixels), layout)
    ctx.note(stereo_note("{count} images", layout))
    kept = ctx.scratch / "eye.png"
    write_png(kept, eye)
    container = read_container(data)
    gpano, _ = find_gpano(container.xmp, data)
    size_hw = eye.shape[0], eye.shape[1]
    panorama = Panorama(
        image=FilePart(kept),
        size_hw=working_size(size_hw, params.max_width),
        source_size_hw=size_hw,
        mask_file=item.file("mask") if "mask" in item.files else None,
        nadir_deg=params.nadir_deg,
        zenith_deg=params.zenith_deg,
        up_in_cam=gpano.up_in_cam if gpano else None,
        heading_deg=gpano.heading_deg if gpano else None,
        position_lla=position_from_exif(container.exif),
    )
    return masked_panorama(panorama, opaque, name=item.name, ctx=ctx)


def stereo_note(what: str, layout: StereoLayout) -> str:
    """Return a note on stereo pictures of which one eye is used."""
    place = "the upper half" if layout == "top_bottom" else "the left half"
    return f"{what} show both eyes (stereo); {place} is used, which is that of the left eye"


def working_size(source_hw: tuple[int, int], max_width: int) -> tuple[int, int]:
    """Return the working size: the width is a multiple of four, so that height and half a turn are whole pixels."""
    width = min(source_hw[1], max_width) // 4 * 4
    if width < 16:
        raise InputError(f"a panorama of {source_hw[1]}×{source_hw[0]} px is too small; it needs at least 16 columns")
    return width // 2, width


def _notes_on_masks(name: str, mask: Path | None, params: FolderParams) -> Iterator[str]:
    if mask is None and params.masks is not None:
        yield f"{name} has no mask in {params.masks.name}; all of it is used"
    if params.masks is None and is_folder(unused := params.path / "masks"):
        yield f"{unused} is there, but not used; give it as `masks` to apply its masks"


def _is_mask(path: Path, params: FolderParams) -> bool:
    """Return whether an image found among the panoramas is one of their masks."""
    masks, mask = (given and given.absolute() for given in (params.masks, params.mask))
    return path.absolute() == mask or (masks is not None and path.absolute().is_relative_to(masks))
