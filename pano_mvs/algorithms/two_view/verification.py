"""Verify a pair of images: estimate the relative pose, or report why there is no reliable one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view.alternatives import are_distinct, distinct_geometries
from pano_mvs.algorithms.two_view.cheirality import agreement, facing_costs
from pano_mvs.algorithms.two_view.learned_pairs import (
    CERTAIN,
    WEAKEST,
    Marks,
    is_accepted,
    log_odds_of,
    marks_of,
    parallel_walls,
    weight_of_learned,
)
from pano_mvs.algorithms.two_view.minimal_solvers import SOLVERS, Solver
from pano_mvs.algorithms.two_view.ransac import estimate_rotation, estimate_two_view
from pano_mvs.algorithms.two_view.redirection import poses_along_walls, upright_poses
from pano_mvs.algorithms.two_view.refinement import pose_uncertainty, refine_relative_pose, refined_on_agreeing
from pano_mvs.algorithms.two_view.significance import MAX_LOG10_FALSE_ALARMS, independent_count, significance_of_pose
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.core.text import plural
from pano_mvs.geometry import UP, Rigid3, angle_between, rotation_from_two_vectors
from pano_mvs.scene import Features, TwoView

MIN_MATCHES = 16
"""Fewest matches of which a pair is verified."""

_THRESHOLD_RAD = float(np.deg2rad(0.2))
_MIN_INLIERS = 10


@checks_settings
def verify_pair(
    first: Features,
    second: Features,
    matches_idx: NDArray[np.int32],
    *,
    rng: np.random.Generator,
    threshold_deg: Annotated[float, Setting("maximum angular Sampson error of an inlier", gt=0, le=10)] = 0.2,
    min_inliers: Annotated[int, Setting("minimum number of inliers of a pair", ge=8)] = _MIN_INLIERS,
    solver: Annotated[
        Solver, Setting("minimal solver; eight_point is the paper's, and unreliable on planar scenes")
    ] = "five_point",
    refine: Annotated[bool, Setting("false keeps the best minimal hypothesis unrefined, as in the paper")] = True,
    max_iterations: int = 15_000,
    max_alternatives: Annotated[
        int, Setting("maximum number of runner-up geometries of a pair, for repeated structure; requires refine", ge=0)
    ] = 4,
) -> TwoView:
    """Estimate the two-view geometry of two images: their relative pose and its inliers.

    A relative pose is reliable only if its number of independent inliers is more than chance (see `significance`), if
    enough of them have parallax, and if together they determine its direction. If five matches at random find no such
    pose, both images are tried as upright ones, as tripods and sensors keep them: a heading and two matches then
    determine a relative pose, so that far fewer true matches are more than chance (see `upright_poses`).

    If a network has found key points in both images, false matches agree with one another far more often than shuffled
    ones. How significant a pose must be then depends on what else speaks for it, such as a floor (see `learned_pairs`).
    Of the best pose, its runners-up, upright poses and those that keep the walls of both images at right angles, the
    most probable one counts.

    Args:
        first: key points of the first image.
        second: key points of the second image.
        matches_idx: (M, 2) positions of matching key points.
        rng: draws the samples.
        threshold_deg: maximum spherical Sampson error of an inlier.
        min_inliers: minimum number of independent inliers.
        solver: see `estimate_two_view`.
        refine: False returns the best minimal hypothesis unrefined, as in the paper.
        max_iterations: maximum number of hypotheses.
        max_alternatives: maximum number of runner-up geometries (see `distinct_geometries`); none without `refine`.

    Returns:
        The geometry: "general"; "rotation" if both images were taken from the same place; or "none". The last two are
        falsy and state their reason. All matches are kept, and a pair of geometry "none" keeps the hypotheses that were
        tried: together with other pairs, they may be more than chance.
    """
    learned = bool(first.learned and second.learned)
    pair = _Pair(first, second, matches_idx, rng, float(np.deg2rad(threshold_deg)), min_inliers)
    p, q = pair.p, pair.q
    count = len(matches_idx)
    if count < max(min_inliers, MIN_MATCHES):
        return pair.failed(f"{count} {plural(count, 'match', 'matches')}, {max(min_inliers, MIN_MATCHES)} needed")
    rotation, turned = estimate_rotation(p, q, rng=rng, threshold_rad=1.5 * pair.threshold_rad)
    pose = estimate_two_view(
        p, q, rng=rng, threshold_rad=pair.threshold_rad, solver=solver, refine=refine, max_iterations=max_iterations
    )
    minimal = SOLVERS[solver]
    tried = [pair.evidence(pose.second_from_first, sample=minimal.sample, models=minimal.models)] if pose else []
    if refine and not learned and not any(tried):
        tried += _upright(pair)
        tried.sort(key=lambda evidence: (not evidence, evidence.log10_false_alarms))
    if turned.sum() >= max(min_inliers, 0.9 * (tried[0].inliers if tried else 0)):
        return _from_one_place(matches_idx, rotation, turned, angles=angle_between(p @ rotation.T, q))
    if refine and learned:
        return _most_probable(pair, tried, most=max_alternatives, reason=pose.reason)
    if not tried:
        return pair.failed(pose.reason)
    best = pair.judged(tried[0])
    if not best:
        hypotheses = [pair.view(one) for one in tried if np.isfinite(one.log10_false_alarms)]
        alarms = min((one.log10_false_alarms for one in hypotheses), default=0.0)
        return replace(best, log10_false_alarms=alarms).with_alternatives(hypotheses)
    if not (refine and max_alternatives):
        return best
    poses = _distinct(pair, tried[0].pose, most=max_alternatives)
    costs = facing_costs(poses, p, q, threshold_rad=pair.threshold_rad)
    # Their significance is that of the pair: each was found to be more than chance.
    ranked = [poses[idx] for idx in np.argsort(costs, kind="stable")]
    judged = (best if pose is tried[0].pose else pair.judged(replace(tried[0], pose=pose)) for pose in ranked)
    views = [view for view in judged if view]
    return views[0].with_alternatives(sorted(views[1:], key=len, reverse=True)) if views else best


def verify_pose(
    first: Features,
    second: Features,
    matches_idx: NDArray[np.int32],
    *,
    pose: Rigid3,
    rng: np.random.Generator,
) -> TwoView:
    """Return the two-view geometry near a relative pose that is known from other pairs, as `verify_pair` does.

    A known pose needs no search, so fewer matches that agree with it are more than chance.

    Args:
        first: key points of the first image.
        second: key points of the second image.
        matches_idx: (M, 2) positions of matching key points.
        pose: second_from_first; its length is ignored.
        rng: draws false matches.
    """
    min_inliers = 8
    pair = _Pair(first, second, matches_idx, rng, _THRESHOLD_RAD, min_inliers, known=True)
    p, q = pair.p, pair.q
    length = float(np.linalg.norm(pose.translation))
    if length <= 0 or len(matches_idx) < min_inliers:
        return pair.failed(f"{_agreeing(len(matches_idx), len(p))}, {min_inliers} needed")
    known = Rigid3(pose.rotation, pose.translation / length)
    near = agreement(known, p, q, threshold_rad=2 * pair.threshold_rad)[1]
    if near.sum() >= min_inliers:
        known = refine_relative_pose(known, p[near], q[near], scale_rad=0.5 * pair.threshold_rad)
    return pair.judged(pair.evidence(known, sample=0, models=1))


def pose_near(
    first: Features, second: Features, matches_idx: NDArray[np.int32], *, pose: Rigid3
) -> tuple[Rigid3, float, float] | None:
    """Return the relative pose near another that most matches agree with, and how significant it is by itself.

    Args:
        first: key points of the first image.
        second: key points of the second image.
        matches_idx: (M, 2) positions of matching key points.
        pose: second_from_first; its length is ignored.

    Returns:
        The pose, |t| = 1; log₁₀ of its false alarms among all poses; and its weight (see `weight_of_pair`). None if
        hardly any match agrees, or those that do leave the direction open.
    """
    pair = _Pair(first, second, matches_idx, np.random.default_rng(0), _THRESHOLD_RAD, 8)
    p, q = pair.p, pair.q
    length = float(np.linalg.norm(pose.translation))
    if length <= 0:
        return None
    bands = [widen * pair.threshold_rad for widen in (10.0, 5.0, 2.0, 1.0)]
    near, enough = refined_on_agreeing(Rigid3(pose.rotation, pose.translation / length), p, q, thresholds_rad=bands)
    if not enough:
        return None
    evidence = pair.evidence(near, sample=5, models=10)  # as if five matches had found it
    alarms = evidence.log10_false_alarms
    if not np.isfinite(alarms) or pair.why_open(view := pair.view(evidence)):
        return None
    return near, alarms, weight_of_pair(first, second, view, log10_false_alarms=alarms)


def judged_again(first: Features, second: Features, view: TwoView, *, odds_of: Callable[[Rigid3], float]) -> TwoView:
    """Return the most probable geometry of a pair of learned matches by further evidence about its poses.

    Args:
        first: key points of the first image.
        second: key points of the second image.
        view: the pair as `verify_pair` has returned it.
        odds_of: what else speaks for a pose, second_from_first with |t| = 1: a logarithm of odds, 0 for nothing.
    """
    if view.geometry == "rotation" or not (first.learned and second.learned):
        return view
    pair = _Pair(first, second, view.all_matches_idx, np.random.default_rng(0), _THRESHOLD_RAD, _MIN_INLIERS)
    minimal = SOLVERS["five_point"]
    known = []
    for rank, one in enumerate((*([view] if view else []), *view.alternatives)):
        found = pair.evidence(Rigid3(one.rotation, one.direction), sample=minimal.sample, models=minimal.models)
        if not np.isfinite(found.log10_false_alarms):
            continue
        if rank == 0:  # of the best one it is known how it was found
            found = replace(found, log10_false_alarms=view.log10_false_alarms)
        geometry, further = pair.view(found), odds_of(found.pose)
        marks = pair_marks(first, second, geometry)
        alarms = found.log10_false_alarms
        log_odds = log_odds_of(alarms, marks) + further
        likely = is_accepted(alarms, marks, further=further) or (found.likely and further >= 0)
        if not pair.why_open(geometry):
            known.append(replace(found, log_odds=log_odds, likely=likely))
    return _by_odds(pair, known, most=len(view.alternatives)) if known else view


def weight_of_pair(first: Features, second: Features, view: TwoView, *, log10_false_alarms: float) -> float:
    """Return how significant the geometry of a pair is, relative to what is required of one that is accepted by itself.

    Args:
        first: key points of the first image.
        second: those of the second image.
        view: the geometry, or a hypothesis.
        log10_false_alarms: how significant it is by its matches.
    """
    if not (first.learned and second.learned):
        return max(0.0, log10_false_alarms / MAX_LOG10_FALSE_ALARMS)
    if log10_false_alarms > WEAKEST:
        return 0.0
    return weight_of_learned(log10_false_alarms, pair_marks(first, second, view))


def pair_marks(first: Features, second: Features, view: TwoView) -> Marks:
    """Return what speaks for the geometry of a pair of learned matches, or for a hypothesis, beside their number."""
    pose = Rigid3(view.rotation, view.direction)
    rays = first.bearings[view.matches_idx[:, 0]], second.bearings[view.matches_idx[:, 1]]
    _, direction_std_deg = _determination(pose, rays, view.residuals_rad)
    return marks_of(first, second, pose, rays=rays, direction_std_deg=direction_std_deg)


def _determination(
    pose: Rigid3,
    rays: tuple[FloatArray, FloatArray],
    residuals_rad: FloatArray | NDArray[np.float32],
    *,
    threshold_rad: float = _THRESHOLD_RAD,
) -> tuple[float, float]:
    """Return the standard deviations of rotation and direction of a pose, in degrees, by matches that agree with it."""
    noise_rad = max(float(np.sqrt(np.mean(residuals_rad**2))), 0.1 * threshold_rad)
    # Clustered matches count as one.
    noise_rad *= float(np.sqrt(len(rays[0]) / independent_count(*rays)))
    rotation_std, direction_std = pose_uncertainty(pose, *rays, noise_rad=noise_rad)
    return float(np.rad2deg(rotation_std)), float(np.rad2deg(direction_std))


@dataclass(frozen=True, eq=False)
class _Evidence:
    """A relative pose, |t| = 1, its inliers, and how many of them are independent; falsy if it may be chance."""

    pose: Rigid3
    inliers: int
    witnesses: int
    log10_false_alarms: float
    enough: bool
    likely: bool = True
    log_odds: float = 0.0  # that it is right, if a network has found the matches

    def __bool__(self) -> bool:
        return self.enough and self.likely and self.log10_false_alarms <= MAX_LOG10_FALSE_ALARMS


@dataclass(frozen=True, eq=False)
class _Pair:
    """The matches of a pair, (M, 2)."""

    first: Features
    second: Features
    matches_idx: NDArray[np.int32]
    rng: np.random.Generator
    threshold_rad: float
    min_inliers: int
    known: bool = False  # whether other pairs determine the pose

    @cached_property
    def p(self) -> FloatArray:
        """Unit bearings of the matches in the first image, (M, 3)."""
        return self.first.bearings[self.matches_idx[:, 0]]

    @cached_property
    def q(self) -> FloatArray:
        """Unit bearings of the matches in the second image, (M, 3)."""
        return self.second.bearings[self.matches_idx[:, 1]]

    def failed(self, reason: str) -> TwoView:
        """Return the falsy value of the pair with all its matches."""
        return TwoView.failed(reason, candidates=len(self.p), unverified_idx=self.matches_idx)

    def evidence(self, pose: Rigid3, *, sample: int, models: int) -> _Evidence:
        """Return a pose with the significance of the matches that agree with it.

        Args:
            pose: second_from_first, |t| = 1.
            sample: number of matches that determine such a pose.
            models: maximum number of poses from one sample.
        """
        inliers = agreement(pose, self.p, self.q, threshold_rad=self.threshold_rad)[1]
        count = int(inliers.sum())
        witnesses, alarms = significance_of_pose(
            pose,
            self.p,
            self.q,
            agreeing=inliers,
            rng=self.rng,
            threshold_rad=self.threshold_rad,
            fewest=sample + 1,
            sample=sample,
            models_per_sample=models,
        )
        if witnesses <= sample:
            return _Evidence(pose, count, witnesses, np.inf, enough=False)
        enough = witnesses >= self.min_inliers
        found = _Evidence(pose, count, witnesses, alarms, enough)
        if self.known or not (self.first.learned and self.second.learned):
            return found
        marks = pair_marks(self.first, self.second, self.view(found))
        likely = is_accepted(alarms, marks) or alarms <= CERTAIN
        return replace(found, log_odds=log_odds_of(alarms, marks), likely=likely)

    def view(self, evidence: _Evidence) -> TwoView:
        """Return the geometry of a pose with inliers."""
        pose = evidence.pose
        residuals, kept = agreement(pose, self.p, self.q, threshold_rad=self.threshold_rad)
        p, q, residuals = self.p[kept], self.q[kept], residuals[kept]
        rotation_std_deg, direction_std_deg = _determination(pose, (p, q), residuals, threshold_rad=self.threshold_rad)
        return TwoView(
            matches_idx=self.matches_idx[kept],
            rotation=pose.rotation,
            direction=pose.translation,
            residuals_rad=residuals.astype(np.float32),
            geometry="general",
            candidates=len(self.p),
            parallax_deg=float(np.rad2deg(np.median(angle_between(p @ pose.rotation.T, q)))),
            rotation_std_deg=rotation_std_deg,
            direction_std_deg=direction_std_deg,
            log10_false_alarms=evidence.log10_false_alarms,
            unverified_idx=self.matches_idx[~kept],
        )

    def why_open(self, view: TwoView) -> str:
        """Return a reason if the matches that agree with a pose do not determine it; "" otherwise."""
        rays = self.first.bearings[view.matches_idx[:, 0]], self.second.bearings[view.matches_idx[:, 1]]
        parallax = angle_between(rays[0] @ view.rotation.T, rays[1])
        moved = int((parallax > 4.0 * self.threshold_rad).sum())  # by more than the noise
        if moved < 8:
            return (
                f"only {moved} of {len(parallax)} inliers {plural(moved, 'has', 'have')} parallax, 8 needed: the "
                "images were taken too close together relative to the distance of the scene"
            )
        if view.direction_std_deg > 3.0:
            return (
                f"the matches determine the direction between the images only to {view.direction_std_deg:.0f}°: they "
                "lie too close together, or have too little parallax"
            )
        return ""

    def judged(self, evidence: _Evidence) -> TwoView:
        """Return the geometry of a pose, or why its matches do not determine it."""
        if not evidence:
            agreeing = _agreeing(evidence.witnesses, len(self.p))
            few = f"{self.min_inliers} needed"
            chance = "which may be chance: the images may not overlap"
            if evidence.log10_false_alarms <= MAX_LOG10_FALSE_ALARMS:
                chance = "but the images may show two things that look alike"
            return self.failed(f"{agreeing} on a relative pose, {chance if evidence.enough else few}")
        view = self.view(evidence)
        reason = self.why_open(view)
        return self.failed(reason) if reason else view


def _upright(pair: _Pair) -> list[_Evidence]:
    """Return poses of the pair as of two upright images, for each direction that may be up."""
    found = []
    assumed = [*product(pair.first.ups, pair.second.ups)]
    for one, other in assumed:
        level, other_level = (rotation_from_two_vectors(np.array(up), UP) for up in (one, other))
        for pose in upright_poses(
            pair.p @ level.T, pair.q @ other_level.T, rng=pair.rng, threshold_rad=pair.threshold_rad
        ):
            turned = Rigid3(other_level.T @ pose.rotation @ level, other_level.T @ pose.translation)
            found.append(pair.evidence(turned, sample=3, models=4 * len(assumed)))
    return found


def _along_walls(pair: _Pair) -> list[_Evidence]:
    """Return poses of the pair that keep the walls of its images at right angles, if both show walls."""
    first, second = pair.first.walls_from_cam, pair.second.walls_from_cam
    if first is None or second is None:
        return []
    rotations = second.T @ parallel_walls() @ first
    poses = poses_along_walls(rotations[:4], pair.p, pair.q, rng=pair.rng, threshold_rad=pair.threshold_rad)
    return [pair.evidence(pose, sample=2, models=len(poses)) for pose in poses]


def _distinct(pair: _Pair, pose: Rigid3, *, most: int) -> list[Rigid3]:
    """Return the pose, or its better twin, and at most `most` others with enough matches of their own."""
    return distinct_geometries(
        pose,
        pair.p,
        pair.q,
        rng=pair.rng,
        threshold_rad=pair.threshold_rad,
        min_inliers=pair.min_inliers,
        most=most,
    )


def _most_probable(pair: _Pair, found: list[_Evidence], *, most: int, reason: str) -> TwoView:
    """Return the most probable geometry of a pair of learned matches, with others that would be accepted as well.

    Args:
        pair: its matches.
        found: the pose with which most matches agree, if any; its runners-up and those as upright images are tried.
        most: number of others; a pair of which none is accepted keeps as many hypotheses beside the first.
        reason: why no pose was found.
    """
    minimal = SOLVERS["five_point"]
    tried = [*found, *_upright(pair), *_along_walls(pair)]
    for best in found:
        tried += [
            pair.evidence(pose, sample=minimal.sample, models=minimal.models)
            for pose in _distinct(pair, best.pose, most=most)
        ]
    known = [one for one in tried if np.isfinite(one.log10_false_alarms) and not pair.why_open(pair.view(one))]
    if not known:
        return pair.judged(found[0]) if found else pair.failed(reason)
    return _by_odds(pair, known, most=most)


def _by_odds(pair: _Pair, known: list[_Evidence], *, most: int) -> TwoView:
    """Return the geometry of the most probable of some poses, with at most `most` others (see `_most_probable`)."""
    ranked: list[_Evidence] = []
    for one in sorted(known, key=lambda one: -one.log_odds):
        if all(are_distinct(one.pose, other.pose) for other in ranked):
            ranked.append(one)
    first, *others = [one for one in ranked if one] or ranked
    views = [pair.view(one) for one in others[:most]]
    if first:
        return pair.view(first).with_alternatives(views)
    failed = replace(pair.judged(first), log10_false_alarms=first.log10_false_alarms)
    return failed.with_alternatives([pair.view(first), *views])


def _from_one_place(
    matches_idx: NDArray[np.int32], rotation: FloatArray, turned: NDArray[np.bool_], *, angles: FloatArray
) -> TwoView:
    return TwoView(
        matches_idx=matches_idx[turned],
        rotation=rotation,
        direction=np.zeros(3),
        residuals_rad=angles[turned].astype(np.float32),
        geometry="rotation",
        reason=f"taken from the same place: a rotation alone explains {turned.sum()} of {len(turned)} matches, so the "
        "pair has no parallax",
        candidates=len(turned),
    )


def _agreeing(witnesses: int, count: int) -> str:
    return f"{witnesses} independent {plural(witnesses, f'match of {count} agrees', f'matches of {count} agree')}"
