"""Output folders of blocks of a walk, written without running anything."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pano_mvs.geometry import Rigid3, Similarity3
from pano_mvs.io.colmap.writer import write_colmap_model
from pano_mvs.io.ply import write_ply
from pano_mvs.io.ranges import write_confidence_png, write_range_tiff
from pano_mvs.results.records import PairLink, PosesSummary, ViewSummary, WorkflowSummary
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import PointCloud, Poses
from pano_mvs.scene.upright import z_up_from_world
from tests.algorithms.blocks.walked_blocks import walk

SIZE_HW = (32, 64)
RANGE = 2.5
POINTS = np.random.default_rng(5).normal(0, 1.0, (400, 3)) * (6, 1, 6)
"""Sparse points in the true world."""

CLOUD = np.random.default_rng(6).uniform(-1, 1, (3000, 3)) * (7, 1, 7)
"""Dense points in the true world."""


def poses_of(cameras: dict[str, Rigid3], block_from_world: Similarity3, *, noise_rad: float = 0.0) -> Poses:
    """Return poses in the world of a block, with the points that two of the cameras see within 4 units."""
    moved = {name: block_from_world.move_camera(pose) for name, pose in cameras.items()}
    found = Poses.without_points(moved, frame="made up", scale="made up", metric=False)
    centers = np.array([pose.center for pose in cameras.values()])
    near = np.linalg.norm(POINTS[:, None] - centers[None], axis=-1) < 4
    seen = near.sum(axis=1) >= 2
    point_idx, image_idx = np.nonzero(near[seen])
    points = block_from_world.apply(POINTS[seen])
    in_cam = np.einsum("tij,tj->ti", found.rotations[image_idx], points[point_idx] - found.centers[image_idx])
    bearings = in_cam / np.linalg.norm(in_cam, axis=1, keepdims=True)
    bearings += np.random.default_rng(len(cameras)).normal(0, 1, bearings.shape) * noise_rad
    return Poses(
        **{
            **{name: getattr(found, name) for name in ("names", "rotations", "translations", "frame", "scale")},
            "points_in_world": points,
            "point_colors_rgb": np.full((len(points), 3), 99, np.uint8),
            "point_errors_rad": np.zeros(len(points), np.float32),
            "track_point_idx": point_idx.astype(np.int32),
            "track_image_idx": image_idx.astype(np.int32),
            "track_bearings": bearings / np.linalg.norm(bearings, axis=1, keepdims=True),
            "rejected": {},
        }
    )


def write_block(
    out: Path, chosen: list[int], block_from_world: Similarity3, *, cameras: dict[str, Rigid3] | None = None
) -> Poses:
    """Write the output folder of a run over some cameras of a walk of 30, and return its poses."""
    everything = walk(30) if cameras is None else cameras
    names = list(everything)
    poses = poses_of({names[idx % 30]: everything[names[idx % 30]] for idx in chosen}, block_from_world)
    (out / "colmap/sparse/0").mkdir(parents=True)
    write_colmap_model(out / "colmap/sparse/0", poses, dict.fromkeys(poses.names, SIZE_HW))
    points = block_from_world.apply(CLOUD).astype(np.float32)
    count = len(points)
    cloud = PointCloud(
        points,
        np.tile((block_from_world.rotation @ (0, 1, 0)).astype(np.float32), (count, 1)),
        np.full((count, 3), 7, np.uint8),
        np.full(count, 3, np.uint8),
        np.full(count, 200, np.uint8),
        uncertainty=np.full(count, 0.5 * block_from_world.scale, np.float32),
    )
    write_ply(out / "cloud.ply", cloud, quality=True, uncertainty=True, file_from_world=z_up_from_world())
    for folder in ("range", "confidence"):
        (out / folder).mkdir()
    for name in poses.names:
        stem = name.removesuffix(".png")
        write_range_tiff(out / f"range/{stem}.tiff", np.full(SIZE_HW, RANGE * block_from_world.scale, np.float32))
        write_confidence_png(out / f"confidence/{stem}.png", np.full(SIZE_HW, 200, np.uint8))
    RunSummary(
        workflow=WorkflowSummary(name="made up"),
        poses=PosesSummary(
            registered=poses.names,
            centers=tuple((float(x), float(y), float(z)) for x, y, z in poses.centers),
            links=tuple(PairLink(a, b, 50) for a, b in zip(poses.names, poses.names[1:], strict=False)),
        ),
        views=tuple(ViewSummary(name=name, metrics={"completeness": 1.0}) for name in poses.names),
    ).write(out)
    return poses
