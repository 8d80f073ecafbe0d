"""How well `pano-mvs calibrate` finds the lenses of a camera from a capture, and what the found calibration gives.

Random rigs of two lenses take pictures of rendered places: with distortion, circles that are not centred in the
picture nor exactly on the axis, lenses that are not quite opposite, vignetting, noise and a dark surround. Two figures
are printed for each capture: errors of the calibration against the true one, and errors of poses and ranges of
panoramas that are stitched with the true calibration, with the found one, and by nominal lenses at infinity, as the
camera's own program does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray
from pano_mvs_rigs.camera import calibrate_camera

from pano_mvs.algorithms.poses.adjustment.refine import refine_poses
from pano_mvs.algorithms.poses.scaled_translation import solve_scaled_translation
from pano_mvs.algorithms.stitching import stitch_lenses
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.geometry import (
    FisheyeLens,
    LensRig,
    Rigid3,
    angle_between,
    geodesic_angle,
    nearest_rotation,
    rotation_from_rotvec,
    similarity_from_points,
)
from pano_mvs.io.rig_calibration import calibration_text
from pano_mvs.scene.image_file import decode_image, write_png
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.testing.room import Room, capture_poses, default_room, render
from tests.synthetic.fisheye_rig import render_lens
from tests.synthetic.places import window_room, yard
from tests.synthetic.scenes import corridor, courtyard, desk, poles, white_room
from tools.benchmarks.poses.captures_with_truth import cameras_of, matched

SCENES = {
    "corridor": corridor,
    "courtyard": courtyard,
    "desk": desk,
    "poles": poles,
    "white_room": white_room,
    "window_room": window_room,
    "yard": yard,
}


def random_rig(seed: int, *, size_px: int = 1000) -> LensRig:
    """Return two lenses 15 to 40 mm apart that see 190 to 204°, turned by 1 to 2° from their places.

    The principal points are up to about 3 % of the size from the centres of the pictures.
    """
    rng = np.random.default_rng([seed, 0xCA])
    half = float(np.radians(rng.uniform(190, 204) / 2))
    shape = rng.normal(0, (0.02, 0.006, 0.001, 0.0001))
    lenses = []
    for _ in range(2):
        bent = tuple(float(k) for k in shape + rng.normal(0, (0.002, 0.0006, 0.0001, 0.00001)))
        flat = FisheyeLens((size_px, size_px), (1.0, 1.0), (0.0, 0.0), (bent[0], bent[1], bent[2], bent[3]), half)
        focal = float(0.47 * size_px * rng.uniform(0.985, 1.0) / flat.radius_from_angle(half))
        center = size_px / 2 + rng.uniform(-0.03, 0.03, 2) * size_px
        lenses.append(
            FisheyeLens(flat.size_hw, (focal, focal), (float(center[0]), float(center[1])), flat.distortion, half)
        )
    axis = rng.normal(size=3)
    small = rotation_from_rotvec(axis / np.linalg.norm(axis) * np.radians(rng.uniform(1, 2)))
    turn = rotation_from_rotvec(np.array([0.0, 0.0, np.pi / 2]) * rng.integers(4))
    back = turn @ small @ rotation_from_rotvec(np.array([0.0, np.pi, 0.0]))
    offset = np.array([*rng.normal(0, 0.001, 2), -rng.uniform(0.015, 0.04)])
    return LensRig.centred(
        ("front", "back"), (lenses[0], lenses[1]), (Rigid3.identity(), Rigid3.from_center(back, offset))
    )


def place(name: str, seed: int, count: int) -> tuple[Room, list[Rigid3]]:
    """Return a place and poses in it: cameras of any heading that are tilted by a few degrees."""
    if name == "room":
        return default_room(seed), capture_poses(count, seed=seed)
    scene = SCENES[name](seed=seed, views=count, turned=False)
    rng = np.random.default_rng([seed, count])
    poses = []
    for pose in scene.poses:
        tilt, heading = rng.normal(0, np.radians(5), 3) * (1, 0, 1), (0.0, rng.uniform(-np.pi, np.pi), 0.0)
        poses.append(Rigid3.from_center(rotation_from_rotvec(tilt) @ rotation_from_rotvec(heading), pose.center))
    return scene.room, poses


def raw_picture(
    room: Room, lens: FisheyeLens, lens_from_world: Rigid3, *, rng: np.random.Generator, circle_px: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Return what a lens records: darker towards the rim, noisy, and dark beyond a circle, which is blurred.

    `circle_px`: where the centre of the circle lies from the principal point.
    """
    height, width = lens.size_hw
    picture = render_lens(room, lens, lens_from_world, supersample=2).astype(np.float64)
    rows, columns = np.mgrid[:height, :width] + 0.5
    reach = lens.focal_xy[0] * float(lens.radius_from_angle(lens.max_angle_rad)) - 5
    radius = np.hypot(columns - lens.principal_xy[0] - circle_px[0], rows - lens.principal_xy[1] - circle_px[1]) / reach
    light = np.clip((1 - radius) * reach / 3, 0, 1) * (1 - 0.5 * np.clip(radius, 0, 1) ** 4)
    noisy = picture * light[..., None] + rng.normal(3, 1.5, picture.shape)
    recorded: NDArray[np.uint8] = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    return recorded


