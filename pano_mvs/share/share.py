"""Write a run as a page that opens in any browser."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError
from pano_mvs.core.paths import is_file, resolved
from pano_mvs.geometry import Rigid3
from pano_mvs.results.run_output import RunOutput, RunView
from pano_mvs.scene import PointCloud
from pano_mvs.scene.image_files.image_file import decode_image
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.upright import states_y_down
from pano_mvs.share.encoding import encode_jpeg, encode_points, encode_ranges
from pano_mvs.share.frame import page_from_world
from pano_mvs.share.octree import octree
from pano_mvs.share.options import ShareOptions
from pano_mvs.share.page_folder import PageFolder
from pano_mvs.share.tiles import level_count, panorama_tiles

RANGES_HW = (256, 512)
"""Size of the range map that the page walks and measures on."""

Progress = Callable[[int, int], None]
"""Receives the number of panoramas that are written, and of all."""


@dataclass(frozen=True)
class Shared:
    """What was written.

    Attributes:
        page: the page to open, which needs its folder.
        single_file: the same as one file; None if it would be too large.
        points: number of points of the cloud.
        panoramas: number of panoramas.
        total_bytes: size of the data.
        notes: what is missing.
    """

    page: Path
    single_file: Path | None
    points: int
    panoramas: int
    total_bytes: int
    notes: tuple[str, ...] = ()


def share_run(
    run: RunOutput,
    folder: Path,
    options: ShareOptions | None = None,
    *,
    images: Path | None = None,
    progress: Progress | None = None,
) -> Shared:
    """Write a page with the cloud, the cameras and the panoramas of a run; of several groups the largest is shown.

    >>> import pano_mvs
    >>> shared = share_run(pano_mvs.load("out"), Path("page"))
    >>> shared.page.name, shared.panoramas
    ('index.html', 4)

    Args:
        run: the output of a run.
        folder: a new folder, or one that holds an earlier page.
        options: what the page contains.
        images: folder of the panoramas, if they were moved.
        progress: is called after each panorama.

    Raises:
        InputError: if the run has neither a cloud nor cameras.
        UsageError: if the folder holds something else.
        StoreError: if a file cannot be written.
    """
    options = options or ShareOptions()
    poses = split_groups(run.poses)[0] if run.poses is not None else None
    cloud = run.cloud.groups()[0] if run.cloud is not None else None
    if poses is None and (cloud is None or not len(cloud)):
        raise InputError(f"{run.out}: has neither a cloud nor cameras to show. Look at its report.html")
    notes = [] if cloud is not None else ["the run has no cloud; the page shows the panoramas alone"]
    if len(run.summary.poses.by_group()) > 1:
        notes.append("the page shows the largest group of panoramas; each group has a frame of its own")
    cameras = [poses.cam_from_world(idx) for idx in range(len(poses.names))] if poses is not None else []
    frame = page_from_world(cameras, is_level=states_y_down(run.summary.poses.by_group()[0].frame))
    page = PageFolder(folder)
    nodes, bounds = _put_cloud(page, cloud, frame, max_points=options.max_points)
    described = []
    for idx, camera in enumerate(cameras):
        name = poses.names[idx] if poses is not None else ""
        view = run.views.get(name)
        image = _image(view, images / name if images is not None else None)
        pose = camera @ frame.inverse()
        described.append(
            {"name": name} | _put_camera(page, idx, view=view, image=image, cam_from_page=pose, options=options)
        )
        if progress is not None:
            progress(idx + 1, len(cameras))
    if missing := [entry["name"] for entry in described if not entry["levels"]]:
        notes.append(
            f"{len(missing)} of {len(described)} panoramas could not be read, such as {missing[0]}; give their folder "
            "with --images DIR"
        )
    title = options.title or resolved(run.out).name
    metric = run.summary.poses.by_group()[0].metric
    page.put(
        "scene",
        {
            "title": title,
            "unit": "m" if metric else "units",
            "cameras": described,
            "nodes": nodes,
            "bounds": bounds,
            "ranges": list(RANGES_HW),
        },
    )
    single = page.finish(title, max_single_file_bytes=options.max_single_file_bytes)
    return Shared(
        folder / "index.html",
        single,
        sum(node["count"] for node in nodes),
        sum(bool(entry["levels"]) for entry in described),
        sum(page.written.values()),
        tuple(notes),
    )


def _put_cloud(
    page: PageFolder, cloud: PointCloud | None, frame: Rigid3, *, max_points: int
) -> tuple[list[dict[str, Any]], list[list[float]]]:
    """Write the octree; return its nodes and the box that holds all but the outermost percent of the points."""
    if cloud is None or not len(cloud):
        return [], []
    chosen = np.arange(len(cloud))
    if 0 < max_points < len(cloud):
        chosen = np.sort(np.random.default_rng(0).choice(len(cloud), max_points, replace=False))
    points = frame.apply(cloud.points_in_world[chosen]).astype(np.float32)
    turned = PointCloud(
        points,
        (cloud.normals_in_world[chosen] @ frame.rotation.T).astype(np.float32),
        cloud.colors_rgb[chosen],
        cloud.view_counts[chosen],
    )
    nodes = octree(points)
    for node in nodes:
        page.put(f"cloud/{node.name}", encode_points(node, turned))
    described = [
        {"name": node.name, "lower": node.lower.tolist(), "size": node.size, "count": len(node.chosen)}
        for node in nodes
    ]
    return described, np.percentile(points, [1, 99], axis=0).astype(float).tolist()


def _image(view: RunView | None, path: Path | None) -> NDArray[np.uint8] | None:
    """Return a panorama from the given file if that exists, else from where the run found it."""
    if path is not None and is_file(path):
        return decode_image(path)
    return view.image if view is not None else None


def _put_camera(
    page: PageFolder,
    idx: int,
    *,
    view: RunView | None,
    image: NDArray[np.uint8] | None,
    cam_from_page: Rigid3,
    options: ShareOptions,
) -> dict[str, Any]:
    """Write the tiles and the ranges of a panorama, and return what the page needs to know of it."""
    levels = level_count(image.shape[1], options.max_width) if image is not None else 0
    if image is not None:
        for level, column, row, tile in panorama_tiles(image, levels):
            page.put(f"panorama/{idx}/{level}-{column}-{row}", encode_jpeg(tile, options.jpeg_quality))
    ranges = view.range_map if view is not None else None
    text, low, high = encode_ranges(_reduced(ranges)) if ranges is not None else ("", 1.0, 2.0)
    if text:
        page.put(f"panorama/{idx}/ranges", text)
    return {
        "center": cam_from_page.center.tolist(),
        "page_from_cam": cam_from_page.rotation.T.tolist(),
        "levels": levels,
        "ranges": [low, high] if text else None,
    }


def _reduced(ranges: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a range map at the size of the page's: single values, because a mean of two surfaces lies on neither."""
    return np.asarray(cv2.resize(ranges, RANGES_HW[::-1], interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
