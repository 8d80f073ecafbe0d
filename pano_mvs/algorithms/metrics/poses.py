"""How good camera poses are, against ground truth."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.core.text import plural
from pano_mvs.geometry import Rigid3, Similarity3, angle_between, geodesic_angle, nearest_rotation

FloatArray = NDArray[np.float64]

AUC_LIMITS_DEG = (0.1, 0.5, 1.0, 5.0)
# Centres that are closer than this share of the capture's extent coincide: a picture that is there twice.
_COINCIDENT_SHARE = 1e-6
# How much orientations say of the turn between two worlds, against the centres' own spread. Enough where the centres
# lie on a line and leave the turn about it open; nothing elsewhere.
_ORIENTATION_SHARE = 1e-6


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of relative poses, over all pairs of the images that have truth.

    Attributes:
        pairs: (P) the pairs of image names.
        rotation_deg: (P,) error of second_from_first's rotation; 180 where an image is not registered.
        direction_deg: (P,) error of the direction of its translation; 180 likewise.
        pair_deg: (P,) the larger of the two.
        measured: (P,) bool, False where an image is not registered, or the two are in different groups.
        median_pair_deg: median of `pair_deg`.
        auc: limit in degrees to the area under the recall curve of `pair_deg` up to it, in [0, 1].
        registered: number of images that have an estimate.
        in_one_frame: number of those in the largest group, which share a world frame.
        expected: number of images that have truth.
        scale_ratio_median: median of |baseline ratio − 1| after division by the median ratio; NaN below 3 images.
        scale_ratio_max: largest of them.
    """

    pairs: tuple[tuple[str, str], ...]
    rotation_deg: FloatArray
    direction_deg: FloatArray
    pair_deg: FloatArray
    measured: NDArray[np.bool_]
    median_pair_deg: float
    auc: dict[float, float]
    registered: int
    in_one_frame: int
    expected: int
    scale_ratio_median: float
    scale_ratio_max: float


@dataclass(frozen=True, eq=False)
class CenterErrors:
    """Distances of camera centres from the true ones, after the similarity that brings them closest.

    Attributes:
        names: (N) images that have both.
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
    """Return the errors of all pairs of the truth's images; they depend on no choice of world frame or scale.

    Args:
        estimated: cam_from_world by image name; names without truth are left out.
        truth: true cam_from_world by image name, two at least.
        groups: number of each estimate's group, where they have different worlds: a pair across groups cannot be
            measured and counts as one with an image that is not registered. None: all have one world.

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
    true_limit = _COINCIDENT_SHARE * _extent(truth)
    limits = {number: (_COINCIDENT_SHARE * _extent(world), true_limit) for number, world in worlds.items()}
    measured = [a in known and b in known and group_of[a] == group_of[b] for a, b in pairs]
    errors = np.array([
        _pair_error_deg(a, b, known, truth, limits[group_of[a]]) if is_measured else (180.0, 180.0)
        for (a, b), is_measured in zip(pairs, measured, strict=True)
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
        measured=np.array(measured),
        median_pair_deg=float(np.median(pair_deg)),
        auc={limit: float(np.clip(1 - pair_deg / limit, 0, 1).mean()) for limit in AUC_LIMITS_DEG},
        registered=len(known),
        in_one_frame=max(map(len, worlds.values()), default=0),
        expected=len(truth),
        scale_ratio_median=float(np.median(deviations)),
        scale_ratio_max=float(deviations.max()),
    )


def center_errors(estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3]) -> CenterErrors:
    """Return how far the estimated camera centres are from the true ones after similarity alignment.

    Args:
        estimated: cam_from_world by image name; names without truth are left out.
        truth: true cam_from_world by image name.

    Raises:
        UsageError: as `align_centers`.
    """
    truth_from_estimated = align_centers(estimated, truth)
    names = tuple(name for name in truth if name in estimated)
    moved = truth_from_estimated.apply([estimated[name].center for name in names])
    distances = np.linalg.norm(moved - [truth[name].center for name in names], axis=1)
    return CenterErrors(names, distances, _extent({name: truth[name] for name in names}), truth_from_estimated.scale)


def align_centers(estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3]) -> Similarity3:
    """Return the similarity world_truth from world_estimated that brings the camera centres together.

    Umeyama 1991, with the cameras' orientations added to the covariance at a weight that matters only where the
    centres alone leave a turn open: two images, images on a line, a picture that is there twice.

    Args:
        estimated: cam_from_world by image name.
        truth: true cam_from_world by image name; two common names at different places determine it.

    Raises:
        UsageError: if fewer than two images are common, or their centres coincide in either.
    """
    names = [name for name in truth if name in estimated]
    if len(names) < 2:
        raise UsageError(
            f"only {len(names)} {plural(len(names), 'image has', 'images have')} both an estimate and truth; two are "
            "needed for a scale"
        )
    source = np.array([estimated[name].center for name in names])
    target = np.array([truth[name].center for name in names])
    middle, aim = source.mean(axis=0), target.mean(axis=0)
    spread, true_spread = float(np.linalg.norm(source - middle)), float(np.linalg.norm(target - aim))
    for what, length, centers in (("estimated", spread, source), ("true", true_spread, target)):
        if length <= 1e-12 * max(1.0, float(np.abs(centers).max())):
            raise UsageError(f"the {what} centres of all {len(names)} images coincide, so no scale can be estimated")
    covariance = (target - aim).T @ (source - middle) / (spread * true_spread)
    turns = [truth[name].rotation.T @ estimated[name].rotation for name in names]
    rotation = nearest_rotation(covariance + _ORIENTATION_SHARE * np.mean(turns, axis=0))
    scale = float(np.trace(rotation.T @ covariance)) * true_spread / spread
    return Similarity3(scale, rotation, aim - scale * rotation @ middle)


def _extent(poses: Mapping[str, Rigid3]) -> float:
    """Return the largest distance between two camera centres; 0 below two."""
    centers = np.array([pose.center for pose in poses.values()]).reshape(-1, 3)
    return max((float(np.linalg.norm(centers - center, axis=1).max()) for center in centers), default=0.0)


def _pair_error_deg(
    first: str,
    second: str,
    estimated: Mapping[str, Rigid3],
    truth: Mapping[str, Rigid3],
    limits: tuple[float, float],
) -> tuple[float, float]:
    """Return the errors of rotation and of direction; a pair truly taken from one place has no direction."""
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
    """Return estimated over true baseline length of every pair that has both."""
    true = {name: truth[name].center for name in estimated}
    guess = {name: pose.center for name, pose in estimated.items()}
    lengths = [
        (np.linalg.norm(guess[b] - guess[a]), np.linalg.norm(true[b] - true[a])) for a, b in combinations(guess, 2)
    ]
    return np.array([g / t for g, t in lengths if g > limits[0] and t > limits[1]])
