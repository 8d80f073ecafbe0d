"""Errors of a run against the truth of its capture, without the plugin that scores runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3
from pano_mvs.geometry.pose_errors import PoseErrors, align_centers, relative_pose_errors
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.io.truth import Truth, read_truth
from tests.oracles.range_errors import RangeErrors, errors_of_ranges


def pose_errors(out: Path, truth: Path) -> PoseErrors:
    """Return the errors of the poses that a run has written."""
    return relative_pose_errors(read_poses(out).cameras, _cameras(read_truth(truth)))


def range_errors(out: Path, truth: Path, *, folder: str = "range") -> dict[str, RangeErrors]:
    """Return the errors of each range map below a folder of the output, in the unit of the truth."""
    return {stem: errors_of_ranges(found, true) for stem, (found, true) in _ranges(out, truth, folder).items()}


def constant_errors(truth: Path) -> dict[str, list[RangeErrors]]:
    """Return the errors of many constants in place of each range map."""
    found: dict[str, list[RangeErrors]] = {}
    for stem, true in _true_ranges(read_truth(truth)).items():
        constants = np.quantile(true[np.isfinite(true)], np.linspace(0, 1, 101))
        found[stem] = [errors_of_ranges(np.full(true.shape, constant), true) for constant in constants]
    return found


def _cameras(truth: Truth) -> dict[str, Rigid3]:
    return {Path(name).name: pose for name, pose in truth.poses.items()}


def _true_ranges(truth: Truth) -> dict[str, NDArray[np.float32]]:
    maps = {Path(view.name).stem: truth.range_map(view) for view in truth.views.values()}
    return {stem: ranges for stem, ranges in maps.items() if ranges is not None}


def _ranges(out: Path, folder: Path, ranges: str) -> dict[str, tuple[FloatArray, NDArray[np.float32]]]:
    truth = read_truth(folder)
    scale = align_centers(read_poses(out).cameras, _cameras(truth)).scale
    return {
        stem: (scale * read_range_tiff(out / ranges / f"{stem}.tiff").astype(np.float64), true)
        for stem, true in _true_ranges(truth).items()
    }
