"""Robust estimation of the essential matrix on the sphere: MSAC with local optimisation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view.essential import (
    essential_from_bearings,
    in_front,
    msac_costs,
    poses_from_essential,
    sampson_angles,
)
from pano_mvs.algorithms.two_view.redirection import best_redirected
from pano_mvs.algorithms.two_view.refinement import refine_relative_pose
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, angle_between, skew

FloatArray = NDArray[np.float64]

_SAMPLE = 8
_BATCH = 256
_SCREEN = 400  # matches on which all hypotheses of a batch are compared
_FINALISTS = 4  # hypotheses of a batch that are compared on all matches
_LEADERS = 6  # hypotheses that are given new directions


@dataclass(frozen=True, eq=False)
class RelativePose:
    """The relative pose that most matches agree on; falsy where no hypothesis could be formed.

    Attributes:
        second_from_first: rotation, and translation of length 1.
        inliers: (M,) bool, which matches agree: small residual, and in front of both cameras.
        residuals_rad: (M,) spherical Sampson error of all matches.
        iterations: number of hypotheses.
        reason: why there is none.
    """

    second_from_first: Rigid3
    inliers: NDArray[np.bool_]
    residuals_rad: FloatArray
    iterations: int
    reason: str = ""

    def __bool__(self) -> bool:
        """Return whether a pose was found."""
        return not self.reason


def estimate_two_view(
    bearings_first: FloatArray,
    bearings_second: FloatArray,
    *,
    rng: np.random.Generator,
    threshold_rad: float,
    confidence: float = 0.9999,
    max_iterations: int = 15_000,
) -> RelativePose:
    """Return the relative pose that most matches agree on.

    Spherical 8-point hypotheses, ranked by the truncated squared error (Torr & Zisserman 2000, "MLESAC") and refitted
    on their inliers whenever one leads (Chum et al. 2003, "Locally optimized RANSAC"); of the four decompositions the
    one with most points in front of both cameras; the leaders are given new directions (see `best_redirected`); last,
    the angular error is minimised over the five degrees of freedom. Whether the result is more than
    chance is for `verify_pair` to judge.

    Args:
        bearings_first: (M, 3) unit rays in the first camera.
        bearings_second: (M, 3) the matching unit rays in the second.
        rng: draws the samples.
        threshold_rad: Sampson error below which a match agrees.
        confidence: stop once a better model would have been met with this probability.
        max_iterations: at most so many hypotheses.

    Raises:
        UsageError: if the shapes differ, or the threshold is not positive.
    """
    first, second = np.asarray(bearings_first, np.float64), np.asarray(bearings_second, np.float64)
    if first.shape != second.shape or first.ndim != 2 or first.shape[1] != 3 or threshold_rad <= 0:
        raise UsageError(f"two-view estimation needs two (M, 3) arrays of paired bearings and a positive threshold, "
                         f"got {first.shape}, {second.shape} and {threshold_rad}")  # fmt: skip
    count = len(first)
    if count < 2 * _SAMPLE:
        return _none(count, f"only {count} matches, {2 * _SAMPLE} needed for a hypothesis")
    leaders, iterations = _leading_essentials(
        first, second, rng=rng, threshold_rad=threshold_rad, confidence=confidence, max_iterations=max_iterations
    )
    starts = [_facing_pose(essential, first, second, threshold_rad) for essential in leaders]
    pose = best_redirected(starts, first, second, rng=rng, threshold_rad=threshold_rad)
    for _ in range(3):
        residuals = sampson_angles(skew(pose.translation) @ pose.rotation, first, second)
        near = (residuals < 2 * threshold_rad) & _plausible(first, second, pose, threshold_rad)
        if near.sum() < _SAMPLE:
            return _none(count, "no relative pose is shared by eight matches")
        core = residuals[near & (residuals < threshold_rad)]
        scale_rad = max(2 * float(np.median(core)) if len(core) else threshold_rad, 0.05 * threshold_rad)
        pose = refine_relative_pose(pose, first[near], second[near], scale_rad=scale_rad)
    residuals = sampson_angles(skew(pose.translation) @ pose.rotation, first, second)
    inliers = (residuals < threshold_rad) & _plausible(first, second, pose, threshold_rad)
    return RelativePose(pose, inliers, residuals, iterations)


def _none(count: int, reason: str) -> RelativePose:
    return RelativePose(Rigid3.identity(), np.zeros(count, np.bool_), np.full(count, np.pi / 2), 0, reason)


def _leading_essentials(
    first: FloatArray,
    second: FloatArray,
    *,
    rng: np.random.Generator,
    threshold_rad: float,
    confidence: float,
    max_iterations: int,
) -> tuple[list[FloatArray], int]:
    """Return the essential matrices with the least truncated squared error, best first, and how many were tried."""
    leaders: list[tuple[float, int, FloatArray]] = []
    tried, needed = 0, float(max_iterations)
    while tried < needed:
        samples = _samples(rng, len(first))
        hypotheses = essential_from_bearings(first[samples], second[samples])
        screen = rng.choice(len(first), min(_SCREEN, len(first)), replace=False)
        screened = msac_costs(hypotheses, first[screen], second[screen], threshold_rad)
        finalists = hypotheses[np.argsort(screened, kind="stable")[:_FINALISTS]]
        costs = msac_costs(finalists, first, second, threshold_rad)
        tried += _BATCH
        leader, cost = finalists[np.argmin(costs)], float(costs.min())
        if not leaders or cost < leaders[0][0]:
            leader, cost = _locally_optimised(leader, cost, first, second, threshold_rad)
            inlier_ratio = float(np.mean(sampson_angles(leader, first, second) < threshold_rad))
            needed = min(needed, _hypotheses_needed(inlier_ratio, confidence))
        leaders = sorted([*leaders, (cost, tried, leader)], key=lambda item: item[:2])[:_LEADERS]
    return [essential for _, _, essential in leaders], tried


def _samples(rng: np.random.Generator, count: int) -> NDArray[np.int64]:
    """Return samples of distinct matches, (batch, 8)."""
    samples = rng.integers(count, size=(_BATCH, _SAMPLE))
    repeated = np.flatnonzero((np.diff(np.sort(samples, axis=1), axis=1) == 0).any(axis=1))
    for row in repeated:
        samples[row] = rng.choice(count, _SAMPLE, replace=False)
    return samples


def _locally_optimised(
    essential: FloatArray, cost: float, first: FloatArray, second: FloatArray, threshold_rad: float
) -> tuple[FloatArray, float]:
    """Refit on the inliers of a wide, then ever narrower band, and keep the best."""
    candidate = essential
    for widen in (2.0, 1.5, 1.0, 1.0):
        inliers = sampson_angles(candidate, first, second) < widen * threshold_rad
        if inliers.sum() < _SAMPLE:
            break
        candidate = essential_from_bearings(first[inliers], second[inliers])
        candidate_cost = float(msac_costs(candidate[None], first, second, threshold_rad)[0])
        if candidate_cost < cost:
            essential, cost = candidate, candidate_cost
    return essential, cost


def _hypotheses_needed(inlier_ratio: float, confidence: float) -> float:
    """Return after how many samples one without outliers has been drawn with the wanted probability."""
    clean = inlier_ratio**_SAMPLE
    if clean >= 1:
        return 0.0
    return float(np.log1p(-confidence) / np.log1p(-clean)) if clean > 0 else np.inf


def _facing_pose(essential: FloatArray, first: FloatArray, second: FloatArray, threshold_rad: float) -> Rigid3:
    """Return the decomposition with most inliers in front of both cameras."""
    inliers = sampson_angles(essential, first, second) < threshold_rad
    poses = poses_from_essential(essential)
    return max(poses, key=lambda pose: int(in_front(first[inliers], second[inliers], pose).sum()))


def _plausible(first: FloatArray, second: FloatArray, pose: Rigid3, threshold_rad: float) -> NDArray[np.bool_]:
    """Return which matches lie in front of both cameras, or so far away that noise decides their sign."""
    far = angle_between(first @ pose.rotation.T, second) < 2 * threshold_rad
    plausible: NDArray[np.bool_] = far | in_front(first, second, pose)
    return plausible
