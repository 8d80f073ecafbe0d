"""Comparison of range maps with true ones."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.geometry.pose_errors import align_centers
from pano_mvs.io.images.names import pair_image_names
from pano_mvs.io.truth import Cameras, RangeMaps, as_path, camera_groups, read_cameras, source_name
from pano_mvs_evaluation.ranges.pairs import RangePairs, ViewMaps, ViewMasks, pair_ranges
from pano_mvs_evaluation.ranges.view_scores import BASELINES, ScoreSettings, ViewScores, mean_scores, score_view
from pano_mvs_evaluation.tables import finite_values


@dataclass(frozen=True)
class FoundScale:
    """The factor from the estimates' unit to the truth's."""

    value: float  # the factor; with several groups of poses, that of the largest group
    reason: str  # how it was found
    # factor of each image of a further group; NaN if it cannot be determined
    others: Mapping[str, float] = field(default_factory=dict)

    def of_views(self, names: Iterable[str]) -> dict[str, float]:
        """Return the factor of each view that has one."""
        listed = list(names)
        groups = pair_image_names(listed, self.others)
        factors = {name: self.others[groups[name]] if name in groups else self.value for name in listed}
        return {name: factor for name, factor in factors.items() if np.isfinite(factor)}


def find_scale(
    source: RangeMaps,
    truth: RangeMaps,
    *,
    scale: float | Literal["auto"] = "auto",
    poses: Cameras | None = None,
    true_poses: Cameras | None = None,
) -> FoundScale:
    """Return the factor from the estimates' unit to the truth's: as given, or from the camera centres of both.

    Args:
        source: the estimated range maps; a folder may hold the estimated poses too.
        truth: the true range maps; a folder may hold the true poses too.
        scale: the factor, or "auto".
        poses: the estimated poses, if they are not in `source`.
        true_poses: the true poses, if they are not in `truth`.

    Raises:
        UsageError: if the factor is not positive, or given poses determine no scale.
        InputError: if given poses cannot be read.
    """
    if scale != "auto":
        if not 0 < scale < float("inf"):
            raise UsageError(f"the scale must be a positive number, or auto to use the camera centres, got {scale}")
        return FoundScale(scale, "as given")
    given = poses is not None or true_poses is not None
    try:
        groups, (true, _) = camera_groups(_poses_in(source, poses)), read_cameras(_poses_in(truth, true_poses))
    except InputError as error:
        if given:
            raise
        return FoundScale(
            1.0, f"poses are missing on at least one side, so both are assumed to have the same unit ({error})"
        )
    try:
        value = _scale(groups[0], true)
    except UsageError as error:
        if given:
            raise
        return FoundScale(1.0, f"the poses determine no scale, so both are assumed to have the same unit ({error})")
    reason = f"from the centres of {len(pair_image_names(groups[0], true))} cameras, never from the ranges"
    others: dict[str, float] = {}
    for number, cameras in enumerate(groups[1:], start=1):
        try:
            factor = _scale(cameras, true)
            reason += f"; those of group {number}, which has a unit of its own, × {factor:.6g}"
        except UsageError as error:
            factor = float("nan")
            reason += f"; the {len(cameras)} of group {number} are not scored: {error}"
        others |= dict.fromkeys(cameras, factor)
    return FoundScale(value, reason, others)


def _poses_in(ranges: RangeMaps, poses: Cameras | None) -> Cameras:
    if poses is not None:
        return poses
    if isinstance(ranges, Path):
        return ranges
    raise InputError("range maps in memory have no poses")


def _scale(cameras: Mapping[str, Rigid3], true: Mapping[str, Rigid3]) -> float:
    matched = pair_image_names(cameras, true)
    return align_centers(cameras, {name: true[other] for name, other in matched.items()}).scale


Sizes = tuple[tuple[int, int], tuple[int, int]]


@dataclass(frozen=True)
class DepthEvaluation:
    """Scores of range maps."""

    source: str
    truth: str
    settings: ScoreSettings
    scale: FoundScale
    views: Mapping[str, ViewScores]
    pairs: RangePairs
    sizes: Mapping[Sizes, int]

    def __repr__(self) -> str:
        """Return the main figures in a line."""
        scores = (f"{name} {self.mean[name]:.3g}" for name in ("w_mae", "w_abs_rel", "completeness"))
        return f"DepthEvaluation({len(self.views)} views, mean {', '.join(scores)})"

    @cached_property
    def mean(self) -> Mapping[str, float]:
        """The mean of each score over the views."""
        return mean_scores([view.scores for view in self.views.values()])

    @cached_property
    def mean_constants(self) -> Mapping[str, Mapping[str, float]]:
        """The mean of each score of the constants over the views, by the name of the baseline."""
        return {name: mean_scores([view.constants[name] for view in self.views.values()]) for name in BASELINES}

    @property
    def without_mask(self) -> tuple[str, ...]:
        """The views without a mask in the folder of masks."""
        return self.pairs.masks.missing(list(self.views))

    def read_maps(self, name: str) -> ViewMaps:
        """Return the maps of a scored view: confident estimates alone, with the scale and the fit applied."""
        maps = self.pairs.read(name)
        estimated: NDArray[np.float32] = maps.estimated
        if self.settings.min_confidence and maps.confidence is not None:
            estimated = np.where(maps.confidence >= self.settings.min_confidence, estimated, np.float32(np.nan))
        return replace(maps, estimated=(estimated * self.views[name].scale).astype(np.float32))

    def to_json(self) -> dict[str, object]:
        """Return all figures as JSON values; None stands for values that are not finite (the PSNR of a zero error)."""
        return {
            "source": self.source,
            "truth": self.truth,
            "peak": self.settings.peak,
            "align": self.settings.align,
            "min_confidence": self.settings.min_confidence,
            "scale": self.scale.value,
            "scale_reason": self.scale.reason,
            "mean": finite_values(self.mean),
            "mean_constant": {name: finite_values(values) for name, values in self.mean_constants.items()},
            "views": {
                name: {
                    "pixels": view.pixels,
                    "scale": view.scale,
                    "scores": finite_values(view.scores),
                    "constant": {baseline: finite_values(found) for baseline, found in view.constants.items()},
                }
                for name, view in self.views.items()
            },
            "without_truth": list(self.pairs.without_truth),
            "without_estimate": list(self.pairs.without_estimate),
            "without_mask": list(self.without_mask),
        }


def evaluate_depth(
    estimates: RangeMaps | str,
    truth: RangeMaps | str,
    *,
    settings: ScoreSettings | None = None,
    unit: float = 1.0,
    truth_unit: float = 1.0,
    scale: float | Literal["auto"] = "auto",
    poses: Cameras | str | None = None,
    true_poses: Cameras | str | None = None,
    masks: Path | str | None = None,
    mask: Path | str | None = None,
) -> DepthEvaluation:
    """Compare range maps with the truth.

    Args:
        estimates: the output folder of a run, a folder of range maps, an .npz file, or arrays by image name.
        truth: a folder with poses.json and depth.npz, or any of the forms of `estimates`.
        settings: how to score; by default those of `ScoreSettings`.
        unit: factor from the estimates' numbers to their unit of length, such as 0.001 for millimetres.
        truth_unit: factor from the truth's numbers to their unit of length.
        scale: factor from the estimates' unit to the truth's; "auto" derives it from the camera centres if both sides
            have poses, else it is 1.
        poses: the estimated poses, if they are not in the folder of the estimates.
        true_poses: the true poses, if they are not in the folder of the truth.
        masks: a folder with one mask per image; pixels where it is 0 are ignored.
        mask: one mask for all images.

    Raises:
        InputError: if a file is missing or damaged, or the two do not belong together.
        UsageError: if a setting is invalid.

    Example:
        >>> import numpy as np
        >>> truth = {"a": np.full((4, 8), 2.0), "b": np.full((4, 8), 4.0)}
        >>> evaluation = evaluate_depth({"a.png": np.full((4, 8), 2.2)}, truth)
        >>> round(evaluation.mean["mae"], 4), evaluation.pairs.without_estimate
        (0.2, ('b',))
    """
    settings = settings or ScoreSettings()
    source: RangeMaps = as_path(estimates)
    target: RangeMaps = as_path(truth)
    for what, value in (("unit", unit), ("truth unit", truth_unit)):
        if not 0 < value < float("inf"):
            raise UsageError(f"the {what} must be a positive number, got {value}")
    view_masks = ViewMasks(as_path(masks), as_path(mask))
    pairs = pair_ranges(source, target, unit=unit, truth_unit=truth_unit, masks=view_masks)
    found_scale = find_scale(source, target, scale=scale, poses=as_path(poses), true_poses=as_path(true_poses))
    views: dict[str, ViewScores] = {}
    sizes: dict[Sizes, int] = {}
    for name, factor in found_scale.of_views(pairs.truths).items():
        maps = pairs.read(name)
        if settings.min_confidence and maps.confidence is None:
            raise InputError(
                f"{pairs.estimates[name]}: no confidence/{name}.png beside it, so a minimum confidence cannot apply. "
                "Omit it, or give the output folder of a run"
            )
        views[name] = score_view(
            maps.estimated,
            maps.truth,
            confidence=maps.confidence,
            scale=factor,
            mask=maps.counted,
            settings=settings,
        )
        size = maps.size_hw, (maps.truth.shape[0], maps.truth.shape[1])
        sizes[size] = sizes.get(size, 0) + 1
    if not any(view.pixels for view in views.values()):
        raise InputError(
            f"{source_name(target)}: no pixel of any view has a true range that counts. Check its files and the masks: "
            "zero, negative, infinite and NaN are invalid"
        )
    return DepthEvaluation(source_name(source), source_name(target), settings, found_scale, views, pairs, sizes)
