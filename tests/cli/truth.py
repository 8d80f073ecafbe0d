"""Errors of a run against the truth of its capture, without the plugin that scores runs."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, pixel_solid_angle
from pano_mvs.geometry.pose_errors import PoseErrors, align_centers, relative_pose_errors
from pano_mvs.io.poses.files import read_poses
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.io.truth import Truth, read_truth


@dataclass(frozen=True)
class RangeErrors:
    """Errors of one range map at the pixels with truth, where a missing range counts as 0."""

    psnr_db: float  # over the pixels, of a peak of 10 units
    mae: float  # by solid angle
    near: float  # the share of the solid angle with errors within a ratio of 1.05
    completeness: float  # the share of pixels that have a range
    median: float  # of the relative errors of those


def pose_errors(out: Path, truth: Path) -> PoseErrors:
    """Return the errors of the poses that a run has written."""
    return relative_pose_errors(read_poses(out).cameras, _cameras(read_truth(truth)))


def range_errors(out: Path, truth: Path, *, folder: str = "range") -> dict[str, RangeErrors]:
    """Return the errors of each range map below a folder of the output, in the unit of the truth."""
    return {stem: _errors(found, true) for stem, (found, true) in _ranges(out, truth, folder).items()}


def constant_errors(truth: Path) -> dict[str, list[RangeErrors]]:
    """Return the errors of many constants in place of each range map."""
    found: dict[str, list[RangeErrors]] = {}
    for stem, true in _true_ranges(read_truth(truth)).items():
        constants = np.quantile(true[np.isfinite(true)], np.linspace(0, 1, 101))
        found[stem] = [_errors(np.full(true.shape, constant), true) for constant in constants]
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


def _errors(estimated: FloatArray, truth: NDArray[np.float32]) -> RangeErrors:
    known = np.isfinite(truth)
    weight = np.broadcast_to(pixel_solid_angle((truth.shape[0], truth.shape[1]))[:, None], truth.shape)[known]
    found, true = estimated[known], truth[known].astype(np.float64)
    has = np.isfinite(found)
    error = np.where(has, np.abs(found - true), true)
    with np.errstate(invalid="ignore"):
        near = np.maximum(found, true) < 1.05 * np.minimum(found, true)
    return RangeErrors(
        psnr_db=float(-10 * np.log10(np.mean((error / 10) ** 2))),
        mae=float(np.average(error, weights=weight)),
        near=float(np.average(near, weights=weight)),
        completeness=float(has.mean()),
        median=float(np.median(error[has] / true[has])),
    )
