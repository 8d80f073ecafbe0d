"""Camera trajectories in the format of the TUM RGB-D benchmark, which SLAM programs write: times and poses, no names.

A line is `timestamp tx ty tz qx qy qz qw`: the time in seconds, and world_from_cam as the position and the rotation of
the camera (x right, y down, z forward). stella_vslam writes such files of panoramic videos.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

import numpy as np

from pano_mvs.core.errors import InputError
from pano_mvs.core.text import plural
from pano_mvs.geometry import Rigid3, rotation_from_quat_wxyz
from pano_mvs.io.images.names import match_image_names, without_extension
from pano_mvs.io.poses.json_files import require_distinct, rigid_from_arrays
from pano_mvs.scene import FilePart

SUFFIXES = (".txt", ".tum")
# Names of images state milliseconds at best, so that times which differ by less are the same.
_SAME_TIME_S = 1e-3
# The time in the name of an image: of `source.video`; in seconds with decimals; in nanoseconds since 1970.
_TIMES = (
    (re.compile(r".*?(\d+)ms"), 1e-3),
    (re.compile(r"(\d+\.\d+)"), 1.0),
    (re.compile(r"(\d{19})"), 1e-9),
)
_WHOLE = (re.compile(r"(\d{1,18})"), 1.0)


def read_trajectory(path: Path) -> dict[str, Rigid3]:
    """Return cam_from_world by time, as the file states it.

    Raises:
        InputError: if the file is not a trajectory; it names the line.
    """
    poses: list[tuple[str, Rigid3]] = []
    for number, line in enumerate(FilePart(path).read_text().splitlines(), 1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        where = f"{path}:{number}"
        try:
            values = np.array([float(word) for word in words])
        except ValueError:
            values = np.zeros(0)
        if len(values) != 8:
            raise InputError(f"{where}: expected 8 numbers (timestamp tx ty tz qx qy qz qw), got {line[:60]!r}")
        quat_wxyz = values[[7, 4, 5, 6]]
        if not np.isfinite(values).all() or not 1e-6 < np.abs(quat_wxyz).max() < 1e100:
            raise InputError(f"{where}: the pose holds NaN or infinite numbers, or a quaternion of length 0")
        world_from_cam = rigid_from_arrays(rotation_from_quat_wxyz(quat_wxyz), values[1:4], where)
        poses.append((words[0], world_from_cam.inverse()))
    require_distinct([time for time, _ in poses], path)
    return dict(poses)


def match_times(images: Sequence[str], times: Sequence[str], path: Path) -> tuple[dict[str, str], str]:
    """Return the time of a trajectory at which each image was taken, and how they were matched.

    Images have the time as their name, or in it: `walk_00012345ms.png` of `source.video`, seconds with decimals,
    nanoseconds, or, if all times are whole numbers, a whole number with leading zeros. If no image has a time of the
    trajectory and there are as many images as poses, both are matched in their order.

    Raises:
        InputError: if they cannot be matched.
    """
    if not times:
        raise InputError(f"{path}: contains no poses. Give a trajectory with a line for each pose")
    if matched := _by_seconds(images, times) | match_image_names(images, times):
        return matched, "the times in the names of the images"
    if len(images) == len(times):
        return dict(zip(images, times, strict=True)), "their order, since no image has one of its times in its name"
    raise InputError(
        f"{path}: no image has one of its times ({times[0]}, …) in its name, and {len(times)} "
        f"{plural(len(times), 'pose does', 'poses do')} not fit {len(images)} images in their order. Name the images "
        f"by their times, such as {times[0]}.png, or give as many poses as images"
    )


def _by_seconds(images: Sequence[str], times: Sequence[str]) -> dict[str, str]:
    """Return the nearest time of each image that has one in its name, if it is the same to a millisecond."""
    seconds = np.array([float(time) for time in times])
    whole = bool((seconds == np.rint(seconds)).all())
    found: dict[str, str] = {}
    for name in images:
        if (second := _second(name, whole=whole)) is not None:
            nearest = int(np.argmin(np.abs(seconds - second)))
            if abs(seconds[nearest] - second) <= _SAME_TIME_S:
                found[name] = times[nearest]
    return found


def _second(name: str, *, whole: bool) -> float | None:
    """Return the time in the name of an image, which may be a whole number of seconds if all times are whole."""
    stem = PurePosixPath(without_extension(name)).name
    matches = ((pattern.fullmatch(stem), unit) for pattern, unit in (*_TIMES, *((_WHOLE,) if whole else ())))
    return next((float(match[1]) * unit for match, unit in matches if match), None)
