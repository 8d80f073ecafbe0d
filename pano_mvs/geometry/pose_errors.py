"""Errors of poses against true ones, and the similarity that aligns the centres of both."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.core.text import plural
from pano_mvs.geometry.sphere import angle_between
from pano_mvs.geometry.transforms import Rigid3, Similarity3, geodesic_angle, nearest_rotation

AUC_LIMITS_DEG = (0.1, 0.5, 1.0, 5.0)


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of relative poses, over all pairs of images with ground truth."""

    pairs: tuple[tuple[str, str], ...]  # (P) the pairs of image names
    rotation_deg: FloatArray  # (P,) error of second_from_first's rotation; 180 if an image is not registered
    # (P,) error of the direction of its translation; 180 if an image is not registered
    direction_deg: FloatArray
    pair_deg: FloatArray  # (P,) the larger of the two
    measured: NDArray[np.bool_]  # (P,) False if an image is not registered, or the two are in different groups
    median_pair_deg: float  # median of `pair_deg`
    # limit in degrees to the area under the recall curve of `pair_deg` up to it, in [0, 1]
    auc: dict[float, float]
    registered: int  # number of images with an estimate
    in_one_frame: int  # number of those in the largest group, which shares one world frame
    expected: int  # number of images with ground truth
    # median of |baseline ratio − 1| after division by the median ratio; NaN below 3 images
    scale_ratio_median: float
    scale_ratio_max: float  # largest of them


@dataclass(frozen=True, eq=False)
class CenterErrors:
    """Distances of camera centres from the true ones after similarity alignment."""

    names: tuple[str, ...]  # (N) images with both poses
    distances: FloatArray  # (N,) in the truth's unit
    extent: float  # largest distance between two true centres, in the truth's unit
    scale: float  # truth's units per unit of the estimate


class _RelativePoses(NamedTuple):
    """Rotations (P, 3, 3), translations (P, 3), their lengths (P,), and whether the centres lie apart (P,)."""

    rotations: FloatArray
    translations: FloatArray
    lengths: FloatArray
    apart: NDArray[np.bool_]


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
        raise UsageError(f"relative poses need the true poses of at least two images, got {len(truth)}")
    position = {name: idx for idx, name in enumerate(truth)}
    worlds: dict[int, list[str]] = {}
    for name in truth:
        if name in estimated:
            worlds.setdefault(0 if groups is None else groups[name], []).append(name)
    pairs, true_extent = tuple(combinations(truth, 2)), camera_extent(truth)
    errors, measured = np.full((len(pairs), 2), 180.0), np.zeros(len(pairs), np.bool_)
    deviations = [np.zeros(0)]
    for _, names in sorted(worlds.items()):
        first, second = np.array([position[name] for name in names])[np.stack(np.triu_indices(len(names), 1))]
        place = first * (2 * len(truth) - first - 1) // 2 + second - first - 1  # in `pairs`
        true, found = _relative(truth, names, true_extent), _relative(estimated, names)
        measured[place] = True
        errors[place], ratios = _world_errors(found, true)
        if len(ratios) > 1:
            deviations.append(np.abs(ratios / np.median(ratios) - 1))
    pair_deg = errors.max(axis=1)
    deviation = np.concatenate(deviations) if len(deviations) > 1 else np.array([np.nan])
    return PoseErrors(
        pairs=pairs,
        rotation_deg=errors[:, 0],
        direction_deg=errors[:, 1],
        pair_deg=pair_deg,
        measured=measured,
        median_pair_deg=float(np.median(pair_deg)),
        auc={limit: float(np.clip(1 - pair_deg / limit, 0, 1).mean()) for limit in AUC_LIMITS_DEG},
        registered=sum(map(len, worlds.values())),
        in_one_frame=max(map(len, worlds.values()), default=0),
        expected=len(truth),
        scale_ratio_median=float(np.median(deviation)),
        scale_ratio_max=float(deviation.max()),
    )


def center_errors(estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3]) -> CenterErrors:
    """Return the distances of the camera centres from the true ones after similarity alignment.

    Raises:
        UsageError: if the poses determine no alignment (see `align_centers`).
    """
    truth_from_estimated = align_centers(estimated, truth)
    names = tuple(name for name in truth if name in estimated)
    moved = truth_from_estimated.apply([estimated[name].center for name in names])
    distances = np.linalg.norm(moved - [truth[name].center for name in names], axis=1)
    extent = camera_extent({name: truth[name] for name in names})
    return CenterErrors(names, distances, extent, truth_from_estimated.scale)


