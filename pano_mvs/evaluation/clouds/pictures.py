"""Where the errors of a cloud are: clouds coloured by them, and pictures of these."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.cli.evaluate.cloud import JudgedCloud
from pano_mvs.evaluation.clouds.distances import PointChunks
from pano_mvs.evaluation.clouds.error_cloud import write_error_cloud
from pano_mvs.evaluation.clouds.overview import write_cloud_picture
from pano_mvs.evaluation.clouds.views import write_cloud_views

_MOST_POINTS, _MOST_VIEWS = 2_000_000, 12


def write_overview(path: Path, judged: JudgedCloud) -> None:
    """Write a PNG of what was found of the surface in the views that were used, and of the cloud from above.

    Of many views those are shown of whose surface least was found.
    """
    compared, surface, limit = judged.compared, judged.compared.surface, judged.thresholds[-1]
    missed = surface.area * (judged.distances.of_surface > limit)
    lost = np.bincount(surface.view_idx, missed, max(1, len(compared.used)))
    shown = sorted(np.argsort(-lost, kind="stable")[:_MOST_VIEWS])
    maps = {}
    for idx, (name, view) in enumerate(compared.used.items()):
        if idx not in shown:
            continue
        panorama = np.full(view.range.shape, np.nan, np.float32)
        own = surface.view_idx == idx
        panorama.reshape(-1)[surface.pixel_idx[own]] = judged.distances.of_surface[own]
        maps[name] = panorama
    points, _, distances = _some_points(judged)
    write_cloud_picture(path, maps, points, distances, limits=judged.thresholds)


def write_error_clouds(folder: Path, judged: JudgedCloud) -> None:
    """Write accuracy.ply, completeness.ply, a picture of each, and errors.png with the views.

    Both clouds lie in the truth's frame: the points that were judged by their distance from the true surface, and the
    surface that was to be found by its distance from the points.
    """
    surface, limits = judged.compared.surface, judged.thresholds
    write_error_cloud(folder / "accuracy.ply", judged.points(), judged.distances.of_points, limits=limits,
                      farthest=judged.farthest)  # fmt: skip
    write_error_cloud(folder / "completeness.ply", PointChunks.of(surface.points_in_world).read(),
                      judged.distances.of_surface, limits=limits, farthest=judged.farthest)  # fmt: skip
    cameras, up = judged.compared.cameras, judged.compared.up
    write_cloud_views(folder / "accuracy.png", *_some_points(judged), limits=limits, cameras=cameras, up=up,
                      title="cloud by its distance from the true surface")  # fmt: skip
    step = -(-len(surface.points_in_world) // _MOST_POINTS) or 1
    write_cloud_views(folder / "completeness.png", surface.points_in_world[::step], _towards_cameras(judged, step),
                      judged.distances.of_surface[::step], limits=limits, cameras=cameras, up=up,
                      title="true surface by its distance from the cloud")  # fmt: skip
    write_overview(folder / "errors.png", judged)


def _some_points(judged: JudgedCloud) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Return places and normals (0 where not known) in the truth's frame, and distances, of no more than are drawn."""
    step = -(-judged.file.count // _MOST_POINTS) or 1
    points, normals = judged.file.some(step)
    moved = judged.truth_from_cloud
    if moved is not None:
        points = moved.apply(points).astype(np.float32)
        normals = (normals @ moved.rotation.T).astype(np.float32)
    return points, normals, judged.distances.of_points[::step]


def _towards_cameras(judged: JudgedCloud, step: int) -> NDArray[np.float32]:
    """Return unit vectors (N, 3) from samples of the surface to the cameras that saw them; 0 for a reference cloud."""
    surface = judged.compared.surface
    points = surface.points_in_world[::step]
    if not judged.compared.used:
        return np.zeros_like(points)
    centers = np.array([view.cam_from_world.center for view in judged.compared.used.values()])
    towards = centers[surface.view_idx[::step]] - points
    return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True), np.float32)
