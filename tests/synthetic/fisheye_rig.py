"""Render a room through a rig of two fisheye lenses, each at its own centre, with a calibration file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import FisheyeLens, LensRig, Rigid3, rotation_from_rotvec
from pano_mvs.io.rig_calibration import calibration_text
from pano_mvs.scene.image_file import write_png
from pano_mvs.testing.room import Room
from tests.synthetic.colors import colors_along

Layout = Literal["side_by_side", "folders", "suffixes"]


def example_rig(
    *,
    size_px: int = 320,
    offset_m: float = 0.03,
    field_of_view_deg: float = 200.0,
    stitch_distance_m: float = float("inf"),
) -> LensRig:
    """Return a rig of two different lenses back to back, which are not exactly opposite.

    Args:
        size_px: width and height of each picture.
        offset_m: distance between the two lens centres.
        field_of_view_deg: of each lens.
        stitch_distance_m: see `LensRig`.
    """
    half = float(np.radians(field_of_view_deg / 2))
    shapes = ((0.02, -0.006, 0.0008, -0.0001), (0.015, -0.004, 0.0005, 0.0))
    lenses = [
        FisheyeLens(
            (size_px, size_px),
            (0.27 * size_px, 0.269 * size_px),
            (0.503 * size_px, 0.498 * size_px),
            shape,
            half,
        )
        for shape in shapes
    ]
    back = rotation_from_rotvec(np.array([0.012, np.pi - 0.02, 0.017]))
    offset = offset_m * np.array([0.05, -0.03, -1.0]) / np.linalg.norm([0.05, -0.03, -1.0])
    return LensRig.centred(
        ("front", "back"),
        (lenses[0], lenses[1]),
        (Rigid3.identity(), Rigid3.from_center(back, offset)),
        stitch_distance_m=stitch_distance_m,
    )


def render_lens(room: Room, lens: FisheyeLens, lens_from_world: Rigid3, *, supersample: int = 2) -> NDArray[np.uint8]:
    """Return the picture of a lens, (H, W, 3) uint8 RGB, black beyond its field of view."""
    height, width = lens.size_hw
    colors = np.zeros((height * width, 3))
    steps = (np.arange(supersample) + 0.5) / supersample
    rows, columns = np.mgrid[:height, :width]
    pixel_rad = 1 / min(lens.focal_xy)
    for offset_y in steps:
        for offset_x in steps:
            pixels = np.stack([columns + offset_x, rows + offset_y], axis=-1).reshape(-1, 2)
            rays = lens.ray_from_pixel(pixels)
            seen = np.isfinite(rays).all(axis=1)
            in_world = rays[seen] @ lens_from_world.rotation
            colors[seen] += colors_along(room, lens_from_world.center, in_world, pixel_rad=pixel_rad)
    picture: NDArray[np.uint8] = np.rint(colors * (255 / supersample**2)).astype(np.uint8)
    return picture.reshape(height, width, 3)


def render_rig(
    room: Room, rig: LensRig, rig_from_world: Rigid3, *, units_per_m: float = 1.0, supersample: int = 2
) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Return the pictures of both lenses of a rig, each seen from its own centre.

    Args:
        room: the room.
        rig: the rig.
        rig_from_world: pose of the rig.
        units_per_m: units of the room per metre of the rig.
        supersample: number of rays per pixel along each side.
    """
    first, second = (
        render_lens(
            room, lens, Rigid3(pose.rotation, units_per_m * pose.translation) @ rig_from_world, supersample=supersample
        )
        for lens, pose in zip(rig.lenses, rig.lens_from_rig, strict=True)
    )
    return first, second


def write_rig_capture(
    folder: Path,
    room: Room,
    poses: Sequence[Rigid3],
    *,
    rig: LensRig,
    layout: Layout = "side_by_side",
    units_per_m: float = 1.0,
    supersample: int = 2,
) -> None:
    """Write the pictures of a rig at some poses as images/…, and rig.yaml beside that folder."""
    images = folder / "images"
    images.mkdir(parents=True, exist_ok=True)
    (folder / "rig.yaml").write_text(calibration_text(rig), encoding="utf-8")
    for number, pose in enumerate(poses):
        pictures = render_rig(room, rig, pose, units_per_m=units_per_m, supersample=supersample)
        if layout == "side_by_side":
            write_png(images / f"{number:03d}.png", np.concatenate(pictures, axis=1))
            continue
        for name, picture in zip(rig.names, pictures, strict=True):
            path = images / name / f"{number:03d}.png" if layout == "folders" else images / f"{number:03d}_{name}.png"
            path.parent.mkdir(exist_ok=True)
            write_png(path, picture)
