"""Scores of a capture's poses and range maps, by the protocol of the paper's tables, and of a finished run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.core.paths import is_file, is_folder
from pano_mvs.geometry import Rigid3
from pano_mvs.geometry.pose_errors import PoseErrors, align_centers, relative_pose_errors
from pano_mvs.io.colmap.reader import is_colmap_model
from pano_mvs.io.images.names import pair_image_names
from pano_mvs.io.truth import camera_groups, find_ranges, find_true_ranges, read_cameras
from pano_mvs.scene import Scores
from pano_mvs.scene.masking import Scalar
from pano_mvs.scene.scores import NO_TRUTH
from pano_mvs_evaluation.clouds.evaluate import CLOUD_FILE, MODEL_FOLDER, CloudEvaluation, evaluate_cloud
from pano_mvs_evaluation.ranges.evaluate import DepthEvaluation, evaluate_depth
from pano_mvs_evaluation.ranges.pairs import resized_labels, resized_range
from pano_mvs_evaluation.ranges.view_scores import score_view

KEPT = "psnr_db", "w_mae", "w_delta_105", "bad_5", "completeness", "median_relative_error"
KEPT_OF_CONFIDENCE = "sparsification_area", "sparsification_oracle_area", "ause"
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


_RANGES = "range"
Evaluation = TypeVar("Evaluation")


@dataclass(frozen=True, eq=False)
class RunEvaluation:
    """Scores of the results in an output folder; None for a result that cannot be compared."""

    poses: Scores | None
    depth: DepthEvaluation | None
    cloud: CloudEvaluation | None
    not_compared: Mapping[str, str]

    def __repr__(self) -> str:
        """Return the main figures, one line for each result."""
        lines = [repr(result) for result in (self.depth, self.cloud) if result is not None]
        if self.poses is not None:
            scores = self.poses.poses
            median = scores.get("median_pair_error_deg", float("nan"))  # missing if no pair could be measured
            images = f"{scores['registered']} of {scores['of']} images"
            lines.insert(0, f"poses: {images} registered, median error of a pair {median:.3g}°")
        lines += [f"{result} not compared: {reason}" for result, reason in self.not_compared.items()]
        return "\n  ".join(["RunEvaluation(", *lines]) + ")"


class _NotComparedError(Exception):
    """A result has no counterpart in the truth; the text is the reason."""


def evaluate_run(out: Path | str, truth: Path | str) -> RunEvaluation:
    """Compare the poses, the range maps and the cloud in an output folder with the truth, as far as both are there.

    Args:
        truth: a folder with poses.json and depth.npz, or a part of that.

    Raises:
        InputError: if nothing can be compared, with the reason for each result, or a file is damaged.
    """
    reasons: dict[str, str] = {}

    def attempt(result: str, compare: Callable[[Path, Path], Evaluation]) -> Evaluation | None:
        try:
            return compare(Path(out), Path(truth))
        except _NotComparedError as reason:
            reasons[result] = str(reason)
            return None

    found = attempt("poses", _poses), attempt("ranges", _ranges), attempt("cloud", _cloud)
    if len(reasons) == 3:
        raise InputError(
            f"{out}: nothing here can be compared with {truth}: {'; '.join(reasons.values())}. Give the output folder "
            "of a finished run, and a truth of its images"
        )
    return RunEvaluation(*found, reasons)


def _poses(out: Path, truth: Path) -> Scores:
    if not is_colmap_model(out / MODEL_FOLDER):
        raise _NotComparedError(f"there is no {MODEL_FOLDER}")
    try:
        known, _ = read_cameras(truth)
    except InputError as error:
        raise _NotComparedError(f"the truth has no poses ({error})") from error
    estimated: dict[str, Rigid3] = {}
    groups: dict[str, int] = {}
    for number, cameras in enumerate(camera_groups(out / "colmap")):
        estimated |= cameras
        groups |= dict.fromkeys(cameras, number)
    ours = {known_name: name for name, known_name in pair_image_names(estimated, known).items()}
    if not ours:
        raise _NotComparedError(f"the truth knows none of its images ({', '.join(list(estimated)[:3])})")
    # An image of the truth that the run did not register keeps the truth's name, and counts as not registered.
    renamed = {ours.get(name, name): pose for name, pose in known.items()}
    scores = score_capture(estimated, renamed, groups=groups)
    if not scores.poses:
        raise _NotComparedError("; ".join(scores.notes))
    return scores


def _ranges(out: Path, truth: Path) -> DepthEvaluation:
    if not is_folder(out / _RANGES):
        raise _NotComparedError(f"there is no folder {_RANGES}")
    estimates = find_ranges(out)
    try:
        true = find_true_ranges(truth)
    except InputError as error:
        raise _NotComparedError(f"the truth has none ({error})") from error
    if not pair_image_names(estimates, true):
        raise _NotComparedError(f"the truth knows none of their images ({', '.join(list(estimates)[:3])})")
    return evaluate_depth(out, truth)


def _cloud(out: Path, truth: Path) -> CloudEvaluation:
    if not is_file(out / CLOUD_FILE):
        raise _NotComparedError(f"there is no {CLOUD_FILE}")
    if not is_colmap_model(out / MODEL_FOLDER):
        raise _NotComparedError(f"there is no {MODEL_FOLDER} that defines its frame")
    try:
        if not pair_image_names(read_cameras(truth)[0], find_true_ranges(truth)):
            raise _NotComparedError("the truth has no ranges of an image whose pose it knows")
    except InputError as error:
        raise _NotComparedError(f"the truth has no ranges with poses ({error})") from error
    try:
        return evaluate_cloud(out, truth)
    except UsageError as error:
        raise _NotComparedError(str(error)) from error
