"""Robust estimation of the essential matrix on the sphere: MSAC with local optimisation; and of a rotation alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view.cheirality import agreement, facing_costs, facing_pose, least_essentials
from pano_mvs.algorithms.two_view.minimal_solvers import (
    SOLVERS,
    MinimalSolver,
    Solver,
    draw_samples,
    essential_from_bearings,
    samples_needed,
)
from pano_mvs.algorithms.two_view.redirection import best_redirected
from pano_mvs.algorithms.two_view.refinement import refine_relative_pose
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.core.text import plural
from pano_mvs.geometry import Rigid3, angle_between, nearest_rotation

_MIN_MATCHES = 16
_MIN_INLIERS = 8
_SCREEN = 500  # number of matches on which all hypotheses of a batch are compared
_LEADERS = 6  # number of hypotheses whose direction is estimated again
_POLISH = 1000  # number of inliers on which a leading hypothesis is refined


@dataclass(frozen=True, eq=False)
class RelativePose:
    """The relative pose with most support; falsy if no hypothesis could be formed."""

    second_from_first: Rigid3  # rotation, and translation of length 1
    inliers: NDArray[np.bool_]  # (M,) bool, True for matches with a small residual in front of both cameras
    reason: str = ""  # why there is no pose

    def __bool__(self) -> bool:
        return not self.reason


def estimate_two_view(
    bearings_first: FloatArray,
    bearings_second: FloatArray,
    *,
    rng: np.random.Generator,
    threshold_rad: float,
    solver: Solver = "five_point",
    refine: bool = True,
    max_iterations: int = 15_000,
) -> RelativePose:
    """Estimate the relative pose of two panoramas by robust estimation on the sphere.

    Minimal hypotheses are ranked by the truncated squared error (Torr & Zisserman 2000, "MLESAC"), in which a match
    behind a camera is an outlier, and every new best hypothesis is optimised on its inliers (Chum et al. 2003, "Locally
    optimized RANSAC"). The directions of the leading hypotheses are then estimated again (see `best_redirected`), and
    finally the angular error is minimised over the five degrees of freedom. `verify_pair` decides whether the result is
    more than chance.

    Args:
        bearings_first: (M, 3) unit rays in the first camera.
        bearings_second: (M, 3) the matching unit rays in the second.
        rng: draws the samples.
        threshold_rad: maximum Sampson error of an inlier.
        solver: "five_point" needs fewer samples and handles planar scenes; "eight_point" is linear (the paper's) and
            ambiguous on planar scenes.
        refine: False returns the best minimal hypothesis unrefined, as in the paper.
        max_iterations: maximum number of hypotheses.

    Raises:
        UsageError: if the shapes differ, the threshold is not positive, or there is no such solver.
    """
    first, second = np.asarray(bearings_first, np.float64), np.asarray(bearings_second, np.float64)
    if first.shape != second.shape or first.ndim != 2 or first.shape[1] != 3 or threshold_rad <= 0:
        raise UsageError(
            f"two-view estimation needs two (M, 3) arrays of paired bearings and a positive threshold, "
            f"got {first.shape}, {second.shape} and {threshold_rad}"
        )
    if solver not in SOLVERS:
        raise UsageError(f"there is no solver {solver!r}; choose one of {', '.join(SOLVERS)}")
    if len(first) < _MIN_MATCHES:
        return _none(
            len(first),
            f"only {len(first)} {plural(len(first), 'match', 'matches')}, {_MIN_MATCHES} needed for a hypothesis",
        )
    # Hypotheses are rejected after the first few matches, so the order of matches must be random.
    order = rng.permutation(len(first))
    search = _Search(first[order], second[order], rng, threshold_rad, SOLVERS[solver], optimise=refine)
    # Stop when a better model would have been found with this probability.
    leaders = search.run(confidence=0.9999, max_iterations=max_iterations)
    if not leaders:
        return _none(len(first), "no sample of matches determines a relative pose")
    pose: Rigid3 | None = leaders[0]
    if refine:
        pose = best_redirected(leaders, first, second, rng=rng, threshold_rad=threshold_rad)
        pose = _refined(pose, first, second, threshold_rad=threshold_rad)
    if pose is None:
        return _none(len(first), "no relative pose is supported by eight matches")
    return RelativePose(pose, agreement(pose, first, second, threshold_rad=threshold_rad)[1])


def _none(count: int, reason: str) -> RelativePose:
    return RelativePose(Rigid3.identity(), np.zeros(count, np.bool_), reason)


def _refined(pose: Rigid3, first: FloatArray, second: FloatArray, *, threshold_rad: float) -> Rigid3 | None:
    """Minimise the angular error over the matches around the inliers; None if fewer than eight are left."""
    for _ in range(3):
        residuals, near = agreement(pose, first, second, threshold_rad=2 * threshold_rad)
        if near.sum() < _MIN_INLIERS:
            return None
        core = residuals[near & (residuals < threshold_rad)]
        scale_rad = max(2 * float(np.median(core)) if len(core) else threshold_rad, 0.05 * threshold_rad)
        pose = refine_relative_pose(pose, first[near], second[near], scale_rad=scale_rad)
    return pose


@dataclass(frozen=True, eq=False)
class _Search:
    """The random search for the leading hypotheses."""

    first: FloatArray
    second: FloatArray
    rng: np.random.Generator
    threshold_rad: float
    solver: MinimalSolver
    optimise: bool

    def run(self, *, confidence: float, max_iterations: int) -> list[Rigid3]:
        """Return the leading poses, best first.

        There is one pose if a better one would have been found by now, and several if the search reached its limit.
        """
        leaders: list[tuple[float, int, Rigid3]] = []
        samples, tried, needed = 0, 0, np.inf
        while samples < needed and tried < max_iterations:
            worst = leaders[-1][0] if len(leaders) == _LEADERS else np.inf
            pose, cost, count = self._best_of_batch(worst)
            samples, tried = samples + self.solver.batch, tried + max(count, self.solver.batch)
            if pose is None:
                continue
            if not leaders or cost < leaders[0][0]:
                if self.optimise:
                    pose, cost = self._optimised(pose, cost)
                ratio = float(np.mean(self._residuals(pose) < self.threshold_rad))
                needed = min(needed, samples_needed(ratio, confidence, sample=self.solver.sample))
            leaders = sorted([*leaders, (cost, tried, pose)], key=lambda item: item[:2])[:_LEADERS]
        return [pose for _, _, pose in (leaders[:1] if samples >= needed else leaders)]

    def _best_of_batch(self, worst: float) -> tuple[Rigid3 | None, float, int]:
        """Return the best pose of a batch if it costs less than `worst`, its cost, and the number of trials."""
        size = len(self.first)
        drawn = draw_samples(self.rng, size, batch=self.solver.batch, sample=self.solver.sample)
        hypotheses = self.solver.solve(self.first[drawn], self.second[drawn])
        if not len(hypotheses):
            return None, np.inf, 0
        screened = slice(None, _SCREEN)
        # Number of hypotheses of a batch that are compared on all matches.
        finalists = least_essentials(
            hypotheses,
            self.first[screened],
            self.second[screened],
            threshold_rad=self.threshold_rad,
            # The cost without cheirality is a lower bound of the cost.
            limit=worst if len(self.first) <= _SCREEN else np.inf,
            sigmas=3.0 if self.optimise else np.inf,
            count=4,
        )
        if not len(finalists):
            return None, np.inf, len(hypotheses)
        poses = [
            facing_pose(essential, self.first, self.second, threshold_rad=self.threshold_rad) for essential in finalists
        ]
        costs = facing_costs(poses, self.first, self.second, threshold_rad=self.threshold_rad)
        return poses[int(np.argmin(costs))], float(costs.min()), len(hypotheses)

    def _optimised(self, pose: Rigid3, cost: float) -> tuple[Rigid3, float]:
        """Refit on the inliers of a wide, then successively narrower band, and keep the best."""
        candidates = self._polished(pose) if self.solver.sample == 5 else self._refitted(pose)
        if not candidates:
            return pose, cost
        costs = facing_costs(candidates, self.first, self.second, threshold_rad=self.threshold_rad)
        best = int(np.argmin(costs))
        return (candidates[best], float(costs[best])) if costs[best] < cost else (pose, cost)

    def _polished(self, pose: Rigid3) -> list[Rigid3]:
        """Minimise the angular error of the inliers; unlike the linear solution, this also works for planar scenes."""
        found: list[Rigid3] = []
        for widen in (2.0, 1.0):
            inliers = np.flatnonzero(self._residuals(pose) < widen * self.threshold_rad)
            if len(inliers) < _MIN_INLIERS:
                break
            inliers = inliers[:: 1 + len(inliers) // _POLISH]
            scale_rad = 0.5 * widen * self.threshold_rad
            pose = refine_relative_pose(
                pose, self.first[inliers], self.second[inliers], scale_rad=scale_rad, max_iterations=4
            )
            found.append(pose)
        return found

    def _refitted(self, pose: Rigid3) -> list[Rigid3]:
        """Solve the linear equations of all inliers."""
        found: list[Rigid3] = []
        for widen in (2.0, 1.5, 1.0, 1.0):
            inliers = self._residuals(pose) < widen * self.threshold_rad
            if inliers.sum() < _MIN_INLIERS:
                break
            essential = essential_from_bearings(self.first[inliers], self.second[inliers])
            some = np.flatnonzero(inliers)[:: 1 + int(inliers.sum()) // _POLISH]
            pose = facing_pose(essential, self.first[some], self.second[some], threshold_rad=self.threshold_rad)
            found.append(pose)
        return found

    def _residuals(self, pose: Rigid3) -> FloatArray:
        return agreement(pose, self.first, self.second, threshold_rad=self.threshold_rad)[0]


def estimate_rotation(
    first: FloatArray, second: FloatArray, *, rng: np.random.Generator, threshold_rad: float
) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Estimate second_from_first's rotation, (3, 3), without translation, and its inliers, (M,).

    Two-point samples, then the least-squares rotation of the inliers (Kabsch).

    Args:
        first: (M, 3) unit bearings, M ≥ 2.
        second: (M, 3) unit bearings.
        rng: draws the samples.
        threshold_rad: maximum angle between the rotated and the observed ray of an inlier.
    """
    from pano_mvs.algorithms.two_view.kernels_agreement import best_turn

    samples = rng.integers(len(first), size=(200, 2))
    rotation = np.eye(3)
    squared_chord = (2 * np.sin(threshold_rad / 2)) ** 2
    best_turn(np.ascontiguousarray(first), np.ascontiguousarray(second), samples, squared_chord, rotation)
    for _ in range(4):
        inliers = angle_between(first @ rotation.T, second) < threshold_rad
        if inliers.sum() < 2:
            break
        rotation = nearest_rotation(second[inliers].T @ first[inliers])
    return rotation, angle_between(first @ rotation.T, second) < threshold_rad
