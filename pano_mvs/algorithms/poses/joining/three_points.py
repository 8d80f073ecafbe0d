"""Robust resection: the pose of an image from matches with points of known position, most of which may be false.

A match with a known point fixes two angles instead of the one that an epipolar circle fixes, so that far fewer true
matches are more than chance. This is what joins rooms through a door, where two images alone share too little.
"""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.poses.placement.resection import refine_resection, resection_errors
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, geodesic_angle

_SAMPLE = 3
_BATCH, _BATCHES = 500, 16
_KEPT = 4  # number of hypotheses of a batch that are refined
_REFINED = 8  # minimum number of matches for refinement
_CONFIDENCE = 0.9999
_SAME_TURN_RAD = float(np.deg2rad(1.0))


def candidate_poses(
    points: FloatArray, bearings: FloatArray, *, rng: np.random.Generator, threshold_rad: float, count: int = 6
) -> list[Rigid3]:
    """Return distinct poses under which many known points are seen where they are matched, best first.

    Hypotheses from three matches (see `poses_from_three`) are ranked by the truncated squared angle, and the best are
    refined on their inliers. Through a door, a turn of the camera and a step to the side look almost the same, so more
    than one pose is returned.

    Args:
        points: (M, 3) known points in the world.
        bearings: (M, 3) the matched unit rays in the camera.
        rng: draws the samples.
        threshold_rad: angle between a ray and its point from which a match costs 1.
        count: maximum number of poses.
    """
    found: list[tuple[float, Rigid3]] = []
    if len(points) < _REFINED:
        return []
    for batch in range(1, _BATCHES + 1):
        drawn = rng.integers(len(points), size=(_BATCH, _SAMPLE))
        rotations, translations = poses_from_three(points[drawn], bearings[drawn])
        if not len(rotations):
            continue
        costs = _costs((rotations, translations), points, bearings, threshold_rad=threshold_rad)
        for idx in np.argsort(costs, kind="stable")[:_KEPT]:
            pose = _settled(Rigid3(rotations[idx], translations[idx]), points, bearings, threshold_rad=threshold_rad)
            found.append((_cost(pose, points, bearings, threshold_rad=threshold_rad), pose))
        found = _distinct(found)[:count]
        share = float(np.mean(resection_errors(found[0][1], points, bearings) < threshold_rad))
        if (1 - share**_SAMPLE) ** (_BATCH * batch) < 1 - _CONFIDENCE:
            break
    return [pose for _, pose in found]


def _distinct(found: list[tuple[float, Rigid3]]) -> list[tuple[float, Rigid3]]:
    """Return poses by ascending cost, without those that are almost the same as a cheaper one."""
    kept: list[tuple[float, Rigid3]] = []
    for cost, pose in sorted(found, key=lambda item: item[0]):
        if all(float(geodesic_angle(pose.rotation, other.rotation)) > _SAME_TURN_RAD for _, other in kept):
            kept.append((cost, pose))
    return kept


