"""How thick are the walls of a cloud: `python -m tests.benchmarks.walls CLOUD.ply [--poses DIR]`.

Prints for each cloud the median thickness of its surfaces, that is the standard deviation of the neighbours of a point
along their least principal axis, within a radius of 0.4 baselines, and the share of the directions from the cameras in
which there is a point (cells of 4°), which is its completeness. A baseline is the median distance between successive
cameras. Cameras are read from a folder of a COLMAP model, by default from `colmap/` beside the first cloud.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.io.ply import read_ply
from pano_mvs.io.poses.files import read_poses

FloatArray = NDArray[np.float64]

_SAMPLES, _MOST, _LEAST = 2000, 400, 12
_CELL_DEG = 4.0


def thicknesses(points: FloatArray, radius: float) -> FloatArray:
    """Return the thickness of the cloud around at most 2,000 of its points; those with few neighbours are left out."""
    rng = np.random.default_rng(0)
    tree = cKDTree(points)
    found = []
    for idx in rng.choice(len(points), min(_SAMPLES, len(points)), replace=False):
        near = np.array(tree.query_ball_point(points[idx], radius))
        if len(near) < _LEAST:
            continue
        some = points[near if len(near) <= _MOST else rng.choice(near, _MOST, replace=False)]
        found.append(np.linalg.svd(some - some.mean(axis=0), compute_uv=False)[2] / np.sqrt(len(some)))
    return np.array(found)


def completeness(points: FloatArray, centers: FloatArray) -> float:
    """Return the share of the cells of 4° around the cameras in which there is a point."""
    rows = 2 * round(90 / _CELL_DEG)
    columns = np.maximum(1, np.rint(2 * rows * np.cos(np.pi * ((np.arange(rows) + 0.5) / rows - 0.5)))).astype(np.int64)
    occupied = 0
    for center in centers:
        x, y, z = ((points - center) / np.linalg.norm(points - center, axis=1, keepdims=True)).T
        row = np.minimum((np.arcsin(np.clip(y, -1, 1)) / np.pi + 0.5) * rows, rows - 1).astype(np.int64)
        column = np.minimum((np.arctan2(x, z) / (2 * np.pi) + 0.5) * columns[row], columns[row] - 1).astype(np.int64)
        occupied += len(np.unique(row * 4 * rows + column))
    return occupied / float(columns.sum() * len(centers))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print one line for each cloud."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clouds", type=Path, nargs="+", help="PLY files of export.ply")
    parser.add_argument("--poses", type=Path, help="COLMAP model with the cameras")
    parser.add_argument(
        "--within", type=float, default=12.0, help="farthest points, in baselines from the middle camera"
    )
    chosen = parser.parse_args(arguments)
    poses = read_poses(chosen.poses or chosen.clouds[0].parent / "colmap")
    centers = np.array([poses.cam_from_world(idx).center for idx in range(len(poses.names))])
    baseline = float(np.median(np.linalg.norm(np.diff(centers, axis=0), axis=1)))
    for path in chosen.clouds:
        points = read_ply(path).points_in_world.astype(np.float64)
        near = points[np.linalg.norm(points - centers.mean(axis=0), axis=1) < chosen.within * baseline]
        thickness = np.median(thicknesses(near, 0.4 * baseline)) / baseline
        print(
            f"{path}: {len(points)} points, thickness {thickness:.4f} baselines, "
            f"completeness {100 * completeness(near, centers):.1f} %"
        )


if __name__ == "__main__":
    main()
