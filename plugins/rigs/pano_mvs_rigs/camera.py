"""Estimate the calibration of a two-lens camera from its raw pictures, and describe it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np

from pano_mvs.core.arrays import Picture
from pano_mvs.core.errors import InputError
from pano_mvs.core.text import plural
from pano_mvs.geometry import LensRig, Rigid3, rotation_from_rotvec
from pano_mvs.io.images.captures import Layout, RigPictures, list_rig_pictures
from pano_mvs.io.images.metadata import camera_from_exif, read_container
from pano_mvs.scene import FilePart
from pano_mvs.scene.image_file import decode_image
from pano_mvs_rigs.calibrate import Calibration, View, calibrate_lenses

_FIELDS_OF_VIEW_DEG = {"theta s": 202.0, "gear 360": 195.0}
"""Field of view of the image circles by parts of the camera's name in EXIF: start values."""

QUARTER_TURNS = {"top": 0, "right": 1, "bottom": 2, "left": -1}
"""Turn of the rig about the axis of the first lens by the side of its picture where the top of the scene is."""


def calibrate_camera(
    folder: Path,
    *,
    names: tuple[str, str] = ("front", "back"),
    layout: Layout = "auto",
    distance_m: float | None = None,
    field_of_view_deg: float | None = None,
    up: str = "top",
    max_captures: int = 12,
    progress: Callable[[str], None] = lambda _: None,
) -> tuple[LensRig, list[str]]:
    """Return the rig of a two-lens camera, as found in its raw pictures, and sentences about its precision.

    Args:
        folder: the pictures, as for source.dual_fisheye.
        layout: see `list_rig_pictures`.
        distance_m: distance between the centres of the lenses; None if unknown, then the rig is not metric.
        field_of_view_deg: about the full angle of the image circles; None for that of the camera in the EXIF data.
        up: side of the first lens's picture where the top of the scene is, one of QUARTER_TURNS; the panoramas are
            then upright.
        max_captures: number of captures that are used, the first ones.

    Raises:
        InputError: if there are fewer than two captures, or they do not determine the lenses.
    """
    captures = [one for one in list_rig_pictures(folder, names, layout) if not one.problem][:max_captures]
    if len(captures) < 2:
        raise InputError(
            f"{folder}: contains {len(captures)} complete {plural(len(captures), 'capture', 'captures')} of both "
            "lenses; a calibration needs two or more, better 6 to 12, from different places"
        )
    if field_of_view_deg is None:
        camera = camera_from_exif(read_container(captures[0].files[0].read_bytes()).exif).lower()
        known = (field for part, field in _FIELDS_OF_VIEW_DEG.items() if part in camera)
        field_of_view_deg = next(known, 195.0)
    try:
        found = calibrate_lenses(
            _loader(captures),
            len(captures),
            field_of_view_deg=field_of_view_deg,
            rng=np.random.default_rng(0),
            progress=progress,
        )
    except InputError as error:
        raise InputError(f"{folder}: {error}") from error
    # Distance of the lenses in the file if it is not given: about that of cameras held in a hand.
    length_m = 0.03 if distance_m is None else distance_m
    second_from_first = Rigid3(found.second_from_first.rotation, length_m * found.second_from_first.translation)
    first_from_rig = Rigid3(rotation_from_rotvec([0.0, 0.0, QUARTER_TURNS[up] * np.pi / 2]), np.zeros(3))
    determined = bool(np.isfinite(found.offset_std))
    rig = LensRig.centred(
        names,
        found.lenses,
        (first_from_rig, second_from_first @ first_from_rig),
        metric=distance_m is not None and determined,
    )
    return rig, _described(found, names, len(captures), length_m=length_m, is_given=distance_m is not None)


def _loader(captures: Sequence[RigPictures]) -> Callable[[View], Picture]:
    """Return a function that reads the picture of a view and checks that all have the same size."""

    @lru_cache(maxsize=1)
    def decoded(path: Path) -> Picture:
        return decode_image(path, FilePart(path).read_bytes())

    sizes: dict[int, tuple[int, ...]] = {}

    def load(view: View) -> Picture:
        files = captures[view[0]].files
        picture = decoded(files[min(view[1], len(files) - 1)])
        if len(files) == 1:
            half = picture.shape[1] // 2
            picture = picture[:, :half] if view[1] == 0 else picture[:, half : 2 * half]
        if sizes.setdefault(view[1], picture.shape) != picture.shape:
            raise InputError(
                f"{files[-1].name} has another size than the pictures before it. Calibrate each mode of the camera "
                "by itself"
            )
        return picture

    return load


def _described(found: Calibration, names: tuple[str, str], count: int, *, length_m: float, is_given: bool) -> list[str]:
    lines = [
        f"{found.captures} of {count} captures, {found.observations} observations, median residual "
        f"{found.residual_px:.2f} px"
    ]
    for idx, (name, lens) in enumerate(zip(names, found.lenses, strict=True)):
        x, y = lens.principal_xy
        lines.append(
            f"{name}: focal length {lens.focal_xy[0]:.2f} ± {found.focal_std_px[idx]:.2f} px, principal point "
            f"({x:.2f}, {y:.2f}) ± {found.principal_std_px[idx]:.2f} px, rays ± {found.ray_std_deg[idx]:.3f}°, field "
            f"of view {np.degrees(2 * lens.max_angle_rad):.1f}° (key points up to {2 * found.observed_deg[idx]:.0f}°)"
        )
    axis = np.degrees(np.arccos(np.clip(-found.second_from_first.rotation[2, 2], -1, 1)))
    lines.append(f"axes {axis:.2f}° from opposite; rotation between the lenses ± {found.turn_std_deg:.3f}°")
    if not np.isfinite(found.offset_std):
        lines.append(
            "not determined: the offset between the lenses, which is 0 in the file. Pictures from several places near "
            "things, with the camera turned between them, determine it"
        )
    elif is_given:
        lines.append(
            f"distance between the lenses {1000 * length_m:.4g} mm as given; its direction, and its ratio to the "
            f"distances of the cameras, ± {100 * found.offset_std:.1f} %"
        )
    else:
        lines.append(
            f"not determined: the length of the offset between the lenses. {1000 * length_m:.4g} mm is assumed, so "
            "poses will not be in metres. Measure the distance between the lenses and give it with --distance; its "
            f"direction is known ± {100 * found.offset_std:.1f} % of its length"
        )
    lines.append("the standard deviations cover noise in the key points only")
    return lines
