"""Images of the fused cloud from three viewpoints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.rendering import draw_cloud, inside_camera, viewpoints
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results.pictures import Picture, picture
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene.pose_groups import split_groups

VERSION = 2  # raise it when the pictures change: earlier pages' are then drawn again
_SIZE_HW = (600, 960)
MAX_BYTES = 300_000


@dataclass(frozen=True)
class CloudPictures:
    """The pictures of a cloud."""

    shown: tuple[tuple[str, Picture], ...] = ()
    note: str = ""


def cloud_pictures(results: StoredValues, kept: EarlierPage, *, up: NDArray[np.float64]) -> CloudPictures:
    """Return images of the cloud, reusing those of an earlier page if they show the same cloud.

    If there are several groups of poses, the largest is shown.
    """
    digest = results.digest("cloud")
    if not digest:
        return CloudPictures()
    stem = f"{digest[:24]}.{results.digest('poses')[:16]}.s{VERSION}"
    known = kept.fact(stem)
    earlier = [kept.picture(f"{stem}.{number}") for number in range(3)]
    if known is not None and all(earlier):
        pairs = tuple((title, found) for title, found in zip(known["titles"], earlier, strict=True) if found)
        return CloudPictures(pairs, known["note"])
    whole, all_poses = results.cloud, results.poses
    if whole is None or not len(whole.groups()[0]):
        return CloudPictures()
    cloud, poses = whole.groups()[0], None if all_poses is None else split_groups(all_poses)[0]
    centers = poses.centers if poses is not None else np.zeros((0, 3))
    place = poses.names[inside_camera(centers)] if poses is not None and len(centers) else ""
    step = -(-len(cloud) // 800_000)
    arrays = (
        np.ascontiguousarray(cloud.points_in_world[::step]),
        np.ascontiguousarray(cloud.normals_in_world[::step]),
        np.ascontiguousarray(cloud.colors_rgb[::step]),
    )
    seen_from = viewpoints(arrays[0], centers, up, aspect=_SIZE_HW[1] / _SIZE_HW[0], place=place)
    images = [draw_cloud(*arrays, viewpoint=view, size_hw=_SIZE_HW) for view in seen_from]
    others = "the clouds of the others are cloud_1.ply … (pano-mvs view OUT --group 1)"
    note = f"this is group 0 of the poses, the largest; {others}" if whole.group_sizes else ""
    titles = [view.title for view in seen_from]
    kept.keep(stem, {"titles": titles, "note": note})
    return CloudPictures(
        tuple(
            (title, picture(image, width=_SIZE_HW[1], most_bytes=MAX_BYTES, key=f"{stem}.{number}"))
            for number, (title, image) in enumerate(zip(titles, images, strict=True))
        ),
        note,
    )
