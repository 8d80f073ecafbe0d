"""The output of a run in a box whose ranges and colours are known exactly."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pano_mvs_page.share import page_from_world

from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.io.ply import MeshArrays, write_ply, write_ply_mesh
from pano_mvs.io.ranges import write_range_tiff
from pano_mvs.results.run_output import RunOutput, load
from pano_mvs.scene.image_file import write_png
from tests.synthetic.viewed_scenes import HALF, box_cloud, turned_poses, write_output

NAMES = ("lobby/000.png", "lobby/001.png", "lobby/002.png")
POINT_SIGMA = 0.013
"""Standard deviation of each point of the cloud."""
RELATIVE_SIGMA = 0.01
"""Standard deviation of each range, divided by the range."""

_SIZE_HW = (256, 512)


def box_ranges(cam_from_world: Rigid3, size_hw: tuple[int, int]) -> NDArray[np.float32]:
    """Return the distances to the walls of the box."""
    rays = ray_grid(size_hw) @ cam_from_world.rotation
    return wall_range(cam_from_world.center, rays).astype(np.float32)


def wall_range(center: NDArray[np.float64], rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the distances from a place to the walls along rays (..., 3)."""
    with np.errstate(divide="ignore"):
        along = np.where(rays > 0, HALF - center, -HALF - center) / rays
    return np.asarray(np.abs(along).min(axis=-1))


def wall_color(points: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return the colours of places (..., 3) on the walls, which differ from place to place."""
    return np.asarray(np.rint(128 + 90 * np.sin(2 * points)), np.uint8)


def box_mesh(across_wall: int = 12) -> MeshArrays:
    """Return the walls as triangles that face the inside; each wall has so many cells along its sides."""
    count = across_wall + 1
    steps = np.linspace(-1, 1, count)
    first = (np.arange(across_wall)[:, None] * count + np.arange(across_wall)).reshape(-1)
    cells = np.stack([first, first + 1, first + count + 1, first, first + count + 1, first + count], axis=-1)
    points: list[NDArray[np.float64]] = []
    faces: list[NDArray[np.int64]] = []
    for axis in range(3):
        for side in (-1.0, 1.0):
            across, down = np.meshgrid(steps, steps, indexing="ij")
            wall = np.empty((across.size, 3))
            wall[:, axis] = side
            wall[:, (axis + 1) % 3], wall[:, (axis + 2) % 3] = across.ravel(), down.ravel()
            corners = cells.reshape(-1, 3)
            faces.append((corners[:, ::-1] if side < 0 else corners) + len(points) * across.size)
            points.append(wall * HALF)
    vertices = np.concatenate(points)
    return vertices.astype(np.float32), wall_color(vertices), np.concatenate(faces).astype(np.int32)


def box_run(folder: Path, *, points: int = 20_000, metric: bool = True, mesh: bool | int = False) -> RunOutput:
    """Write the output of three level cameras in the box, and return it.

    `mesh`: whether there is one, or how many cells its walls have along their sides.
    """
    poses = turned_poses(3, level=True)
    out = write_output(folder, poses, points=0, metric=metric)
    cloud = box_cloud(points, quality=True)
    sigmas = np.full(points, POINT_SIGMA, np.float32)
    cloud = replace(cloud, colors_rgb=wall_color(cloud.points_in_world.astype(np.float64)), uncertainty=sigmas)
    write_ply(out / "cloud.ply", cloud, quality=True, uncertainty=True)
    if mesh:
        write_ply_mesh(out / "mesh.ply", box_mesh() if mesh is True else box_mesh(mesh))
    for name, pose in poses.items():
        ranges = box_ranges(pose, _SIZE_HW)
        for kind, values in (("range", ranges), ("uncertainty", np.full_like(ranges, RELATIVE_SIGMA))):
            path = out / kind / Path(name).with_suffix(".tiff")
            path.parent.mkdir(parents=True, exist_ok=True)
            write_range_tiff(path, values)
        walls = pose.center + ranges[..., None] * (ray_grid(_SIZE_HW) @ pose.rotation)
        write_png(folder / "images" / name, wall_color(walls))
    summary = json.loads((out / "run.json").read_text())
    summary["views"] = [{"name": name} for name in poses]
    (out / "run.json").write_text(json.dumps(summary))
    return load(out)


def frame_of_page() -> Rigid3:
    """Return page_from_world of that run."""
    return page_from_world(list(turned_poses(3, level=True).values()))
