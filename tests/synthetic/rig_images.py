"""A tiny capture of a rig of two lenses, rendered once."""

from __future__ import annotations

import functools
from pathlib import Path
from tempfile import TemporaryDirectory

from pano_mvs.algorithms.stitching import stitch_lenses
from pano_mvs.geometry import LensRig
from pano_mvs.scene import FilePart, Panorama
from pano_mvs.scene.image_file import decode_image, write_png
from pano_mvs.testing.room import capture_poses, default_room
from tests.synthetic.fisheye_rig import Layout, example_rig, write_rig_capture

_folders: list[TemporaryDirectory[str]] = []


@functools.cache
def tiny_rig_capture(layout: Layout = "side_by_side") -> Path:
    """Return the folder of a capture of two views with lenses of 48 × 48 pixels: images/ and rig.yaml."""
    _folders.append(TemporaryDirectory(prefix="pano-mvs-rig-"))
    folder = Path(_folders[-1].name)
    write_rig_capture(
        folder, default_room(texture="weak"), capture_poses(2), rig=tiny_rig(), layout=layout, supersample=1
    )
    return folder


def tiny_rig() -> LensRig:
    return example_rig(size_px=48, stitch_distance_m=3.0)


@functools.cache
def tiny_rig_panorama() -> Panorama:
    """Return a panorama with its rig, stitched from a file that shows both lenses."""
    folder = tiny_rig_capture()
    both = decode_image(folder / "images" / "000.png")
    picture, _ = stitch_lenses((both[:, :48], both[:, 48:]), tiny_rig(), size_hw=(32, 64))
    write_png(folder / "stitched.png", picture)
    return Panorama(
        FilePart(folder / "stitched.png", external=True),
        (32, 64),
        (32, 64),
        rig=tiny_rig(),
        first_lens=FilePart(folder / "images" / "000.png", external=True),
    )