def poses_from_three(points: FloatArray, bearings: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the poses that see three points along three rays: rotations (K, 3, 3), translations (K, 3).

    Grunert's solution in the form of Haralick et al., "Review and analysis of solutions of the three point perspective
    pose estimation problem", 1994: the ratios of the three ranges are roots of a quartic. Up to four poses a sample.

    Args:
        points: (S, 3, 3) points of each sample in the world, one in a row.
        bearings: (S, 3, 3) unit rays in the camera.
    """
    sides = np.stack([points[:, 1] - points[:, 2], points[:, 0] - points[:, 2], points[:, 0] - points[:, 1]])
    a2, b2, c2 = np.sum(sides**2, axis=2)
    cosines = [np.sum(bearings[:, i] * bearings[:, j], axis=1) for i, j in ((1, 2), (0, 2), (0, 1))]
    usable = (np.minimum(np.minimum(a2, b2), c2) > 1e-12) & (np.max(np.abs(cosines), axis=0) < 1 - 1e-9)
    if not usable.any():
        return np.zeros((0, 3, 3)), np.zeros((0, 3))
    a2, b2, c2 = a2[usable], b2[usable], c2[usable]
    alpha, beta, gamma = (cosine[usable] for cosine in cosines)
    ratios = _ratios(a2 / b2, c2 / b2, cosines=(alpha, beta, gamma))
    sample = np.repeat(np.flatnonzero(usable), 4)
    u, v = (one.ravel() for one in ratios)
    with np.errstate(invalid="ignore", divide="ignore"):
        first = np.sqrt(np.repeat(b2, 4) / (1 + v**2 - 2 * v * np.repeat(beta, 4)))
        good = np.isfinite(first) & (u > 0) & (v > 0) & (first > 0)
    ranges = first[good, None] * np.stack([np.ones(good.sum()), u[good], v[good]], axis=1)
    in_cam = ranges[..., None] * bearings[sample[good]]
    return _rigid(points[sample[good]], in_cam)


def _ratios(
    a: FloatArray, c: FloatArray, *, cosines: tuple[FloatArray, FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """Return s₂ / s₁ and s₃ / s₁, (S, 4) each, NaN where a root is not real; a = a² / b², c = c² / b²."""
    alpha, beta, gamma = cosines
    d = a - c
    coefficients = np.stack(
        [
            (d - 1) ** 2 - 4 * c * alpha**2,
            4 * (d * (1 - d) * beta - (1 - a - c) * alpha * gamma + 2 * c * alpha**2 * beta),
            2
            * (
                d**2
                - 1
                + 2 * d**2 * beta**2
                + 2 * (1 - c) * alpha**2
                - 4 * (a + c) * alpha * beta * gamma
                + 2 * (1 - a) * gamma**2
            ),
            4 * (-d * (1 + d) * beta + 2 * a * gamma**2 * beta - (1 - a - c) * alpha * gamma),
            (1 + d) ** 2 - 4 * a * gamma**2,
        ],
        axis=1,
    )
    lead = np.where(np.abs(coefficients[:, :1]) < 1e-12, 1e-12, coefficients[:, :1])
    companion = np.zeros((len(a), 4, 4))
    companion[:, 0] = -coefficients[:, 1:] / lead
    companion[:, [1, 2, 3], [0, 1, 2]] = 1
    roots = np.linalg.eigvals(companion)
    v = np.where(np.abs(roots.imag) < 1e-6 * (1 + np.abs(roots.real)), roots.real, np.nan)
    a, c, alpha, beta, gamma = (one[:, None] for one in (a, c, alpha, beta, gamma))
    d = a - c
    with np.errstate(invalid="ignore", divide="ignore"):
        u = ((d - 1) * v**2 - 2 * d * beta * v + 1 + d) / (2 * (gamma - v * alpha))
    return u, v


def _rigid(points: FloatArray, in_cam: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the rotations and translations that move triangles (K, 3, 3) onto others of the same size."""
    middle, target = points.mean(axis=1), in_cam.mean(axis=1)
    covariance = np.swapaxes(in_cam - target[:, None], 1, 2) @ (points - middle[:, None])
    left, _, right = np.linalg.svd(covariance)
    flip = np.ones((len(points), 3))
    flip[:, 2] = np.sign(np.linalg.det(left @ right))
    rotations = (left * flip[:, None]) @ right
    return rotations, target - np.einsum("kij,kj->ki", rotations, middle)


def _costs(
    poses: tuple[FloatArray, FloatArray], points: FloatArray, bearings: FloatArray, *, threshold_rad: float
) -> FloatArray:
    """Return Σ min(angle² / threshold², 1) over the matches for each pose, (K,)."""
    rotations, translations = poses
    in_cam = np.einsum("kij,mj->kmi", rotations, points) + translations[:, None]
    cosine = np.einsum("kmi,mi->km", in_cam, bearings) / np.maximum(np.linalg.norm(in_cam, axis=2), 1e-12)
    # For small angles, angle² = 2 (1 − cos).
    cost: FloatArray = np.minimum(2 * (1 - cosine) / threshold_rad**2, 1.0).sum(axis=1)
    return cost


def _cost(pose: Rigid3, points: FloatArray, bearings: FloatArray, *, threshold_rad: float) -> float:
    return float(
        _costs((pose.rotation[None], pose.translation[None]), points, bearings, threshold_rad=threshold_rad)[0]
    )


def _settled(pose: Rigid3, points: FloatArray, bearings: FloatArray, *, threshold_rad: float) -> Rigid3:
    """Refine a pose on the matches within successively narrower bands."""
    for widen in (3.0, 1.5, 1.0):
        near = resection_errors(pose, points, bearings) < widen * threshold_rad
        if near.sum() < _REFINED:
            break
        pose = refine_resection(pose, points[near], bearings[near], scale_rad=0.5 * widen * threshold_rad, iterations=5)
    return pose