def write_raw_capture(folder: Path, room: Room, poses: Sequence[Rigid3], *, rig: LensRig, seed: int = 0) -> None:
    """Write images/000.png … with both circles side by side, and the true calibration as true.yaml."""
    rng = np.random.default_rng([seed, 0xF0])
    circles = rng.uniform(-3, 3, (2, 2)) * rig.lenses[0].size_hw[1] / 1000
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "true.yaml").write_text(calibration_text(rig), encoding="utf-8")
    for number, pose in enumerate(poses):
        seen = [
            raw_picture(room, lens, lens_from_rig @ pose, rng=rng, circle_px=circle)
            for lens, lens_from_rig, circle in zip(rig.lenses, rig.lens_from_rig, circles, strict=True)
        ]
        write_png(folder / "images" / f"{number:03d}.png", np.concatenate(seen, axis=1))


@dataclass(frozen=True)
class CalibrationErrors:
    """Errors of a found calibration.

    Attributes:
        ray_deg: median angle between found and true rays over the common field of view, the worse lens. A rotation of
            the lens, which its pose compensates, is not counted.
        ray_p95_deg: the 95th percentile of these.
        turn_deg: of the rotation between the lenses.
        offset_deg: of the direction of the offset; NaN if it was not determined.
    """

    ray_deg: float
    ray_p95_deg: float
    turn_deg: float
    offset_deg: float


def calibration_errors(found: LensRig, true: LensRig) -> CalibrationErrors:
    """Compare two rigs."""
    medians, p95, aligned = [], [], []
    for one, other in zip(found.lenses, true.lenses, strict=True):
        height, width = other.size_hw
        pixels = np.stack(np.meshgrid(np.arange(2, width, 5.0), np.arange(2, height, 5.0)), axis=-1).reshape(-1, 2)
        rays, expected = one.ray_from_pixel(pixels), other.ray_from_pixel(pixels)
        both = np.isfinite(rays[:, 0]) & np.isfinite(expected[:, 0])
        aligned.append(nearest_rotation(expected[both].T @ rays[both]))
        angles = np.degrees(angle_between(rays[both] @ aligned[-1].T, expected[both]))
        medians.append(float(np.median(angles)))
        p95.append(float(np.percentile(angles, 95)))
    offset, true_offset = (_second_from_first(rig) for rig in (found, true))
    turn = aligned[1] @ offset.rotation @ aligned[0].T
    length = np.linalg.norm(offset.translation)
    cosine = offset.translation @ true_offset.translation / np.linalg.norm(true_offset.translation)
    return CalibrationErrors(
        max(medians),
        max(p95),
        float(np.degrees(geodesic_angle(turn, true_offset.rotation))),
        float(np.degrees(np.arccos(np.clip(cosine / length, -1, 1)))) if length > 0 else np.nan,
    )


def _second_from_first(rig: LensRig) -> Rigid3:
    first, second = rig.lens_from_rig
    return second @ first.inverse()


def without_offset(rig: LensRig) -> LensRig:
    """Return the same lenses in one place: a perfect calibration of a program that stitches at infinity."""
    first, second = (Rigid3(pose.rotation, np.zeros(3)) for pose in rig.lens_from_rig)
    return LensRig.centred(rig.names, rig.lenses, (first, second))


def nominal(rig: LensRig) -> LensRig:
    """Return both lenses as designed: their mean shape and focal length, exactly opposite, in one place."""
    shape = np.mean([lens.distortion for lens in rig.lenses], axis=0)
    focal = float(np.mean([lens.focal_xy for lens in rig.lenses]))
    k1, k2, k3, k4 = (float(value) for value in shape)
    lenses = [
        replace(lens, focal_xy=(focal, focal), distortion=(k1, k2, k3, k4), max_angle_rad=0.98 * lens.max_angle_rad)
        for lens in rig.lenses
    ]
    turn = _second_from_first(rig).rotation
    angle = np.round(np.arctan2(-turn[1, 0], -turn[0, 0]) / (np.pi / 2)) * np.pi / 2
    exact = rotation_from_rotvec(np.array([0.0, 0.0, angle])) @ rotation_from_rotvec(np.array([0.0, np.pi, 0.0]))
    return LensRig.centred(rig.names, (lenses[0], lenses[1]), (Rigid3.identity(), Rigid3(exact, np.zeros(3))))


