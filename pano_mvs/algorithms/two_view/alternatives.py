"""Runner-up geometries: other relative poses that matches of the same pair agree on.

Where structure repeats (tiles, columns), matches that are shifted by one period agree with one another as well as true
ones do. The relative pose with most inliers then often has the right rotation and a wrong direction, and the true
direction is supported by other matches of the same list. One pair alone cannot tell them apart; all pairs together can.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view.cheirality import agreement, facing_costs, facing_pose
from pano_mvs.algorithms.two_view.essential import msac_costs
from pano_mvs.algorithms.two_view.five_point import essentials_from_five
from pano_mvs.algorithms.two_view.hypotheses import draw_samples
from pano_mvs.algorithms.two_view.refinement import refine_relative_pose
from pano_mvs.algorithms.two_view.significance import (
    MAX_LOG10_FALSE_ALARMS,
    chance_of_pose,
    independent_count,
    log10_false_alarms,
)
from pano_mvs.geometry import Rigid3, angle_between, geodesic_angle, skew

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

_DIRECTIONS = 300  # pairs of matches that vote for a direction, for each rotation
_TWINS = 16  # samples among the matches of a known geometry
_FRESH = 192  # samples among the matches that no geometry explains
_PEAKS = 6  # candidates of each kind that are refined
_MIN_OWN_RATIO = 0.6  # own independent matches, of the number that a best geometry needs
_MIN_OWN_SHARE = 0.08  # own matches, of the number that the best geometry has
_MIN_TURN_RAD = float(np.deg2rad(1.5))
_MIN_DIRECTION_RAD = float(np.deg2rad(2.5))
_SAME_ROTATION_RAD = float(np.deg2rad(2.0))
_VARIANT_TURN_RAD = float(np.deg2rad(5.0))
_VARIANT_DIRECTION_RAD = float(np.deg2rad(20.0))


@dataclass(frozen=True, eq=False)
class _Geometry:
    """A relative pose, and which matches agree with it, (M,)."""

    pose: Rigid3
    agreeing: BoolArray


def runner_ups(
    best: Rigid3,
    first: FloatArray,
    second: FloatArray,
    *,
    rng: np.random.Generator,
    threshold_rad: float,
    min_inliers: int,
    most: int,
) -> list[Rigid3]:
    """Return relative poses beside the best one that enough other matches agree on.

    They are looked for one after the other, each among the matches that none before explains. A pose counts only if
    the matches of its own are more than chance among those, by the same test that the best one passes; it must differ
    from all others by 1.5° of rotation or 2.5° of direction.

    Args:
        best: second_from_first of the best geometry, |t| = 1.
        first: (M, 3) unit bearings of all matches.
        second: (M, 3) unit bearings.
        rng: draws the samples.
        threshold_rad: Sampson error below which a match agrees.
        min_inliers: independent matches that the best geometry needed; a runner-up needs 0.6 times as many of its own.
        most: at most so many poses.
    """
    known = [_Geometry(best, agreement(best, first, second, threshold_rad)[1])]
    while len(known) <= most:
        searched = ~np.any([geometry.agreeing for geometry in known], axis=0)
        needed = max(_MIN_OWN_RATIO * min_inliers, _MIN_OWN_SHARE * float(known[0].agreeing.sum()))
        found = [
            _Geometry(pose, agreement(pose, first, second, threshold_rad)[1])
            for pose in _candidates([geometry.pose for geometry in known], searched, first, second, rng, threshold_rad)
        ]
        found = [geometry for geometry in found if _is_other(geometry, known, searched)]
        if not found:
            break
        chosen = max(found, key=lambda geometry: int((geometry.agreeing & searched).sum()))
        if not _significant(chosen, known, searched, first, second, needed, rng, threshold_rad):
            break
        known.append(chosen)
    return [geometry.pose for geometry in known[1:]]


def _is_other(geometry: _Geometry, known: Sequence[_Geometry], searched: BoolArray) -> bool:
    """Return whether a geometry is none of the known ones, nor one of them bent towards some more matches."""
    mostly_own = 2 * (geometry.agreeing & searched).sum() > geometry.agreeing.sum()
    for other in known:
        turn = float(geodesic_angle(geometry.pose.rotation, other.pose.rotation))
        between = float(angle_between(geometry.pose.translation, other.pose.translation))
        if turn < _MIN_TURN_RAD and between < _MIN_DIRECTION_RAD:
            return False
        if turn < _VARIANT_TURN_RAD and between < _VARIANT_DIRECTION_RAD and not mostly_own:
            return False
    return True


def _significant(
    geometry: _Geometry,
    known: Sequence[_Geometry],
    searched: BoolArray,
    first: FloatArray,
    second: FloatArray,
    needed: float,
    rng: np.random.Generator,
    threshold_rad: float,
) -> bool:
    own = geometry.agreeing & searched
    witnesses = independent_count(first[own], second[own]) if own.any() else 0
    if witnesses < needed:
        return False
    turns = [float(geodesic_angle(geometry.pose.rotation, other.pose.rotation)) for other in known]
    # Two matches determine the direction where the rotation is known already.
    sample, models = (2, 1) if min(turns) < _SAME_ROTATION_RAD else (5, 10)
    false_alarms = log10_false_alarms(
        witnesses,
        max(independent_count(first[searched], second[searched]), witnesses),
        chance=max(
            chance_of_pose(geometry.pose, first[among], second[among], rng=rng, threshold_rad=threshold_rad)
            for among in (searched, own)
        ),
        sample=sample,
        models_per_sample=models,
    )
    return false_alarms <= MAX_LOG10_FALSE_ALARMS


def _candidates(
    known: Sequence[Rigid3],
    searched: BoolArray,
    first: FloatArray,
    second: FloatArray,
    rng: np.random.Generator,
    threshold_rad: float,
) -> list[Rigid3]:
    """Return poses that some of the unexplained matches agree on.

    Of three kinds: the known rotations, with the directions that pairs of unexplained matches vote for; the solutions
    of five explained matches, since the matches of one plane fit two geometries; those of five unexplained ones.
    """
    rest = np.flatnonzero(searched)
    if len(rest) < 5:
        return []
    p, q = first[rest], second[rest]
    rough: list[Rigid3] = []
    for rotation in _distinct_rotations(known):
        rough += _redirections(rotation, p, q, rng, threshold_rad)
    for among, count in ((np.flatnonzero(~searched), _TWINS), (rest, _FRESH)):
        drawn = among[draw_samples(rng, len(among), batch=count, sample=5)]
        essentials = essentials_from_five(first[drawn], second[drawn])[0]
        costs = msac_costs(essentials, p, q, 2 * threshold_rad)
        best = essentials[np.argsort(costs, kind="stable")[:_PEAKS]]
        rough += [facing_pose(essential, p, q, 2 * threshold_rad) for essential in best]
    return [_settled(pose, first, second, rest, threshold_rad) for pose in rough]


def _distinct_rotations(poses: Sequence[Rigid3]) -> list[FloatArray]:
    kept: list[FloatArray] = []
    for pose in poses:
        if all(geodesic_angle(pose.rotation, other) > _MIN_TURN_RAD for other in kept):
            kept.append(pose.rotation)
    return kept


def _redirections(
    rotation: FloatArray, p: FloatArray, q: FloatArray, rng: np.random.Generator, threshold_rad: float
) -> list[Rigid3]:
    """Return poses of this rotation with the directions that most matches vote for.

    A match allows the directions of a great circle, t · (R p × q) = 0; two matches meet in t ∝ n₁ × n₂.
    """
    normals = np.cross(p @ rotation.T, q)
    pairs = rng.integers(len(p), size=(_DIRECTIONS, 2))
    directions = np.cross(normals[pairs[:, 0]], normals[pairs[:, 1]])
    lengths = np.linalg.norm(directions, axis=1)
    directions = directions[lengths > 1e-12] / lengths[lengths > 1e-12, None]
    # The rotation is not quite right for these matches yet, so the band is wider.
    costs = msac_costs(skew(directions) @ rotation, p, q, 2 * threshold_rad)
    kept: list[FloatArray] = []
    for direction in directions[np.argsort(costs, kind="stable")]:
        if all(abs(direction @ other) < np.cos(_MIN_DIRECTION_RAD) for other in kept):
            kept.append(direction)
            if len(kept) == _PEAKS:
                break
    found = []
    for direction in kept:
        two = [Rigid3(rotation, direction), Rigid3(rotation, -direction)]
        found.append(two[int(np.argmin(facing_costs(two, p, q, 2 * threshold_rad)))])
    return found


def _settled(
    pose: Rigid3, first: FloatArray, second: FloatArray, rest: NDArray[np.intp], threshold_rad: float
) -> Rigid3:
    """Refine on the unexplained matches, then on all that agree."""
    everything = np.arange(len(first))
    for among, widen in ((rest, 3.0), (rest, 2.0), (everything, 1.5), (everything, 1.0)):
        p, q = first[among], second[among]
        near = agreement(pose, p, q, widen * threshold_rad)[1]
        if near.sum() < 8:
            break
        pose = refine_relative_pose(pose, p[near], q[near], scale_rad=0.5 * widen * threshold_rad, max_iterations=6)
    return pose
