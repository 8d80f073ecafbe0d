"""Escape local optima of relative poses: keep the rotation, estimate the direction again, and refine both."""

from __future__ import annotations

import numpy as np

from pano_mvs.algorithms.two_view.cheirality import facing_costs
from pano_mvs.algorithms.two_view.refinement import cross, refine_relative_pose
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3

_ROUNDS = 2


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
        for _ in range(_ROUNDS if len(poses) > 1 else 1):
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
