"""Errors of camera poses: relative poses of all pairs, and camera centres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.evaluation.poses.alignment import align_centers, camera_extent
from pano_mvs.geometry import Rigid3, angle_between, geodesic_angle

FloatArray = NDArray[np.float64]

AUC_LIMITS_DEG = (0.1, 0.5, 1.0, 5.0)
# Centres closer than this share of the capture's extent coincide: an image that occurs twice.
_COINCIDENT_SHARE = 1e-6


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of relative poses, over all pairs of images with ground truth.

    Attributes:
        pairs: (P) the pairs of image names.
        rotation_deg: (P,) error of second_from_first's rotation; 180 if an image is not registered.
        direction_deg: (P,) error of the direction of its translation; 180 if an image is not registered.
        pair_deg: (P,) the larger of the two.
        median_pair_deg: median of `pair_deg`.
        auc: limit in degrees to the area under the recall curve of `pair_deg` up to it, in [0, 1].
        registered: number of images with an estimate.
        in_one_frame: number of those in the largest group, which shares one world frame.
        expected: number of images with ground truth.
        scale_ratio_median: median of |baseline ratio − 1| after division by the median ratio; NaN below 3 images.
        scale_ratio_max: largest of them.
    """

    pairs: tuple[tuple[str, str], ...]
    rotation_deg: FloatArray
    direction_deg: FloatArray
    pair_deg: FloatArray
    median_pair_deg: float
    auc: dict[float, float]
    registered: int
    in_one_frame: int
    expected: int
    scale_ratio_median: float
    scale_ratio_max: float


@dataclass(frozen=True, eq=False)
class CenterErrors:
    """Distances of camera centres from the true ones after similarity alignment.

    Attributes:
        names: (N) images with both poses.
        distances: (N,) in the truth's unit.
        extent: largest distance between two true centres, in the truth's unit.
        scale: truth's units per unit of the estimate.
    """

    names: tuple[str, ...]
    distances: FloatArray
    extent: float
    scale: float


def relative_pose_errors(
    estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3], *, groups: Mapping[str, int] | None = None
) -> PoseErrors:
    """Return the errors of all pairs of the truth's images, which do not depend on the world frame or the scale.

    Args:
        estimated: cam_from_world by image name; names without truth are ignored.
        truth: true cam_from_world of at least two images.
        groups: group number of each estimate, if the groups have different worlds. A pair across groups cannot be
            measured and counts as not registered. None: all share one world.

    Raises:
        UsageError: if the truth holds fewer than two images.
    """
    if len(truth) < 2:
        raise UsageError(f"relative poses need the truth of at least two images, got {len(truth)}")
    pairs = tuple(combinations(truth, 2))
    known = {name: estimated[name] for name in truth if name in estimated}
    group_of = {name: 0 if groups is None else groups[name] for name in known}
    worlds = {
        number: {name: known[name] for name in known if group_of[name] == number} for number in set(group_of.values())
    }
    true_limit = _COINCIDENT_SHARE * camera_extent(truth)
    limits = {number: (_COINCIDENT_SHARE * camera_extent(world), true_limit) for number, world in worlds.items()}
    errors = np.array([
        _pair_error_deg(first, second, known, truth, limits[group_of[first]])
        if first in known and second in known and group_of[first] == group_of[second]
        else (180.0, 180.0)
        for first, second in pairs
    ])  # fmt: skip
    pair_deg = errors.max(axis=1)
    ratios = [_baseline_ratios(world, truth, limits[number]) for number, world in sorted(worlds.items())]
    found = [np.abs(own / np.median(own) - 1) for own in ratios if len(own) > 1]
    deviations = np.concatenate(found) if found else np.array([np.nan])
    return PoseErrors(
        pairs=pairs,
        rotation_deg=errors[:, 0],
        direction_deg=errors[:, 1],
        pair_deg=pair_deg,
        median_pair_deg=float(np.median(pair_deg)),
        auc={limit: float(np.clip(1 - pair_deg / limit, 0, 1).mean()) for limit in AUC_LIMITS_DEG},
        registered=len(known),
        in_one_frame=max(map(len, worlds.values()), default=0),
        expected=len(truth),
        scale_ratio_median=float(np.median(deviations)),
        scale_ratio_max=float(deviations.max()),
    )


def center_errors(estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3]) -> CenterErrors:
    """Return the distances of the camera centres from the true ones after similarity alignment.

    Args:
        estimated: cam_from_world by image name; names without truth are ignored.
        truth: true cam_from_world by image name.

    Raises:
        UsageError: if the poses determine no alignment (see `align_centers`).
    """
    truth_from_estimated = align_centers(estimated, truth)
    names = tuple(name for name in truth if name in estimated)
    moved = truth_from_estimated.apply([estimated[name].center for name in names])
    distances = np.linalg.norm(moved - [truth[name].center for name in names], axis=1)
    extent = camera_extent({name: truth[name] for name in names})
    return CenterErrors(names, distances, extent, truth_from_estimated.scale)


def _pair_error_deg(
    first: str,
    second: str,
    estimated: Mapping[str, Rigid3],
    truth: Mapping[str, Rigid3],
    limits: tuple[float, float],
) -> tuple[float, float]:
    """Return the errors of rotation and direction; a pair taken from the same place has no direction error."""
    guess = estimated[second] @ estimated[first].inverse()
    true = truth[second] @ truth[first].inverse()
    rotation_deg = float(np.rad2deg(geodesic_angle(guess.rotation, true.rotation)))
    if np.linalg.norm(true.translation) <= limits[1]:
        return rotation_deg, 0.0
    if np.linalg.norm(guess.translation) <= limits[0]:
        return rotation_deg, 180.0
    return rotation_deg, float(np.rad2deg(angle_between(guess.translation, true.translation)))


def _baseline_ratios(
    estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3], limits: tuple[float, float]
) -> FloatArray:
    """Return the ratio of estimated to true baseline of every pair whose images lie apart on both sides."""
    true = {name: truth[name].center for name in estimated}
    guess = {name: pose.center for name, pose in estimated.items()}
    lengths = [
        (np.linalg.norm(guess[b] - guess[a]), np.linalg.norm(true[b] - true[a])) for a, b in combinations(guess, 2)
    ]
    return np.array([g / t for g, t in lengths if g > limits[0] and t > limits[1]])
