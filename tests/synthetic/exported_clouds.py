"""A cloud as `export.ply` writes it, in worlds of several axes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pano_mvs.api import Context, PointCloud, Poses, WorldAxes
from pano_mvs.geometry import Rigid3
from pano_mvs.stages.exports.files import PlyParams, ply


def the_cloud(count: int = 300) -> PointCloud:
    """Return points with normals of all directions."""
    rng = np.random.default_rng(7)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = rng.normal(scale=3, size=(count, 3)).astype(np.float32)
    return PointCloud(points, normals.astype(np.float32), np.zeros((count, 3), np.uint8), np.full(count, 3, np.uint8))


def the_poses(axes: WorldAxes = WorldAxes.LEVEL, rotation: np.ndarray | None = None) -> Poses:
    """Return one camera at the origin."""
    pose = Rigid3(np.eye(3) if rotation is None else rotation, np.zeros(3))
    return Poses.without_points({"a.png": pose}, frame="", scale="", metric=False, axes=axes)


def exported(folder: Path, poses: Poses | None, **settings: object) -> Path:
    """Write the cloud into a folder by `export.ply`, and return the file."""
    params = PlyParams.model_validate(settings)
    return ply(the_cloud(), poses, params, Context(np.random.default_rng(0), folder)).files["cloud.ply"]
