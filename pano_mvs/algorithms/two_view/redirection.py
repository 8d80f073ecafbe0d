"""Relative poses from a rotation: the direction is estimated given the rotation, of a pose or of upright images."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.two_view.cheirality import facing_costs
from pano_mvs.algorithms.two_view.refinement import cross, refine_relative_pose, refined_on_agreeing
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, geodesic_angle, rotation_from_rotvec

_WALLS_RAD = float(np.deg2rad(0.5))  # allows for the errors of the directions of walls


def best_redirected(
    poses: list[Rigid3], first: FloatArray, second: FloatArray, *, rng: np.random.Generator, threshold_rad: float
) -> Rigid3:
    """Return the pose with the lowest truncated squared error that is reached from the given ones.

    If two thirds of the matches are false, eight random matches are rarely all true; but an 8-point solution with some
    false ones often has nearly the right rotation and a wrong direction. Given the rotation, two matches determine the
    direction, t ∝ (R p₁ × q₁) × (R p₂ × q₂), and robust refinement finds the rest.

    Args:
        poses: second_from_first of the leading hypotheses, at least one, |t| = 1.
        first: (M, 3) unit bearings of all matches, M ≥ 2.
        second: (M, 3) unit bearings.
        rng: draws the matches.
        threshold_rad: maximum Sampson error of an inlier.
    """
    candidates = list(poses)
    for pose in poses:
        moved = pose
        # There is a single pose if the search has converged with certainty.
        for _ in range(2 if len(poses) > 1 else 1):
            moved = _redirected(moved, first, second, rng=rng, threshold_rad=threshold_rad)
            candidates.append(moved)
    costs = facing_costs(candidates, first, second, threshold_rad=threshold_rad)
    return candidates[int(np.argmin(costs))]


def _redirected(
    pose: Rigid3, first: FloatArray, second: FloatArray, *, rng: np.random.Generator, threshold_rad: float
) -> Rigid3:
    # Number of matches on which directions are compared.
    chosen = rng.choice(len(first), min(1000, len(first)), replace=False)
    p, q = first[chosen], second[chosen]
    directions, costs = direction_candidates(pose.rotation, p, q, rng=rng, threshold_rad=2 * threshold_rad)
    directions = np.concatenate([pose.translation[None], directions])
    costs = np.concatenate([facing_costs([pose], p, q, threshold_rad=2 * threshold_rad), costs])
    found = Rigid3(pose.rotation, directions[int(np.argmin(costs))])
    for widen in (2.0, 0.5):
        found = refine_relative_pose(found, p, q, scale_rad=widen * threshold_rad, max_iterations=8)
    opposite = Rigid3(found.rotation, -found.translation)
    costs = facing_costs([found, opposite], p, q, threshold_rad=threshold_rad)
    return found if costs[0] <= costs[1] else opposite


def direction_candidates(
    rotation: FloatArray,
    p: FloatArray,
    q: FloatArray,
    *,
    rng: np.random.Generator,
    threshold_rad: float,
    count: int = 200,
) -> tuple[FloatArray, FloatArray]:
    """Return translation directions from pairs of matches, (N, 3), and the cost of each, (N,).

    Given the rotation, a match constrains the direction to a great circle, t · (R p × q) = 0, and two matches intersect
    in t ∝ n₁ × n₂. Of t and −t, the direction with more matches in front of the cameras is used.

    Args:
        rotation: (3, 3) of second_from_first.
        p: (M, 3) unit bearings in the first image.
        q: (M, 3) unit bearings in the second.
        rng: draws the pairs.
        threshold_rad: Sampson error from which a match costs 1; must allow for the error of the rotation.
        count: number of pairs.
    """
    from pano_mvs.algorithms.two_view.kernels_agreement import direction_costs

    rotated = p @ rotation.T
    normals = cross(rotated, q)
    pairs = rng.integers(len(p), size=(count, 2))
    directions = cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
    lengths = np.linalg.norm(directions, axis=1)
    directions = directions[lengths > 1e-12] / lengths[lengths > 1e-12, None]
    costs = np.empty((len(directions), 2))
    direction_costs(rotated, np.ascontiguousarray(q), directions, threshold_rad, costs)
    signs = np.where(costs[:, 0] <= costs[:, 1], 1.0, -1.0)
    return directions * signs[:, None], costs.min(axis=1)


def poses_along_walls(
    rotations: FloatArray, first: FloatArray, second: FloatArray, *, rng: np.random.Generator, threshold_rad: float
) -> list[Rigid3]:
    """Return the best relative pose near each of some rotations, |t| = 1, if any.

    Two images that show walls at right angles have only four rotations to one another. Given the rotation, two matches
    determine a relative pose, so that a few true matches among many false ones are enough.

    Args:
        rotations: (K, 3, 3) of second_from_first.
        first: (M, 3) unit rays in the first image.
        second: (M, 3) in the second.
        rng: draws the matches.
        threshold_rad: maximum Sampson error of an inlier, after refinement.
    """
    wide_rad = max(_WALLS_RAD, threshold_rad)
    bands = [widen * threshold_rad for widen in (3.0, 2.0, 1.0)]
    poses = []
    for rotation in rotations if len(first) > 2 else ():
        directions, costs = direction_candidates(rotation, first, second, rng=rng, threshold_rad=wide_rad, count=400)
        if len(directions):
            rough = Rigid3(rotation, directions[int(np.argmin(costs))])
            poses.append(refined_on_agreeing(rough, first, second, thresholds_rad=bands, least=8)[0])
    return poses


def upright_poses(
    first: FloatArray, second: FloatArray, *, rng: np.random.Generator, threshold_rad: float
) -> list[Rigid3]:
    """Return at most four relative poses of two upright images, |t| = 1, best first.

    With a known vertical, a heading and two matches determine a relative pose, so that one true match in ten is enough
    to find it, where five matches at random would hardly ever all be true. The poses are refined without the
    assumption, so a slight tilt does not matter.

    Args:
        first: (M, 3) unit rays in the first image.
        second: (M, 3) in the second.
        rng: draws the matches.
        threshold_rad: Sampson error from which a match costs 1 after refinement.
    """
    if len(first) < 6:
        return []
    # Allows for the tilt of the cameras and for the steps between headings.
    wide_rad = max(float(np.deg2rad(0.6)), threshold_rad)
    rough: list[tuple[float, Rigid3]] = []
    headings = np.deg2rad(np.arange(0.0, 360.0, 2.0))
    for rotation in rotation_from_rotvec(np.outer(headings, [0.0, 1.0, 0.0])):
        directions, costs = direction_candidates(rotation, first, second, rng=rng, threshold_rad=wide_rad, count=100)
        if len(directions):
            best = int(np.argmin(costs))
            rough.append((float(costs[best]), Rigid3(rotation, directions[best])))
    poses: list[Rigid3] = []
    for _, pose in sorted(rough, key=lambda item: item[0]):
        if len(poses) == 4:
            break
        if all(float(geodesic_angle(pose.rotation, other.rotation)) > float(np.deg2rad(3.0)) for other in poses):
            poses.append(pose)
    bands = [widen * threshold_rad for widen in (3.0, 2.0, 1.0)]
    refined = [refined_on_agreeing(pose, first, second, thresholds_rad=bands, least=12)[0] for pose in poses]
    costs = facing_costs(refined, first, second, threshold_rad=threshold_rad)
    return [refined[idx] for idx in np.argsort(costs, kind="stable")]
