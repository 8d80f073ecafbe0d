"""Help poses out of local optima: keep the rotation, draw the direction anew, and let both settle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view.cheirality import facing_costs
from pano_mvs.algorithms.two_view.essential import in_front, msac_costs, sampson_angles
from pano_mvs.algorithms.two_view.refinement import refine_relative_pose
from pano_mvs.geometry import Rigid3, skew

FloatArray = NDArray[np.float64]

_DIRECTIONS = 200
_MATCHES = 1000  # on which directions are compared
_ROUNDS = 2
_STEPS = 8


def best_redirected(
    poses: list[Rigid3], first: FloatArray, second: FloatArray, *, rng: np.random.Generator, threshold_rad: float
) -> Rigid3:
    """Return the pose with the least truncated squared error that the given ones lead to.

    Eight matches are seldom all true where two thirds are false; but an 8-point solution on some false ones often has
    nearly the right rotation and a wrong direction. With the rotation known two matches give the direction,
    t ∝ (R p₁ × q₁) × (R p₂ × q₂), and from there the robust refinement finds the rest.

    Args:
        poses: second_from_first of the leading hypotheses, one at least, |t| = 1.
        first: (M, 3) unit bearings of all matches, M ≥ 2.
        second: (M, 3) unit bearings.
        rng: draws the matches.
        threshold_rad: Sampson error below which a match agrees.
    """
    candidates = list(poses)
    for pose in poses:
        moved = pose
        for _ in range(_ROUNDS):
            moved = _redirected(moved, first, second, rng=rng, threshold_rad=threshold_rad)
            candidates.append(moved)
    costs = facing_costs(candidates, first, second, threshold_rad)
    return candidates[int(np.argmin(costs))]


def _redirected(
    pose: Rigid3, first: FloatArray, second: FloatArray, *, rng: np.random.Generator, threshold_rad: float
) -> Rigid3:
    chosen = rng.choice(len(first), min(_MATCHES, len(first)), replace=False)
    p, q = first[chosen], second[chosen]
    normals = np.cross(p @ pose.rotation.T, q)
    pairs = rng.integers(len(p), size=(_DIRECTIONS, 2))
    directions = np.cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
    lengths = np.linalg.norm(directions, axis=1)
    directions = np.concatenate([pose.translation[None], directions[lengths > 1e-12] / lengths[lengths > 1e-12, None]])
    essentials = skew(directions) @ pose.rotation
    # The rotation is not quite right yet, so the band is wider.
    direction = directions[int(np.argmin(msac_costs(essentials, p, q, 2 * threshold_rad)))]
    found = Rigid3(pose.rotation, direction)
    for widen in (2.0, 0.5):
        found = refine_relative_pose(found, p, q, scale_rad=widen * threshold_rad, max_iterations=_STEPS)
    near = sampson_angles(_essential(found), p, q) < threshold_rad
    return _facing(found, p[near], q[near])


def _facing(pose: Rigid3, p: FloatArray, q: FloatArray) -> Rigid3:
    """Return the pose with the sign of the translation for which most points lie in front (the error has none)."""
    opposite = Rigid3(pose.rotation, -pose.translation)
    return pose if in_front(p, q, pose).sum() >= in_front(p, q, opposite).sum() else opposite


def _essential(pose: Rigid3) -> FloatArray:
    matrix: FloatArray = skew(pose.translation) @ pose.rotation
    return matrix
