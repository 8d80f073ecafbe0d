"""Images of the fused cloud from three viewpoints, by PyVista or, without a graphics driver, by our own renderer."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.rendering import Viewpoint, draw_cloud, inside_camera, viewpoints
from pano_mvs.report.cloud_renderer import read_pictures, write_scene
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results.pictures import Picture, picture
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene import PointCloud
from pano_mvs.scene.pose_groups import split_groups

RENDERER_VARIABLE = "PANO_MVS_RENDERER"
"""`software` draws without PyVista; anything else, or nothing, tries PyVista first."""

VERSION = 2
"""Raise it when the pictures change: earlier pages' are then drawn again."""

_SIZE_HW = (600, 960)
_MAX_POINTS = 800_000
MAX_BYTES = 300_000
_TIMEOUT_S = 120.0
_COMMAND = (sys.executable, "-m", "pano_mvs.report.cloud_renderer")

Arrays = tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]


@dataclass(frozen=True)
class CloudPictures:
    """The pictures of a cloud."""

    shown: tuple[tuple[str, Picture], ...] = ()
    note: str = ""


def cloud_pictures(
    results: StoredValues, kept: EarlierPage, *, up: NDArray[np.float64], command: Sequence[str] = _COMMAND
) -> CloudPictures:
    """Return images of the cloud, reusing those of an earlier page if they show the same cloud.

    If there are several groups of poses, the largest is shown.
    """
    digest = results.digest("cloud")
    if not digest:
        return CloudPictures()
    software = os.environ.get(RENDERER_VARIABLE, "") == "software"
    stem = f"{digest[:24]}.{results.digest('poses')[:16]}.{'s' if software else 'g'}{VERSION}"
    known = kept.fact(stem)
    earlier = [kept.picture(f"{stem}.{number}") for number in range(3)]
    if isinstance(known, dict) and all(earlier) and len(known.get("titles", ())) == 3:
        titles = [str(title) for title in known["titles"]]
        pairs = tuple((title, found) for title, found in zip(titles, earlier, strict=True) if found is not None)
        return CloudPictures(pairs, str(known.get("note", "")))
    whole, all_poses = results.cloud, results.poses
    if whole is None or not len(whole.groups()[0]):
        return CloudPictures()
    cloud, poses = whole.groups()[0], None if all_poses is None else split_groups(all_poses)[0]
    centers = poses.centers if poses is not None else np.zeros((0, 3))
    place = poses.names[inside_camera(centers)] if poses is not None and len(centers) else ""
    arrays = _thinned(cloud)
    seen_from = viewpoints(arrays[0], centers, up, aspect=_SIZE_HW[1] / _SIZE_HW[0], place=place)
    images, note = _drawn(arrays, seen_from, software=software, command=command)
    if whole.group_sizes:
        note = "; ".join(
            [
                *filter(None, [note]),
                "this is group 0 of the poses, the largest; the clouds of the others "
                "are cloud_1.ply … (pano-mvs view OUT --group 1)",
            ]
        )
    titles = [view.title for view in seen_from]
    kept.keep(stem, {"titles": titles, "note": note})
    return CloudPictures(
        tuple(
            (title, picture(image, width=_SIZE_HW[1], most_bytes=MAX_BYTES, key=f"{stem}.{number}"))
            for number, (title, image) in enumerate(zip(titles, images, strict=True))
        ),
        note,
    )


def _thinned(cloud: PointCloud) -> Arrays:
    """Return every n-th point of a cloud, to limit the number of drawn points."""
    step = -(-len(cloud) // _MAX_POINTS)
    return (
        np.ascontiguousarray(cloud.points_in_world[::step]),
        np.ascontiguousarray(cloud.normals_in_world[::step]),
        np.ascontiguousarray(cloud.colors_rgb[::step]),
    )


def _drawn(
    arrays: Arrays, seen_from: Sequence[Viewpoint], *, software: bool, command: Sequence[str]
) -> tuple[list[NDArray[np.uint8]], str]:
    if not software:
        images = _drawn_apart(arrays, seen_from, command)
        if images:
            return images, ""
    note = "" if software else "PyVista could not render (no graphics driver), so these images are simpler"
    return [draw_cloud(*arrays, viewpoint=view, size_hw=_SIZE_HW) for view in seen_from], note


def _drawn_apart(arrays: Arrays, seen_from: Sequence[Viewpoint], command: Sequence[str]) -> list[NDArray[np.uint8]]:
    """Return images rendered in another process; nothing if it fails, crashes or takes too long."""
    with TemporaryDirectory(prefix="pano-mvs-report-") as name:
        folder = Path(name)
        write_scene(folder, arrays, seen_from, size_hw=_SIZE_HW)
        try:
            done = subprocess.run(  # noqa: S603  # our own interpreter and module
                [*command, name], stdin=subprocess.DEVNULL, capture_output=True, timeout=_TIMEOUT_S, check=False
            )
        except (OSError, subprocess.TimeoutExpired):
            return []
        return read_pictures(folder, len(seen_from), size_hw=_SIZE_HW) if done.returncode == 0 else []
