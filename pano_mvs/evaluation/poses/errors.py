"""Errors of camera poses: relative poses of all pairs, and camera centres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.evaluation.poses.alignment import align_centers, camera_extent
from pano_mvs.geometry import Rigid3, angle_between, geodesic_angle

AUC_LIMITS_DEG = (0.1, 0.5, 1.0, 5.0)
# Centres closer than this share of the capture's extent coincide: an image that occurs twice.
_COINCIDENT_SHARE = 1e-6
_ROUNDING = 1e-12  # of a centre's coordinates


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of relative poses, over all pairs of images with ground truth.

    Attributes:
        pairs: (P) the pairs of image names.
        rotation_deg: (P,) error of second_from_first's rotation; 180 if an image is not registered.
        direction_deg: (P,) error of the direction of its translation; 180 if an image is not registered.
        pair_deg: (P,) the larger of the two.
        measured: (P,) False if an image is not registered, or the two are in different groups.
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


def _relative(poses: Mapping[str, Rigid3], names: Sequence[str], extent: float | None = None) -> _RelativePoses:
    """Return second_from_first of all pairs of some images.

    Args:
        poses: cam_from_world by image name, in one world.
        names: the images.
        extent: largest distance between two centres of the capture; None: between two of these images.
    """
    rotations = np.array([poses[name].rotation for name in names])
    centers = np.array([poses[name].center for name in names])
    first, second = np.triu_indices(len(names), 1)
    translations = np.einsum("pij,pj->pi", rotations[second], centers[first] - centers[second])
    lengths = np.linalg.norm(translations, axis=1)
    extent = float(lengths.max(initial=0)) if extent is None else extent
    apart = lengths > max(_COINCIDENT_SHARE * extent, _ROUNDING * float(np.abs(centers).max()))
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
