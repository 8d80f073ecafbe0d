"""Poses and range maps of a capture against the truth, by the protocol of the paper's tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.metrics.depth import constant_baseline, depth_metrics
from pano_mvs.algorithms.metrics.poses import align_centers, relative_pose_errors
from pano_mvs.algorithms.metrics.sparsification import sparsify
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Scores

RangeReader = Callable[[], "NDArray[np.float32] | None"]


def score_capture(
    estimated_poses: Mapping[str, Rigid3],
    true_poses: Mapping[str, Rigid3],
    estimated_ranges: Mapping[str, NDArray[np.float32]],
    true_ranges: Mapping[str, RangeReader],
    *,
    confidences: Mapping[str, NDArray[np.uint8]] | None = None,
) -> Scores:
    """Return pose and depth scores.

    Ranges are multiplied by the scale of the similarity that aligns the estimated camera centres with the true ones;
    they are never fitted to the true ranges. Pixels without true surface are left out; a pixel without an estimate
    counts as an error equal to the truth.

    Args:
        estimated_poses: cam_from_world by image.
        true_poses: cam_from_world by image, in the truth's unit.
        estimated_ranges: (H, W) by image, NaN invalid.
        true_ranges: image to a function that returns its (H, W) true range, or None where it is not known.
        confidences: (H, W) by image: how well they rank the errors is scored too where they are given.
    """
    if len(true_poses) < 2:
        return Scores({}, {}, ("no ground truth is known for these pictures",))
    notes: list[str] = []
    errors = relative_pose_errors(estimated_poses, true_poses)
    poses: dict[str, float] = {
        "registered": errors.registered,
        "of": errors.expected,
        "median_pair_error_deg": errors.median_pair_deg,
        "median_rotation_error_deg": float(np.median(errors.rotation_deg)),
        "median_direction_error_deg": float(np.median(errors.direction_deg)),
        **{f"auc_{limit:g}_deg": value for limit, value in errors.auc.items()},
    }
    if np.isfinite(errors.scale_ratio_max):
        poses |= {
            "scale_ratio_error_median": errors.scale_ratio_median,
            "scale_ratio_error_max": errors.scale_ratio_max,
        }
    try:
        scale = align_centers(estimated_poses, true_poses).scale
    except UsageError as error:
        return Scores(poses, {}, (f"ranges are not scored: {error}",))
    views: dict[str, dict[str, float]] = {}
    for name, estimated in estimated_ranges.items():
        truth = true_ranges[name]() if name in true_ranges else None
        if truth is None or truth.shape != estimated.shape:
            notes.append(f"{name}: no true range map of its size")
            continue
        views[name] = _view_scores(np.asarray(estimated), truth, scale)
        confidence = (confidences or {}).get(name)
        judged = np.isfinite(estimated) & np.isfinite(truth)
        if confidence is not None and confidence.shape == truth.shape and judged.any():
            views[name] |= _confidence_scores(np.asarray(estimated), np.asarray(confidence), truth, scale)
    return Scores(poses, views, tuple(notes))


def _view_scores(estimated: NDArray[np.float32], truth: NDArray[np.float32], scale: float) -> dict[str, float]:
    metrics = depth_metrics(estimated, truth, scale=scale)
    constant = constant_baseline(truth)
    return {
        "psnr_db": metrics.psnr_db,
        "w_mae": metrics.w_mae,
        "w_delta_105": metrics.w_delta_105,
        "bad_5": metrics.bad_5,
        "completeness": metrics.completeness,
        "median_relative_error": metrics.median_relative_error,
        "constant_psnr_db": constant.psnr_db,
        "constant_w_delta_105": constant.w_delta_105,
    }


def _confidence_scores(
    estimated: NDArray[np.float32], confidence: NDArray[np.uint8], truth: NDArray[np.float32], scale: float
) -> dict[str, float]:
    curve = sparsify(estimated, confidence, truth, scale=scale)
    return {"sparsification_area": curve.area, "sparsification_oracle_area": curve.oracle_area, "ause": curve.ause}
