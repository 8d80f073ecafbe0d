"""Scores of a capture's poses and range maps, by the protocol of the paper's tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.evaluation.poses import PoseErrors, align_centers, relative_pose_errors
from pano_mvs.evaluation.ranges.pairs import resized_labels, resized_range
from pano_mvs.evaluation.ranges.view_scores import score_view
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Scores
from pano_mvs.scene.scores import NO_TRUTH

KEPT = "psnr_db", "w_mae", "w_delta_105", "bad_5", "completeness", "median_relative_error"
KEPT_OF_CONFIDENCE = "sparsification_area", "sparsification_oracle_area", "ause"
Scalar = TypeVar("Scalar", bound=np.generic)
RangeReader = Callable[[], "NDArray[np.float32] | None"]

_NOTHING: Mapping[str, Any] = MappingProxyType({})


def score_capture(
    estimated_poses: Mapping[str, Rigid3],
    true_poses: Mapping[str, Rigid3],
    *,
    estimated_ranges: Mapping[str, NDArray[np.float32]] = _NOTHING,
    true_ranges: Mapping[str, RangeReader] = _NOTHING,
    confidences: Mapping[str, NDArray[np.uint8]] = _NOTHING,
    masks: Mapping[str, NDArray[np.bool_]] = _NOTHING,
    groups: Mapping[str, int] | None = None,
) -> Scores:
    """Return pose and depth scores.

    Ranges are multiplied by the scale of the similarity that aligns the camera centres of the view's group with the
    true ones; they are never fitted to the true ranges. Pixels without true surface are ignored; a pixel without an
    estimate has an error equal to the truth. Scores are named as in `score_view`. The prefix `constant_` marks the
    score of the median of the view's true ranges, `best_constant_` that of the best constant for the score. Median
    errors of poses are those of the pairs that can be measured, and are missing if there are none; in the areas under
    the recall curve the other pairs count as 180° off.

    Args:
        estimated_poses: cam_from_world by image.
        true_poses: cam_from_world by image, in the truth's unit.
        estimated_ranges: (H, W) by image, NaN invalid; resampled to the truth's size if needed.
        true_ranges: image to a function that returns its (H, W) true range, or None if unknown.
        confidences: (H, W) by image; if given, their ranking of the errors is scored too.
        masks: (H, W) by image, False excludes a pixel from the scores.
        groups: group number of each estimated pose, if the groups have different worlds; None: all share one.
    """
    if len(true_poses) < 2:
        return Scores({}, {}, (NO_TRUTH,))
    group_of = groups or {}
    notes: list[str] = []
    errors = relative_pose_errors(estimated_poses, true_poses, groups=groups)
    poses = _pose_scores(errors)
    if len(numbers := set(group_of.values())) > 1:
        poses["registered_in_one_frame"] = errors.in_one_frame
        notes.append(
            f"the poses are in {len(numbers)} groups, each with its own frame and scale: pairs across groups "
            "cannot be measured and count as not registered; each group is aligned separately"
        )
    scales, refused = _scales(estimated_poses, true_poses, group_of)
    if not scales:
        return Scores(poses, {}, (*notes, *(f"ranges are not scored: {why}" for why in refused.values())))
    notes += [f"the ranges of group {number} are not scored: {why}" for number, why in refused.items()]
    views: dict[str, dict[str, float]] = {}
    for name, estimated in estimated_ranges.items():
        scale = scales.get(group_of.get(name, 0))
        if scale is None:
            continue
        truth = true_ranges[name]() if name in true_ranges else None
        if truth is None:
            notes.append(f"{name}: no true range map")
            continue
        size_hw = truth.shape[0], truth.shape[1]
        views[name] = _view_scores(
            resized_range(np.asarray(estimated), size_hw),
            truth,
            scale,
            confidence=_of_size(confidences.get(name), size_hw),
            mask=_of_size(masks.get(name), size_hw),
        )
    return Scores(poses, views, tuple(notes))


def _pose_scores(errors: PoseErrors) -> dict[str, float]:
    scores: dict[str, float] = {
        "registered": errors.registered,
        "of": errors.expected,
    }
    if errors.measured.any():
        of_kind = {"pair": errors.pair_deg, "rotation": errors.rotation_deg, "direction": errors.direction_deg}
        for kind, error_deg in of_kind.items():
            scores[f"median_{kind}_error_deg"] = float(np.median(error_deg[errors.measured]))
    scores |= {f"auc_{limit:g}_deg": value for limit, value in errors.auc.items()}
    if np.isfinite(errors.scale_ratio_max):
        scores["scale_ratio_error_median"] = errors.scale_ratio_median
        scores["scale_ratio_error_max"] = errors.scale_ratio_max
    return scores


def _scales(
    estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3], groups: Mapping[str, int]
) -> tuple[dict[int, float], dict[int, str]]:
    """Return the scale from each group to the truth, and the groups without a scale with the reason."""
    scales, refused = {}, {}
    for number in sorted({groups.get(name, 0) for name in estimated}) or [0]:
        own = {name: pose for name, pose in estimated.items() if groups.get(name, 0) == number}
        try:
            scales[number] = align_centers(own, truth).scale
        except UsageError as error:
            refused[number] = str(error)
    return scales, refused


def _of_size(labels: NDArray[Scalar] | None, size_hw: tuple[int, int]) -> NDArray[Scalar] | None:
    return None if labels is None else resized_labels(np.asarray(labels), size_hw)


def _view_scores(
    estimated: NDArray[np.float32],
    truth: NDArray[np.float32],
    scale: float,
    *,
    confidence: NDArray[np.uint8] | None,
    mask: NDArray[np.bool_] | None,
) -> dict[str, float]:
    """Return the scores that a run records, then those of constants by the same names.

    Scores that are not finite (the median of no pixels, the PSNR of no error) are omitted.
    """
    found = score_view(estimated, truth, scale=scale, confidence=confidence, mask=mask)
    scores = {name: found.scores[name] for name in (*KEPT, *KEPT_OF_CONFIDENCE) if name in found.scores}
    for prefix, constants in (("constant_", found.constants["median"]), ("best_constant_", found.constants["best"])):
        scores |= {f"{prefix}{name}": constants[name] for name in (*KEPT, "ause") if name in constants}
    always = {"constant_completeness", "best_constant_completeness"}
    return {name: value for name, value in scores.items() if np.isfinite(value) and name not in always}