def _relative(poses: Mapping[str, Rigid3], names: Sequence[str], extent: float | None = None) -> _RelativePoses:
    """Return second_from_first of all pairs of some images."""
    rotations = np.array([poses[name].rotation for name in names])
    centers = np.array([poses[name].center for name in names])
    first, second = np.triu_indices(len(names), 1)
    translations = np.einsum("pij,pj->pi", rotations[second], centers[first] - centers[second])
    lengths = np.linalg.norm(translations, axis=1)
    extent = float(lengths.max(initial=0)) if extent is None else extent
    # Centres closer than this share of the capture's extent coincide: an image that occurs twice.
    apart = lengths > max(1e-6 * extent, 1e-12 * float(np.abs(centers).max()))  # of which coordinates are rounded
    return _RelativePoses(rotations[second] @ rotations[first].swapaxes(1, 2), translations, lengths, apart)


def _world_errors(found: _RelativePoses, true: _RelativePoses) -> tuple[FloatArray, FloatArray]:
    """Return errors of rotation and direction in degrees (P, 2), and the ratios of baselines that are not 0 (Q,).

    A pair that was truly taken from one place has no direction error.
    """
    both = found.apart & true.apart
    direction_deg = np.where(true.apart, 180.0, 0.0)
    direction_deg[both] = np.rad2deg(angle_between(found.translations[both], true.translations[both]))
    rotation_deg = np.rad2deg(geodesic_angle(found.rotations, true.rotations))
    return np.stack([rotation_deg, direction_deg], axis=1), found.lengths[both] / true.lengths[both]


def align_centers(estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3]) -> Similarity3:
    """Return the similarity world_truth from world_estimated that best aligns the camera centres.

    Umeyama 1991, with the cameras' orientations added to the covariance at a weight that matters only where the
    centres leave a rotation open: two images, images on a line, an image that occurs twice.

    Args:
        estimated: cam_from_world by image name.
        truth: true cam_from_world by image name; at least two common names, at different places.

    Raises:
        UsageError: if fewer than two images are common, or their centres coincide on either side.

    Example:
        >>> import numpy as np
        >>> from pano_mvs.geometry import Rigid3
        >>> truth = {name: Rigid3(np.eye(3), np.array([x, 0.0, 0.0])) for name, x in (("a", 0.0), ("b", 2.0))}
        >>> half = {name: Rigid3(pose.rotation, pose.translation / 2) for name, pose in truth.items()}
        >>> round(align_centers(half, truth).scale, 6)
        2.0
    """
    names = [name for name in truth if name in estimated]
    if len(names) < 2:
        have = plural(len(names), "image has", "images have")
        raise UsageError(f"only {len(names)} {have} both an estimate and truth; two are needed for a scale")
    source = np.array([estimated[name].center for name in names])
    target = np.array([truth[name].center for name in names])
    middle, aim = source.mean(axis=0), target.mean(axis=0)
    spread, true_spread = float(np.linalg.norm(source - middle)), float(np.linalg.norm(target - aim))
    for what, length, centers in (("estimated", spread, source), ("true", true_spread, target)):
        if length <= 1e-12 * max(1.0, float(np.abs(centers).max())):
            raise UsageError(f"the {what} centres of all {len(names)} images coincide, so no scale can be estimated")
    covariance = (target - aim).T @ (source - middle) / (spread * true_spread)
    turns = [truth[name].rotation.T @ estimated[name].rotation for name in names]
    # Weight of the cameras' orientations against the spread of their centres. Enough to fix the turn about a line on
    # which all centres lie; negligible elsewhere.
    rotation = nearest_rotation(covariance + 1e-6 * np.mean(turns, axis=0))
    scale = float(np.trace(rotation.T @ covariance)) * true_spread / spread
    return Similarity3(scale, rotation, aim - scale * rotation @ middle)


def camera_extent(poses: Mapping[str, Rigid3]) -> float:
    """Return the largest distance between two camera centres; 0 with fewer than two."""
    centers = np.array([pose.center for pose in poses.values()]).reshape(-1, 3)
    return max((float(np.linalg.norm(centers - center, axis=1).max()) for center in centers), default=0.0)
