"""Verify a pair of images: estimate the relative pose, or report why there is no reliable one."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view.alternatives import distinct_geometries
from pano_mvs.algorithms.two_view.cheirality import agreement, facing_costs
from pano_mvs.algorithms.two_view.minimal_solvers import SOLVERS, Solver
from pano_mvs.algorithms.two_view.ransac import RelativePose, estimate_two_view
from pano_mvs.algorithms.two_view.refinement import pose_uncertainty
from pano_mvs.algorithms.two_view.rotation_only import estimate_rotation
from pano_mvs.algorithms.two_view.significance import (
    MAX_LOG10_FALSE_ALARMS,
    chance_of_pose,
    independent_count,
    log10_false_alarms,
)
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.core.text import plural
from pano_mvs.geometry import Rigid3, angle_between
from pano_mvs.scene import Features, TwoView

FloatArray = NDArray[np.float64]

_MAX_DIRECTION_STD_DEG = 3.0
_ROTATION_SHARE = 0.9
_MIN_PARALLAX = 4.0  # in units of the threshold
_MIN_WITH_PARALLAX = 12


@checks_settings
def verify_pair(
    first: Features,
    second: Features,
    matches_idx: NDArray[np.int32],
    *,
    rng: np.random.Generator,
    threshold_deg: Annotated[float, Setting("maximum angular Sampson error of an inlier", gt=0, le=10)] = 0.2,
    min_inliers: Annotated[int, Setting("minimum number of inliers of a pair", ge=8)] = 20,
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
    enough of them have parallax, and if together they determine its direction.

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
        falsy and state their reason.
    """
    p, q = first.bearings[matches_idx[:, 0]], second.bearings[matches_idx[:, 1]]
    threshold_rad = float(np.deg2rad(threshold_deg))
    count = len(matches_idx)
    if count < max(min_inliers, 16):
        return TwoView.failed(
            f"{count} {plural(count, 'match', 'matches')}, {max(min_inliers, 16)} needed", candidates=count
        )
    rotation, turned = estimate_rotation(p, q, rng=rng, threshold_rad=1.5 * threshold_rad)
    pose = estimate_two_view(
        p, q, rng=rng, threshold_rad=threshold_rad, solver=solver, refine=refine, max_iterations=max_iterations
    )
    if turned.sum() >= max(min_inliers, _ROTATION_SHARE * pose.inliers.sum()):
        return _from_one_place(matches_idx, rotation, turned, angles=angle_between(p @ rotation.T, q))
    kept = pose.inliers
    witnesses = independent_count(p[kept], q[kept]) if kept.any() else 0
    if not pose or witnesses < min_inliers:
        few = f"{_agreeing(witnesses, count)} on a relative pose, {min_inliers} needed"
        return TwoView.failed(pose.reason or few, candidates=count)
    reason = _why_chance(pose, p, q, witnesses=witnesses, rng=rng, threshold_rad=threshold_rad, solver=solver)
    if reason:
        return TwoView.failed(reason, candidates=count)
    pair = _Pair(matches_idx, p, q, threshold_rad)
    best = pair.judged(pose.second_from_first)
    if not (best and refine and max_alternatives):
        return best
    poses = distinct_geometries(
        pose.second_from_first,
        p,
        q,
        rng=rng,
        threshold_rad=threshold_rad,
        min_inliers=min_inliers,
        most=max_alternatives,
    )
    costs = facing_costs(poses, p, q, threshold_rad=threshold_rad)
    views = [view for idx in np.argsort(costs, kind="stable") if (view := pair.judged(poses[idx]))]
    return views[0].with_alternatives(sorted(views[1:], key=len, reverse=True)) if views else best


@dataclass(frozen=True, eq=False)
class _Pair:
    """The matches of a pair, (M, 2), and their unit bearings, (M, 3)."""

    matches_idx: NDArray[np.int32]
    p: FloatArray
    q: FloatArray
    threshold_rad: float

    def judged(self, pose: Rigid3) -> TwoView:
        """Return the geometry of a pose, or why its matches do not determine it."""
        residuals, kept = agreement(pose, self.p, self.q, threshold_rad=self.threshold_rad)
        p, q, residuals = self.p[kept], self.q[kept], residuals[kept]
        noise_rad = max(float(np.sqrt(np.mean(residuals**2))), 0.1 * self.threshold_rad)
        # Clustered matches count as one.
        noise_rad *= float(np.sqrt(len(p) / independent_count(p, q)))
        rotation_std_deg, direction_std_deg = np.rad2deg(pose_uncertainty(pose, p, q, noise_rad=noise_rad))
        parallax = angle_between(p @ pose.rotation.T, q)
        reason = _why_no_parallax(parallax, self.threshold_rad) or _why_open(direction_std_deg)
        if reason:
            return TwoView.failed(reason, candidates=len(self.p))
        return TwoView(
            matches_idx=self.matches_idx[kept],
            rotation=pose.rotation,
            direction=pose.translation,
            residuals_rad=residuals.astype(np.float32),
            geometry="general",
            candidates=len(self.p),
            parallax_deg=float(np.rad2deg(np.median(parallax))),
            rotation_std_deg=float(rotation_std_deg),
            direction_std_deg=float(direction_std_deg),
        )


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


def _why_chance(
    pose: RelativePose,
    p: FloatArray,
    q: FloatArray,
    *,
    witnesses: int,
    rng: np.random.Generator,
    threshold_rad: float,
    solver: Solver,
) -> str:
    """Return a reason if as many matches might agree on some relative pose by chance; "" otherwise."""
    # Also check among the inliers alone: if they are clustered along one epipolar circle, any match would agree.
    chance = max(
        chance_of_pose(pose.second_from_first, first, second, rng=rng, threshold_rad=threshold_rad)
        for first, second in ((p, q), (p[pose.inliers], q[pose.inliers]))
    )
    false_alarms = log10_false_alarms(
        witnesses,
        max(independent_count(p, q), witnesses),
        chance=chance,
        sample=SOLVERS[solver].sample,
        models_per_sample=SOLVERS[solver].models,
    )
    if false_alarms <= MAX_LOG10_FALSE_ALARMS:
        return ""
    return f"{_agreeing(witnesses, len(p))} on a relative pose, which may be chance: the images may not overlap"


def _agreeing(witnesses: int, count: int) -> str:
    return f"{witnesses} independent {plural(witnesses, f'match of {count} agrees', f'matches of {count} agree')}"


def _why_no_parallax(parallax: FloatArray, threshold_rad: float) -> str:
    """Return a reason if hardly any inlier moved by more than the noise; "" otherwise."""
    moved = int((parallax > _MIN_PARALLAX * threshold_rad).sum())
    if moved >= _MIN_WITH_PARALLAX:
        return ""
    return (
        f"only {moved} of {len(parallax)} inliers {plural(moved, 'has', 'have')} parallax, {_MIN_WITH_PARALLAX} "
        "needed: the images were taken too close together relative to the distance of the scene"
    )


def _why_open(direction_std_deg: float) -> str:
    """Return a reason if the inliers do not determine the direction; "" otherwise."""
    if direction_std_deg <= _MAX_DIRECTION_STD_DEG:
        return ""
    return (
        f"the matches determine the direction between the images only to {direction_std_deg:.0f}°: they lie too close "
        "together, or have too little parallax"
    )
