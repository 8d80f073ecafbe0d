"""A made-up output folder: a cloud on the walls of a box, cameras that are turned at random."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from pano_mvs.geometry import Rigid3, ray_grid, rotation_from_quat_wxyz
from pano_mvs.io.colmap.writer import write_colmap_model
from pano_mvs.io.ply import write_ply
from pano_mvs.scene import PointCloud, Poses
from pano_mvs.scene.image_file import write_png
from pano_mvs.scene.upright import z_up_from_world

SIZE_HW = (64, 128)
HALF = np.array([3.0, 1.5, 4.0])


def turned_poses(count: int, *, seed: int = 0, level: bool = False) -> dict[str, Rigid3]:
    """Return cameras near the middle of the box, turned at random, or about the vertical alone."""
    rng = np.random.default_rng(seed)
    poses = {}
    for idx in range(count):
        quat = rng.normal(size=4) if not level else np.array([1.0, 0, rng.normal(), 0])
        center = rng.uniform(-0.4, 0.4, 3) * HALF
        poses[f"lobby/{idx:03}.png"] = Rigid3.from_center(rotation_from_quat_wxyz(quat / np.linalg.norm(quat)), center)
    return poses


def world_color(directions: np.ndarray) -> np.ndarray:
    """Return a colour for each direction in the world, so that every panorama shows which way it looks."""
    unit = directions / np.linalg.norm(directions, axis=-1, keepdims=True)
    result: np.ndarray = np.rint(128 + 100 * unit).astype(np.uint8)
    return result


def box_cloud(count: int, *, quality: bool) -> PointCloud:
    """Return points on the inner walls of the box, coloured by their place."""
    rng = np.random.default_rng(1)
    points = rng.uniform(-1, 1, (count, 3))
    axis, side = rng.integers(0, 3, count), rng.choice([-1.0, 1.0], count)
    points[np.arange(count), axis] = side
    normals = np.zeros((count, 3), np.float32)
    normals[np.arange(count), axis] = -side
    confidence = rng.integers(1, 256, count).astype(np.uint8) if quality else None
    return PointCloud(
        (points * HALF).astype(np.float32),
        normals,
        world_color(points),
        rng.integers(1, 6, count).astype(np.uint8),
        confidence,
    )


def write_output(
    folder: Path, poses: dict[str, Rigid3], *, points: int = 20_000, quality: bool = False, metric: bool = True
) -> Path:
    """Write what a run would have written: cloud.ply, a COLMAP model, run.json; and the panoramas beside it."""
    out, images = folder / "out", folder / "images"
    out.mkdir(parents=True)
    for name, pose in poses.items():
        (images / name).parent.mkdir(parents=True, exist_ok=True)
        write_png(images / name, world_color(ray_grid(SIZE_HW) @ pose.rotation))
    if points:
        cloud = box_cloud(points, quality=quality)
        write_ply(out / "cloud.ply", cloud, quality=quality, file_from_world=z_up_from_world())
    if poses:
        known = Poses.without_points(poses, frame="box", scale="metres", metric=metric)
        write_colmap_model(out / "colmap" / "sparse" / "0", known, dict.fromkeys(poses, SIZE_HW))
    stages = [{"name": "images", "use": "source.folder", "params": {"path": str(images)}}]
    (out / "run.json").write_text(json.dumps({"stages": stages, "poses": {"metric": metric}, "views": []}))
    return out
