"""The pictures of two-lens cameras as COLMAP reads them: fisheye pictures, a rig, and a sparse model."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.api import (
    Context,
    Each,
    Files,
    Panorama,
    Params,
    Poses,
    stage,
)
from pano_mvs.core.paths import children
from pano_mvs.geometry import FisheyeLens, ray_grid
from pano_mvs.io.colmap.writer import LensPictures, ModelForm, rig_configuration, write_lens_rig_model
from pano_mvs.scene.files import item_stems
from pano_mvs.scene.image_file import decode_image, decoding_bytes_per_pixel, write_png
from pano_mvs.scene.pose_groups import split_groups

FOLDER = "colmap_rig"


def lens_rig_files(poses: Poses, images: Mapping[str, Panorama], form: ModelForm, *, ctx: Context) -> dict[str, Path]:
    """Write the models of the fisheye pictures, one for each group of poses, and return the files by target.

    There are none if no panorama has a rig. Groups whose poses are not in metres are left out with a note.
    """
    stems = item_stems(images)
    pictures = {name: _pictures(image, stems[name]) for name, image in images.items() if image.rig is not None}
    files: dict[str, Path] = {}
    if not pictures:
        return files
    if not all(image.rig.metric for image in images.values() if image.rig is not None):
        ctx.note(
            f"{FOLDER} was not written: the distance between the lenses is only assumed in the calibration. Measure it "
            "and give it to pano-mvs calibrate with --distance (docs/rigs.md)"
        )
        return files
    for number, group in enumerate(split_groups(poses)):
        if not group.metric:
            ctx.note(
                f"{FOLDER} was not written{f' for group {number}' if number else ''}: the unit of length of the poses "
                "is not known, but the distance between the lenses is in metres. Add poses.scale (docs/rigs.md)"
            )
            continue
        folder = ctx.scratch / f"rig_{number}"
        write_lens_rig_model(folder, group, pictures, form=form)
        files |= {f"{FOLDER}/sparse/{number}/{path.name}": path for path in children(folder)}
    configuration = ctx.scratch / "rig_config.json"
    first = next(image.rig for image in images.values() if image.rig is not None)
    configuration.write_text(rig_configuration(first), encoding="utf-8")
    return files | {f"{FOLDER}/rig_config.json": configuration}


def lenses_memory_bytes(_: Params, inputs: Mapping[str, Any]) -> int:
    """Return the memory for one fisheye picture, its mask, and the rays of the panorama."""
    image: Panorama = inputs["image"]
    if image.rig is None or image.first_lens is None:
        return 0
    height, width = image.size_hw
    largest = 2 * max(lens.size_hw[0] * lens.size_hw[1] for lens in image.rig.lenses)
    return 50_000_000 + largest * (decoding_bytes_per_pixel(image.first_lens.path) + 100) + 300 * height * width


@stage("export.colmap_lenses", memory=lenses_memory_bytes)
def colmap_lenses(image: Each[Panorama], ctx: Context) -> Files:
    """Write the fisheye pictures of panoramas from source.dual_fisheye for the rig that export.colmap writes.

    colmap_rig/images/<lens>/<image> are the pictures: copies of the files, or, if a file shows both lenses, its halves
    as PNG. colmap_rig/masks has their masks (0 outside of the field of view), and colmap_rig/labels/<image>.png the
    lens that each pixel of the panorama shows: 1 the first, 2 the second, 0 none.
    """
    rig, first = image.rig, image.first_lens
    if rig is None or first is None:
        ctx.note("{count} panoramas were not stitched by source.dual_fisheye, so they have no fisheye pictures")
        return Files({})
    files: dict[str, Path] = {}
    for lens_idx, (name, lens) in enumerate(zip(rig.names, rig.lenses, strict=True)):
        suffix = _suffix(image)
        picture, mask = ctx.scratch / f"{name}{suffix}", ctx.scratch / f"{name}.mask.png"
        picture.write_bytes(_lens_file(image, lens_idx))
        write_png(mask, lens_mask(lens))
        files[f"{FOLDER}/images/{name}/{{item}}{suffix}"] = picture
        files[f"{FOLDER}/masks/{name}/{{item}}{suffix}.png"] = mask
    labels = ctx.scratch / "labels.png"
    write_png(labels, (rig.lens_of_bearings(ray_grid(image.size_hw)) + 1).astype(np.uint8))
    return Files(files | {f"{FOLDER}/labels/{{item}}.png": labels})


def lens_mask(lens: FisheyeLens) -> NDArray[np.uint8]:
    """Return the pixels within the field of view of a lens, (H, W) uint8: 255 inside, 0 outside."""
    height, width = lens.size_hw
    pixels = np.stack(np.broadcast_arrays(np.arange(width) + 0.5, np.arange(height)[:, None] + 0.5), axis=-1)
    return np.where(np.isfinite(lens.ray_from_pixel(pixels)[..., 2]), np.uint8(255), np.uint8(0))


def _pictures(image: Panorama, stem: str) -> LensPictures:
    assert image.rig is not None
    first, second = (f"{lens}/{stem}{_suffix(image)}" for lens in image.rig.names)
    return LensPictures(image.rig, (first, second))


def _suffix(image: Panorama) -> str:
    assert image.first_lens is not None
    return ".png" if image.second_lens is None else image.first_lens.path.suffix


def _lens_file(image: Panorama, lens_idx: int) -> bytes:
    """Return the file of one lens: the user's own, or half of it as PNG."""
    assert image.rig is not None
    assert image.first_lens is not None
    if image.second_lens is not None:
        return (image.first_lens, image.second_lens)[lens_idx].read_bytes()
    both = decode_image(image.first_lens.path, image.first_lens.read_bytes())
    width = image.rig.lenses[0].size_hw[1]
    half = both[:, :width] if lens_idx == 0 else both[:, width:]
    return bytes(cv2.imencode(".png", cv2.cvtColor(half, cv2.COLOR_RGB2BGR))[1].tobytes())
