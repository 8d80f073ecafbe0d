"""The fused cloud in the page: images from three viewpoints, and thinned points for the viewer in the page."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.rendering import draw_cloud, horizontal_axes, inside_camera, viewpoints
from pano_mvs.core.arrays import FloatArray
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results.pictures import Picture, picture
from pano_mvs.results.records import PosesSummary
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.scene import PointCloud
from pano_mvs.scene.pose_groups import split_groups

PICTURES_VERSION = 2  # raise it when the pictures change: earlier pages' are then drawn again
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
    stem = f"{digest[:24]}.{results.digest('poses')[:16]}.s{PICTURES_VERSION}"
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


POINTS_VERSION = 1  # raise it when the encoding changes: points of earlier pages are then encoded again
MAX_POINTS = 150_000
POINT_BYTES = 12


@dataclass(frozen=True)
class TurnableCloud:
    """What the page's viewer draws."""

    key: str  # of the encoded points among the facts of the page; see `encoded`
    points: int
    total: int  # number of points of the cloud
    # (x, y, z, doubtful, name) in the frame of the viewer; names of at most 200 evenly spaced cameras, the others are
    # ""
    cameras: tuple[tuple[float, float, float, bool, str], ...]


def turnable_cloud(
    values: StoredValues, poses: PosesSummary, earlier: EarlierPage, *, up: FloatArray
) -> TurnableCloud | None:
    """Return the cloud of the largest group of cameras for the viewer; None if there is none.

    The points are kept among the facts of the page, so that the next page can reuse them.
    """
    digest = values.digest("cloud")
    if not digest:
        return None
    key = f"{digest[:24]}.{values.digest('poses')[:16]}.p{POINTS_VERSION}"
    level_from_world = level_axes(up)
    fact = earlier.fact(key)
    if fact is None:
        whole = values.cloud
        cloud = whole.groups()[0] if whole is not None else None
        if cloud is None or len(cloud) < 3:
            return None
        fact = encoded(cloud, level_from_world)
        earlier.keep(key, fact)
    centers = np.array(poses.centers, np.float64).reshape(-1, 3) @ level_from_world.T
    step = -(-len(centers) // 200) or 1
    cameras = tuple(
        (round(x, 4), round(y, 4), round(z, 4), name in poses.doubts, name if idx % step == 0 else "")
        for idx, ((x, y, z), name) in enumerate(zip(centers.tolist(), poses.registered, strict=False))
        if np.isfinite((x, y, z)).all()
    )
    return TurnableCloud(key, int(fact["count"]), int(fact["total"]), cameras)


def level_axes(up: FloatArray) -> FloatArray:
    """Return the rotation (3, 3) from the world into the frame of the viewer: x right, y up, z backward."""
    right, forward = horizontal_axes(up)
    return np.stack([right, up, -forward])


def encoded(cloud: PointCloud, level_from_world: FloatArray) -> dict[str, Any]:
    """Return a cloud of at most 150,000 evenly spread points as a JSON value.

    `data` is base64 of 12 bytes a point: the place in a cube as three uint16, the normal as three int8, the colour as
    three uint8. The cube has its smallest coordinates at `lower` and edges of `size`. `spacing` is a typical distance
    between neighbours; `middle` and `radius` describe a sphere around nearly all points.
    """
    step = -(-len(cloud) // 600_000)
    points = np.asarray(cloud.points_in_world[::step], np.float64) @ level_from_world.T
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    extent = np.maximum(high - low, 1e-6 * (1 + np.abs(points).max()))
    near = np.flatnonzero(((points >= low - extent) & (points <= high + extent)).all(axis=1))
    chosen, spacing = one_per_voxel(points[near], MAX_POINTS)
    kept = near[chosen]
    lower = points[kept].min(axis=0)
    size = float((points[kept].max(axis=0) - lower).max()) or 1.0
    places = np.rint((points[kept] - lower) / size * 65535).astype("<u2")
    normals = np.asarray(cloud.normals_in_world[::step][kept], np.float64) @ level_from_world.T
    packed = np.empty((len(kept), POINT_BYTES), np.uint8)
    packed[:, :6] = np.ascontiguousarray(places).view(np.uint8)
    packed[:, 6:9] = np.rint(normals * 127).clip(-127, 127).astype(np.int8).view(np.uint8)
    packed[:, 9:] = cloud.colors_rgb[::step][kept]
    return {
        "count": len(kept),
        "total": len(cloud),
        "lower": lower.round(5).tolist(),
        "size": round(size, 5),
        "spacing": float(f"{spacing:.4g}"),
        "middle": ((low + high) / 2).round(4).tolist(),
        "radius": round(float(np.linalg.norm(extent)) / 2, 4),
        "data": base64.b64encode(packed.tobytes()).decode("ascii"),
    }


def one_per_voxel(points: FloatArray, most: int) -> tuple[NDArray[np.intp], float]:
    """Return the first point of each voxel, and the edge of the voxels: the smallest that leaves at most `most` points.

    Returns:
        Positions in `points`, ascending, and the edge to about 1 %; if all points are kept, a typical distance.
    """
    origin = points.min(axis=0)
    extent = points.max(axis=0) - origin
    size = float(extent.max()) or 1.0
    shifted = points - origin
    low, high = size / 2**17, size
    chosen = _first_of_voxels(shifted, low)
    if len(chosen) <= most:
        area = 2 * float(extent @ np.roll(extent, 1)) or size**2  # of the box, near to which surfaces usually are
        return chosen, np.sqrt(area / len(chosen))
    chosen = _first_of_voxels(shifted, high)
    for _ in range(14):
        middle = float(np.sqrt(low * high))
        found = _first_of_voxels(shifted, middle)
        if len(found) > most:
            low = middle
        else:
            high, chosen = middle, found
    return chosen, high


def _first_of_voxels(shifted: FloatArray, edge: float) -> NDArray[np.intp]:
    voxels = np.floor(shifted / edge).astype(np.int64)
    _, first = np.unique(voxels @ np.array([1, 1 << 20, 1 << 40]), return_index=True)
    return np.sort(first)
