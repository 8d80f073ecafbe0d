"""The factor from the unit of the estimates to that of the ground truth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from pano_mvs.core.errors import InputError, UsageError
from pano_mvs.evaluation.inputs.cameras import Cameras, camera_groups, read_cameras
from pano_mvs.evaluation.inputs.range_files import RangeMaps
from pano_mvs.evaluation.poses.alignment import align_centers
from pano_mvs.geometry import Rigid3
from pano_mvs.io.images.names import pair_image_names


@dataclass(frozen=True)
class FoundScale:
    """The factor from the estimates' unit to the truth's.

    Attributes:
        value: the factor; with several groups of poses, that of the largest group.
        reason: how it was found.
        others: factor of each image of a further group; NaN if it cannot be determined.
    """

    value: float
    reason: str
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