@dataclass(frozen=True)
class CaptureErrors:
    """Errors of poses and ranges: centres in mm after a similarity, rotations in degrees, ranges in percent."""

    cameras: int
    center_mm: float
    rotation_deg: float
    range_percent: float
    within_5_percent: float


def capture_errors(
    folder: Path, rig: LensRig, room: Room, *, true: Sequence[Rigid3], width: int, references: int = 3
) -> CaptureErrors:
    """Return the errors of a capture that is stitched with a rig, at 3 m, or at infinity if it has no offset.

    Args:
        folder: with the pictures in images/.
        rig: how they are stitched.
        room: the place.
        true: true pose of each capture.
        width: of the panoramas.
        references: number of panoramas whose ranges are compared.
    """
    has_offset = rig.lens_offset_m > 0
    rig = replace(rig, stitch_distance_m=3.0 if has_offset else np.inf)
    panoramas, masks = {}, {}
    for path in sorted((folder / "images").iterdir()):
        both = decode_image(path)
        half = both.shape[1] // 2
        name = path.name
        panoramas[name], masks[name] = stitch_lenses((both[:, :half], both[:, half:]), rig, size_hw=(width // 2, width))
    features, pairs = matched(panoramas)
    poses = solve_scaled_translation(features, pairs, rng=np.random.default_rng(0))
    poses = split_groups(poses)[0]
    poses = refine_poses(
        poses,
        load=lambda name: (panoramas[name], masks[name]),
        rigs=dict.fromkeys(poses.names, rig) if has_offset else None,
    )
    known = {f"{idx:03d}.png": pose for idx, pose in enumerate(true)}
    centers = np.array([known[name].center for name in poses.names])
    fit = similarity_from_points(poses.centers, centers)
    turns = [
        np.degrees(geodesic_angle(rotation @ fit.rotation.T, known[name].rotation))
        for name, rotation in zip(poses.names, poses.rotations, strict=True)
    ]
    off = np.linalg.norm(fit.apply(poses.centers) - centers, axis=1)
    relative = []
    small = {name: cv2.resize(panoramas[name], (512, 256), interpolation=cv2.INTER_AREA) for name in poses.names}
    for reference in poses.names[:references]:
        truth = render(room, known[reference], (256, 512), supersample=1)[1]
        near, far = np.nanpercentile(truth, [0.5, 99.5]) / fit.scale
        cameras = cameras_of(poses)
        order = sorted(
            (name for name in poses.names if name != reference),
            key=lambda name: float(np.linalg.norm(cameras[name].center - cameras[reference].center)),
        )[:4]
        found = sweep_range(
            small[reference],
            [small[name] for name in order],
            [cameras[name] @ cameras[reference].inverse() for name in order],
            near=0.8 * near,
            far=1.2 * far,
            settings=SweepSettings(planes=96),
        )
        relative.append(np.abs(found.range * fit.scale / truth - 1)[found.valid & np.isfinite(truth)])
    errors = np.concatenate(relative)
    return CaptureErrors(
        len(poses.names),
        float(1000 * np.median(off)),
        float(np.median(turns)),
        float(100 * np.median(errors)),
        float(100 * np.mean(errors < 0.05)),
    )


def main(
    scene: str = "white_room",
    seed: int = 11,
    captures: int = 6,
    size_px: int = 600,
    gain: bool = False,
    folder: Path | None = None,
) -> None:
    """Render one capture, calibrate it and print the errors.

    `scene`: "room" or one of SCENES. `seed`: of rig, place and noise. `captures`: number of pictures. `size_px`: of
    each circle's picture. `gain`: also measure poses and ranges. `folder`: where the capture is written, or kept from
    an earlier run.
    """
    rig, (room, poses) = random_rig(seed, size_px=size_px), place(scene, seed, captures)
    with TemporaryDirectory() as scratch:
        here = folder or Path(scratch)
        if not (here / "true.yaml").exists():
            write_raw_capture(here, room, poses, rig=rig, seed=seed)
        found, lines = calibrate_camera(here / "images", distance_m=2 * rig.lens_offset_m)
        print("\n".join(lines))
        print(scene, seed, calibration_errors(found, rig), flush=True)
        if not gain:
            return
        width = round(2 * np.pi * max(lens.focal_xy[0] for lens in rig.lenses)) // 4 * 4
        cases = {"true": rig, "found": found, "factory": without_offset(rig), "nominal": nominal(rig)}
        for label, one in cases.items():
            print(label, capture_errors(here, one, room, true=poses, width=width), flush=True)
