"""Which cameras of a capture are placed correctly, each judged on its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, Similarity3, geodesic_angle, nearest_rotation
from pano_mvs.geometry.pose_errors import camera_extent
from pano_mvs.scene import Poses

_MAX_ROUNDS = 10


@dataclass(frozen=True, eq=False)
class Placements:
    """Errors of single cameras after the alignment to the truth that makes most cameras of a group correct.

    Attributes:
        names: (N) registered images with truth, except those that are alone in their group.
        right: (N,) whether rotation and centre are within the limits.
        rotation_deg: (N,) error of each rotation.
        center_shares: (N,) distance of each centre from the true one, as a share of the extent of the true centres.
        doubted: (N,) whether the poses themselves report that the pose is doubtful.
        alone: registered images with truth that share their group with no other such image, so that their place cannot
            be judged.
        expected: number of images with truth.
    """

    names: tuple[str, ...]
    right: NDArray[np.bool_]
    rotation_deg: FloatArray
    center_shares: FloatArray
    doubted: NDArray[np.bool_]
    alone: tuple[str, ...]
    expected: int

    @property
    def unreported(self) -> tuple[str, ...]:
        """Names of the images whose pose is wrong but not reported as doubtful."""
        return tuple(np.array(self.names, object)[~self.right & ~self.doubted])


def judge_placements(
    poses: Poses, truth: Mapping[str, Rigid3], *, rotation_limit_deg: float = 1.0, center_limit: float = 0.02
) -> Placements:
    """Return whether each camera is placed correctly.

    Each group of cameras is aligned to the truth by the similarity that makes most of its cameras correct, among those
    that any two of its cameras propose; then by the fit to the correct cameras, until their set no longer changes.
    Unlike in a fit to all cameras, a misplaced one does not make the others look wrong. If the poses fall into pieces
    that contradict one another, the largest piece counts as correct.

    Args:
        poses: the estimated poses, with `group_idx` and `doubts` if known.
        truth: true cam_from_world by image name.
        rotation_limit_deg: largest rotation error of a correct camera.
        center_limit: largest distance of its centre from the true one, as a share of the largest distance between two
            true centres.
    """
    extent = camera_extent(truth)
    groups: dict[int, list[str]] = {}
    for idx, name in enumerate(poses.names):
        if name in truth:
            groups.setdefault(0 if poses.group_idx is None else int(poses.group_idx[idx]), []).append(name)
    estimated = poses.cameras
    limits = np.array([rotation_limit_deg, center_limit])
    judged: dict[str, FloatArray] = {}
    for group in groups.values():
        if len(group) > 1:
            errors = _least_errors({name: estimated[name] for name in group}, truth, extent, limits)
            judged.update(zip(group, errors, strict=True))
    names = tuple(name for name in poses.names if name in judged)
    errors = np.array([judged[name] for name in names]).reshape(-1, 2)
    return Placements(
        names=names,
        right=np.asarray((errors <= limits).all(axis=1)),
        rotation_deg=errors[:, 0],
        center_shares=errors[:, 1],
        doubted=np.array([name in poses.doubts for name in names], np.bool_),
        alone=tuple(group[0] for group in groups.values() if len(group) == 1),
        expected=len(truth),
    )


def _least_errors(
    estimated: Mapping[str, Rigid3], truth: Mapping[str, Rigid3], extent: float, limits: FloatArray
) -> FloatArray:
    """Return rotation errors in degrees and centre errors in extents, (N, 2), after the best alignment of a group."""
    names = list(estimated)
    centers, true_centers = (np.array([poses[name].center for name in names]) for poses in (estimated, truth))
    turns = np.array([truth[name].rotation.T @ estimated[name].rotation for name in names])

    def errors_of(truth_from_estimated: Similarity3) -> FloatArray:
        rotation_deg = np.rad2deg(geodesic_angle(turns, truth_from_estimated.rotation))
        distances = np.linalg.norm(truth_from_estimated.apply(centers) - true_centers, axis=1)
        return np.stack([rotation_deg, distances / extent], axis=1)

    def fitted_to(chosen: NDArray[np.int64]) -> FloatArray | None:
        unit = np.deg2rad(limits[0]), limits[1] * extent
        aligned = _alignment(turns[chosen], centers[chosen], true_centers[chosen], unit)
        return None if aligned is None else errors_of(aligned)

    best, fitted = np.full((len(names), 2), np.inf), np.zeros(0, np.int64)
    for pair in combinations(range(len(names)), 2):
        proposed = fitted_to(np.array(pair))
        if proposed is not None:
            best = min(best, proposed, key=lambda errors: _badness(errors, limits))
    for _ in range(_MAX_ROUNDS):
        right = np.flatnonzero((best <= limits).all(axis=1))
        again = fitted_to(right) if len(right) > 1 and not np.array_equal(right, fitted) else None
        if again is None:
            break
        best, fitted = again, right
    return best


def _alignment(
    turns: FloatArray, centers: FloatArray, true_centers: FloatArray, unit: tuple[float, float]
) -> Similarity3 | None:
    """Return the similarity with the least squared errors of rotations and centres, None if the centres coincide.

    Args:
        turns: (N, 3, 3) world_truth from world_estimated according to each camera's orientation.
        centers: (N, 3) of the estimated cameras.
        true_centers: (N, 3) of the true ones.
        unit: the angle in radians and the length that weigh the same.
    """
    middle, aim = centers.mean(axis=0), true_centers.mean(axis=0)
    spread, true_spread = float(np.linalg.norm(centers - middle)), float(np.linalg.norm(true_centers - aim))
    if spread <= 1e-9 * max(1.0, float(np.abs(centers).max())) or true_spread == 0:
        return None
    covariance = (true_centers - aim).T @ (centers - middle)
    scale = true_spread / spread
    for _ in range(_MAX_ROUNDS):
        # An angle θ between rotations R and T is θ² ≈ 3 − tr(Rᵀ T).
        rotation = nearest_rotation(2 * scale * covariance / unit[1] ** 2 + turns.sum(axis=0) / unit[0] ** 2)
        scale = max(float(np.trace(rotation.T @ covariance)) / spread**2, 1e-3 * true_spread / spread)
    return Similarity3(scale, rotation, aim - scale * rotation @ middle)


def _badness(errors: FloatArray, limits: FloatArray) -> tuple[int, float]:
    """Return a sort key of errors: the number of wrong cameras, then the mean share of the limits of correct ones."""
    shares = (errors / limits).max(axis=1)
    right = shares <= 1
    return int((~right).sum()), float(shares[right].mean() if right.any() else shares.mean())
