"""The output of a run in a box whose ranges are known exactly."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, ray_grid
from pano_mvs.io.ranges.files import write_range_tiff
from pano_mvs.results.run_output import RunOutput, load
from pano_mvs.share.frame import page_from_world
from tests.viewer.scenes import HALF, turned_poses, write_output

NAMES = ("lobby/000.png", "lobby/001.png", "lobby/002.png")


def box_ranges(cam_from_world: Rigid3, size_hw: tuple[int, int]) -> NDArray[np.float32]:
    """Return the distances to the walls of the box."""
    rays = ray_grid(size_hw) @ cam_from_world.rotation
    with np.errstate(divide="ignore"):
        along = np.where(rays > 0, HALF - cam_from_world.center, -HALF - cam_from_world.center) / rays
    return np.asarray(np.abs(along).min(axis=-1), np.float32)


def box_run(folder: Path, *, points: int = 20_000, metric: bool = True) -> RunOutput:
    """Write the output of three level cameras in the box, and return it."""
    poses = turned_poses(3, level=True)
    out = write_output(folder, poses, points=points, metric=metric)
    for name, pose in poses.items():
        path = out / "range" / Path(name).with_suffix(".tiff")
        path.parent.mkdir(parents=True, exist_ok=True)
        write_range_tiff(path, box_ranges(pose, (256, 512)))
    summary = json.loads((out / "run.json").read_text())
    summary["views"] = [{"name": name} for name in poses]
    (out / "run.json").write_text(json.dumps(summary))
    return load(out)


def frame_of_page() -> Rigid3:
    """Return page_from_world of that run."""
    return page_from_world(list(turned_poses(3, level=True).values()))
