"""Estimate the pose of one panorama from points with known positions, or say why it cannot be."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from pano_mvs.algorithms.two_view.refinement import tangent_basis
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.text import plural
from pano_mvs.geometry import Rigid3, angle_between, rotation_from_rotvec
from pano_mvs.scene import TwoView

MAX_ERROR_RAD = float(np.deg2rad(0.5))
"""Largest error of a point that an image sees where it should."""

MIN_POINTS = 15


def resection_errors(cam_from_world: Rigid3, points_in_world: FloatArray, bearings: FloatArray) -> FloatArray:
    """Return the angles in radians between the observed rays and the rays to their points, (M,)."""
    return angle_between(cam_from_world.apply(points_in_world), bearings)


def refined_on_points(cam_from_world: Rigid3, points_in_world: FloatArray, bearings: FloatArray) -> tuple[Rigid3, int]:
    """Return a pose refined with limits that narrow, and the number of points that it sees where they should be."""
    pose = cam_from_world
    for scale_rad in (float(np.deg2rad(1.0)), MAX_ERROR_RAD / 2, MAX_ERROR_RAD / 4):
        pose = refine_resection(pose, points_in_world, bearings, scale_rad=scale_rad)
    return pose, points_seen(pose, points_in_world, bearings)


def points_seen(cam_from_world: Rigid3, points_in_world: FloatArray, bearings: FloatArray) -> int:
    """Return the number of points that a camera sees where they should be."""
    return int((resection_errors(cam_from_world, points_in_world, bearings) < MAX_ERROR_RAD).sum())


def points_needed(known: int, *, agreeing: int = 1) -> int:
    """Return how many of `known` points a reliable camera sees where they should be.

    Args:
        known: number of known points that it matches.
        agreeing: number of pairs that agree with its pose. Two or more pairs are independent evidence, so that
            imprecise matches, as in the paper, do not lead to rejection.
    """
    share = 0.4 if agreeing < 2 else 0.2
    return max(MIN_POINTS, int(np.ceil(share * known)))


def refine_resection(
    cam_from_world: Rigid3, points_in_world: FloatArray, bearings: FloatArray, *, scale_rad: float, iterations: int = 10
) -> Rigid3:
    """Minimise the Cauchy loss of the angular errors, starting from a given pose (damped Gauss–Newton).

    Args:
        cam_from_world: initial pose.
        points_in_world: (M, 3) known points, M ≥ 3.
        bearings: (M, 3) their unit rays in the camera.
        scale_rad: error at which the weight is one half.
        iterations: maximum number of steps.
    """
    frames = np.concatenate([np.swapaxes(tangent_basis(bearings), 1, 2), bearings[:, None]], axis=1)
    pose, damping = cam_from_world, 1e-6
    cost = _cost(pose, points_in_world, frames, scale_rad=scale_rad)
    for _ in range(iterations):
        residuals, jacobian = _linearised(pose, points_in_world, frames[:, :2])
        weights = 1 / (1 + np.sum(residuals**2, axis=1) / scale_rad**2)
        weighted = (jacobian * weights[:, None, None]).reshape(-1, 6).T
        hessian, gradient = weighted @ jacobian.reshape(-1, 6), weighted @ residuals.ravel()
        step = -np.linalg.solve(hessian + np.diag(damping * hessian.diagonal() + 1e-15), gradient)
        moved = Rigid3.from_center(rotation_from_rotvec(step[:3]) @ pose.rotation, pose.center + step[3:])
        moved_cost = _cost(moved, points_in_world, frames, scale_rad=scale_rad)
        if moved_cost >= cost:
            damping *= 100
            continue
        converged = cost - moved_cost < 1e-9 * cost
        pose, cost, damping = moved, moved_cost, damping / 10
        if converged:
            break
    return pose


def _linearised(pose: Rigid3, points: FloatArray, tangents: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the residuals on the bearings' tangent planes, (M, 2), and their derivatives by ω and centre, (M, 2, 6).

    r = Bᵀ x / |x|, x = R (X − C); with R ← exp(ω) R, ∂x/∂ω = −[x]× and ∂x/∂C = −R. With u = x / |x| and b a row of Bᵀ,
    (b − (b·u) u)ᵀ [x]× / |x| = (b × u)ᵀ.
    """
    in_cam = pose.apply(points)
    length = np.linalg.norm(in_cam, axis=1)
    unit = in_cam / length[:, None]
    residuals = np.einsum("mij,mj->mi", tangents, unit)
    jacobian = np.empty((*residuals.shape, 6))
    for axis, (one, other) in enumerate(((1, 2), (2, 0), (0, 1))):
        jacobian[:, :, axis] = unit[:, None, one] * tangents[:, :, other] - unit[:, None, other] * tangents[:, :, one]
    across = tangents - residuals[:, :, None] * unit[:, None]
    across /= -length[:, None, None]
    jacobian[:, :, 3:] = (across.reshape(-1, 3) @ pose.rotation).reshape(across.shape)
    return residuals, jacobian


def _cost(pose: Rigid3, points: FloatArray, frames: FloatArray, *, scale_rad: float) -> float:
    x, y, along = np.einsum("mij,mj->im", frames, pose.apply(points))
    return float(np.sum(np.log1p((np.arctan2(np.hypot(x, y), along) / scale_rad) ** 2)))


def best_pair(name: str, two_views: Mapping[tuple[str, str], TwoView]) -> tuple[str, str] | None:
    """Return the best pair of an image, reliable pairs first, then by number of matches; None if it has no pair."""
    tried = [(bool(view), len(view), view.candidates, pair) for pair, view in two_views.items() if name in pair]
    return max(tried)[-1] if tried else None


def why_no_pair(name: str, two_views: Mapping[tuple[str, str], TwoView]) -> str:
    """Return why an image has no reliable pair with any other image; "" if it has one."""
    pair = best_pair(name, two_views)
    if pair is None:
        return "it was not compared with any other image"
    if two_views[pair]:
        return ""
    partner = pair[1] if pair[0] == name else pair[0]
    return f"it has no reliable pair; its best partner is {partner!r}: {two_views[pair].reason}"


def why_refused(support: int, known: int, *, agreeing: int, partner: str, matches: int) -> str:
    """Return why a camera is not reliable.

    Args:
        support: number of known points that it sees where they should be.
        known: number of known points that it matches.
        agreeing: number of pairs that agree with its pose.
        partner: name of the image of its best pair.
        matches: number of matches of this pair.
    """
    if known >= MIN_POINTS:
        return (
            f"only {support} of {known} points known from other images {plural(support, 'is', 'are')} seen where they "
            f"should be; {points_needed(known, agreeing=agreeing)} are needed. Possible causes: repeated structure, "
            "moving objects, stitching errors, or an image that is not a panorama"
        )
    return (
        f"only {known} of its points {plural(known, 'is', 'are')} known from two other images; {MIN_POINTS} are "
        f"needed. Its best partner is {partner!r} with {matches} {plural(matches, 'match', 'matches')}. "
        "Take panoramas in between"
    )
