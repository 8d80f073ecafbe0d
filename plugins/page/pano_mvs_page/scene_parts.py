"""The parts of a scene that are written into a page: cloud, mesh, map and cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import scipy
from numpy.typing import NDArray

from pano_mvs.algorithms.points.octree import octree
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, spiral_rays
from pano_mvs.scene import PointCloud
from pano_mvs_page.encoding import (
    LogSteps,
    VertexFacts,
    encode_arrays,
    encode_jpeg,
    encode_points,
    encode_ranges,
    encode_webp,
    log_steps,
    mesh_pieces,
    panorama_tiles,
    tile_layout,
)
from pano_mvs_page.maps import MapPlace, StoreyMap, cut_height, place_around, top_view
from pano_mvs_page.mesh_file import SharedMesh, coarser
from pano_mvs_page.page_folder import PageFolder

RANGES_HW = (256, 512)  # size of the range map that the page walks and measures on


@dataclass(frozen=True)
class ShareOptions:
    """What a shared page contains."""

    title: str = ""  # heading of the page; empty for the name of the capture's folder
    max_points: int = 1_500_000  # largest number of points of the cloud; 0 for none. Those kept are drawn at random.
    max_triangles: int = 300_000  # about the largest number of triangles of a mesh without texture; 0 for no mesh
    max_width: int = 8192  # largest width of a panorama in pixels, at least 1024
    jpeg_quality: int = 85  # of the panoramas, 1 to 100
    # names or patterns of panoramas by room, or the file that `--rooms` takes; None to take them from folders, names,
    # or what is seen
    rooms: Mapping[str, Sequence[str]] | str | Path | None = None
    max_single_file_bytes: int = 40_000_000  # size up to which everything is also written as one HTML file

    def __post_init__(self) -> None:
        """Raise UsageError if an option is out of its range."""
        if self.max_points < 0:
            raise UsageError(f"--points {self.max_points}: give a number of points, or 0 for none")
        if self.max_triangles < 0:
            raise UsageError(f"--triangles {self.max_triangles}: give a number of triangles, or 0 for no mesh")
        if self.max_width < 1024:
            raise UsageError(f"--width {self.max_width}: panoramas need at least 1024 pixels")
        if not 1 <= self.jpeg_quality <= 100:
            raise UsageError(f"--quality {self.jpeg_quality}: give 1 to 100")


@dataclass(frozen=True, eq=False)
class ShownCloud:
    """A cloud as the page shows it."""

    cloud: PointCloud
    sigmas: LogSteps

    def facts(self, vertices: NDArray[np.float32]) -> VertexFacts:
        """Return what is known of the nearest point of each vertex; nothing if the cloud is empty."""
        if not len(self.cloud) or not len(vertices):
            return VertexFacts(np.zeros(len(vertices), np.uint8), np.zeros(len(vertices), np.uint8))
        nearest = scipy.spatial.cKDTree(self.cloud.points_in_world).query(vertices)[1]
        return VertexFacts(self.sigmas.steps[nearest].astype(np.uint8), self.cloud.view_counts[nearest])


def shown_cloud(cloud: PointCloud | None, frame: Rigid3, *, max_points: int) -> ShownCloud:
    """Return a cloud with at most `max_points` points, drawn at random, in the frame of the page."""
    if cloud is None:
        empty = np.zeros((0, 3), np.float32)
        cloud = PointCloud(empty, empty, np.zeros((0, 3), np.uint8), np.zeros(0, np.uint8))
    chosen = np.arange(len(cloud))
    if max_points < len(cloud):
        chosen = np.sort(np.random.default_rng(0).choice(len(cloud), max_points, replace=False))
    kept = cloud.some(chosen)
    turned = replace(
        kept,
        points_in_world=frame.apply(kept.points_in_world).astype(np.float32),
        normals_in_world=(kept.normals_in_world @ frame.rotation.T).astype(np.float32),
    )
    sigmas = kept.uncertainty if kept.uncertainty is not None else np.zeros(len(kept))
    return ShownCloud(turned, log_steps(sigmas, np.uint8))


def put_cloud(page: PageFolder, shown: ShownCloud) -> dict[str, Any]:
    """Write the octree; return its nodes and the box that holds all but the outermost percent of the points."""
    points = shown.cloud.points_in_world
    nodes = octree(points)
    for node in nodes:
        page.put(f"cloud/{node.name}", encode_points(node, shown.cloud, shown.sigmas.steps))
    return {
        "nodes": [
            {"name": node.name, "lower": node.lower.tolist(), "size": node.size, "count": len(node.chosen)}
            for node in nodes
        ],
        "bounds": np.percentile(points, [1, 99], axis=0).astype(float).tolist() if len(points) else [],
        "sigmas": [shown.sigmas.low, shown.sigmas.high],
        "coverage": bool(shown.cloud.view_counts.any()),
    }


def outline(points: NDArray[np.float32]) -> list[list[float]]:
    """Return at most 64 of the outermost points, [x, y, z], but no strays: the page opens with all of them in view."""
    sampled = points[:: max(1, len(points) // 50_000)].astype(np.float64)
    if not len(sampled):
        return []
    along = sampled @ spiral_rays(64).T
    outer = round(0.995 * (len(sampled) - 1))
    outermost: list[list[float]] = np.unique(sampled[np.argpartition(along, outer, axis=0)[outer]], axis=0).tolist()
    return outermost


def put_mesh(page: PageFolder, mesh: SharedMesh, shown: ShownCloud, *, jpeg_quality: int) -> dict[str, Any]:
    """Write the pieces and the texture of a mesh in the frame of the page; return what the page needs to know of it.

    A mesh that would arrive slowly is preceded by a coarse one.
    """
    # About the number of triangles of the mesh that the page shows first: 0.6 MB, half a second at 10 Mbit/s.
    coarse = coarser(mesh, 40_000)
    described: dict[str, list[dict[str, Any]]] = {"mesh": [], "mesh/coarse": []}
    for folder, part in (("mesh", mesh), ("mesh/coarse", coarse)):
        for idx, (piece, text) in enumerate(mesh_pieces(part, shown.facts(part.vertices)) if part is not None else ()):
            page.put(f"{folder}/{idx}", text)
            described[folder].append(piece)
    if mesh.texture is not None:
        # Largest width and height of the texture of a mesh, which all graphics processors in use can hold.
        shrink = min(1.0, 4096 / max(mesh.texture.shape[:2]))
        size = (max(1, round(mesh.texture.shape[1] * shrink)), max(1, round(mesh.texture.shape[0] * shrink)))
        texture = mesh.texture if shrink == 1 else cv2.resize(mesh.texture, size, interpolation=cv2.INTER_AREA)
        page.put("mesh/texture", encode_jpeg(np.asarray(texture, np.uint8), jpeg_quality))
    return {
        "pieces": described["mesh"],
        "coarse": described["mesh/coarse"],
        "textured": mesh.texture is not None,
        "bounds": np.percentile(mesh.vertices, [1, 99], axis=0).astype(float).tolist(),
    }


def put_maps(
    page: PageFolder, shown: ShownCloud, plans: Sequence[StoreyMap], *, centers: NDArray[np.float64]
) -> list[dict[str, Any]]:
    """Write the floor plans, or without them the cloud from above; return where they lie."""
    if plans:
        return [
            _put_map(page, number, plan.place, colors=encode_webp(plan.picture), shown=shown, heights=plan.heights)
            for number, plan in enumerate(plans)
        ]
    if not len(shown.cloud):
        return []
    place = place_around(shown.cloud.points_in_world, centers)
    heights = (-np.inf, cut_height(shown.cloud.points_in_world, centers))
    colors = encode_webp(top_view(shown.cloud, place, heights)[0])
    return [_put_map(page, 0, place, colors=colors, shown=shown, heights=heights)]


def _put_map(
    page: PageFolder,
    number: int,
    place: MapPlace,
    *,
    colors: str,
    shown: ShownCloud,
    heights: tuple[float, float],
) -> dict[str, Any]:
    page.put(f"map/{number}/colors", colors)
    coverage = top_view(shown.cloud, place, heights)[1] if len(shown.cloud) else None
    if coverage is not None:
        page.put(f"map/{number}/coverage", encode_webp(coverage))
    return {
        "page_from_map": [*place.corner.tolist(), *place.right.tolist(), *place.down.tolist()],
        "aspect": float(np.linalg.norm(place.right) / np.linalg.norm(place.down)),
        "coverage": coverage is not None,
        "heights": list(heights) if np.isfinite(heights).all() else None,
    }


def put_camera(
    page: PageFolder,
    idx: int,
    *,
    ranges: NDArray[np.float32] | None,
    relative: NDArray[np.float32] | None,
    image: NDArray[np.uint8] | None,
    cam_from_page: Rigid3,
    options: ShareOptions,
) -> dict[str, Any]:
    """Write the tiles, the ranges and their uncertainty of a panorama; return what the page needs to know of it.

    Args:
        page: the page.
        idx: number of the panorama.
        ranges: `RANGES_HW` float32 in units of the page, if it has any.
        relative: standard deviations of the ranges divided by the ranges, of the same size, if known.
        image: the panorama, if it could be read.
        cam_from_page: its pose.
        options: of the page.
    """
    levels, tile_width = tile_layout(image.shape[1], options.max_width) if image is not None else (0, 0)
    if image is not None:
        for level, column, row, tile in panorama_tiles(image, levels, tile_width):
            page.put(f"panorama/{idx}/{level}-{column}-{row}", encode_jpeg(tile, options.jpeg_quality))
    text, low, high = encode_ranges(ranges) if ranges is not None else ("", 1.0, 2.0)
    if text:
        page.put(f"panorama/{idx}/ranges", text)
    sigmas = log_steps(relative, np.uint8) if relative is not None and text else None
    if sigmas is not None:
        page.put(f"panorama/{idx}/sigmas", encode_arrays(sigmas.steps))
    return {
        "center": cam_from_page.center.tolist(),
        "page_from_cam": cam_from_page.rotation.T.tolist(),
        "levels": levels,
        "width": (tile_width << levels) // 2,
        "ranges": [low, high] if text else None,
        "sigmas": [sigmas.low, sigmas.high] if sigmas is not None else None,
    }


def reduced(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a map at the size of the page's: single values, because a mean of two surfaces lies on neither."""
    return np.asarray(cv2.resize(values, RANGES_HW[::-1], interpolation=cv2.INTER_NEAREST_EXACT), np.float32)
