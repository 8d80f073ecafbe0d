"""Poses and range maps of a capture against the truth, by the protocol of the paper's tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.metrics.poses import align_centers, relative_pose_errors
from pano_mvs.algorithms.metrics.resize import resized_labels, resized_range
from pano_mvs.algorithms.metrics.view_scores import score_view
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import Scores

KEPT = "psnr_db", "w_mae", "w_delta_105", "bad_5", "completeness", "median_relative_error"
KEPT_OF_CONFIDENCE = "sparsification_area", "sparsification_oracle_area", "ause"
Scalar = TypeVar("Scalar", bound=np.generic)
RangeReader = Callable[[], "NDArray[np.float32] | None"]


def score_capture(
    estimated_poses: Mapping[str, Rigid3],
    true_poses: Mapping[str, Rigid3],
    estimated_ranges: Mapping[str, NDArray[np.float32]],
    true_ranges: Mapping[str, RangeReader],
    *,
    confidences: Mapping[str, NDArray[np.uint8]] | None = None,
    masks: Mapping[str, NDArray[np.bool_]] | None = None,
    groups: Mapping[str, int] | None = None,
) -> Scores:
    """Return pose and depth scores.

    Ranges are multiplied by the scale of the similarity that aligns the estimated camera centres, of the view's group,
    with the true ones; they are never fitted to the true ranges. Pixels without true surface are left out; a pixel
    without an estimate counts as an error equal to the truth. Names of scores are those of `score_view`; `constant_`
    before one is what the median of the view's true ranges scores in its place, `best_constant_` what the constant that
    is best for it does. The median errors of poses are those of the pairs that can be measured, and are left out where
    there is none; in the areas under the recall curve the others count as 180° off.

    Args:
        estimated_poses: cam_from_world by image.
        true_poses: cam_from_world by image, in the truth's unit.
        estimated_ranges: (H, W) by image, NaN invalid; of another size than the truth they are read at its pixels.
        true_ranges: image to a function that returns its (H, W) true range, or None where it is not known.
        confidences: (H, W) by image: how well they rank the errors is scored too where they are given.
        masks: (H, W) by image, False is left out of the scores: nothing was to be estimated there.
        groups: number of each estimated pose's group, where they have different worlds; None: all have one.
    """
    if len(true_poses) < 2:
        return Scores({}, {}, ("no ground truth is known for these pictures",))
    notes: list[str] = []
    errors = relative_pose_errors(estimated_poses, true_poses, groups=groups)
    poses: dict[str, float] = {
        "registered": errors.registered,
        "of": errors.expected,
        **{f"median_{name}_error_deg": float(np.median(error_deg[errors.measured]))
           for name, error_deg in (("pair", errors.pair_deg), ("rotation", errors.rotation_deg),
                                   ("direction", errors.direction_deg)) if errors.measured.any()},
        **{f"auc_{limit:g}_deg": value for limit, value in errors.auc.items()},
    }  # fmt: skip
    if np.isfinite(errors.scale_ratio_max):
        poses |= {
            "scale_ratio_error_median": errors.scale_ratio_median,
            "scale_ratio_error_max": errors.scale_ratio_max,
        }
    if groups is not None and len(set(groups.values())) > 1:
        poses["registered_in_one_frame"] = errors.in_one_frame
        notes.append(f"the poses are in {len(set(groups.values()))} groups, each with a frame and a scale of its own: "
                     "pairs across groups cannot be measured and count as not registered; each group is aligned with "
                     "the truth on its own")  # fmt: skip
    scales, refused = _scales(estimated_poses, true_poses, groups or {})
    if not scales:
        return Scores(poses, {}, (*notes, *(f"ranges are not scored: {why}" for why in refused.values())))
    notes += [f"the ranges of group {number} are not scored: {why}" for number, why in refused.items()]
    views: dict[str, dict[str, float]] = {}
    for name, estimated in estimated_ranges.items():
        scale = scales.get((groups or {}).get(name, 0))
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
            confidence=_of_size((confidences or {}).get(name), size_hw),
            mask=_of_size((masks or {}).get(name), size_hw),
        )
    return Scores(poses, views, tuple(notes))


def _scales(
    estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3], groups: Mapping[str, int]
) -> tuple[dict[int, float], dict[int, str]]:
    """Return the truth's units per unit of each group, or why that cannot be known."""
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
    """Return the scores that are kept with a run, then what constants score under each of these names.

    What is no finite number (the median of nothing, the PSNR of no error) is left out: records hold none.
    """
    found = score_view(estimated, truth, scale=scale, confidence=confidence, mask=mask)
    scores = {name: found.scores[name] for name in (*KEPT, *KEPT_OF_CONFIDENCE) if name in found.scores}
    for prefix, constants in (("constant_", found.constants["median"]), ("best_constant_", found.constants["best"])):
        scores |= {f"{prefix}{name}": constants[name] for name in (*KEPT, "ause") if name in constants}
    always = {"constant_completeness", "best_constant_completeness"}
    return {name: value for name, value in scores.items() if np.isfinite(value) and name not in always}
