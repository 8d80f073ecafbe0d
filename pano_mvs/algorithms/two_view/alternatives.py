"""Runner-up geometries: other relative poses that are supported by matches of the same pair.

If structure repeats (tiles, columns), matches that are shifted by one period are as consistent with one another as true
ones. The relative pose with most inliers then often has the right rotation and a wrong direction, while other matches
of the same list support the true direction. A single pair cannot decide between them; all pairs together can.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.two_view.cheirality import agreement, facing_costs, facing_pose, least_essentials
from pano_mvs.algorithms.two_view.minimal_solvers import draw_samples, essentials_from_five
from pano_mvs.algorithms.two_view.redirection import direction_candidates
from pano_mvs.algorithms.two_view.refinement import refined_on_agreeing
from pano_mvs.algorithms.two_view.significance import MAX_LOG10_FALSE_ALARMS, significance_of_pose
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, angle_between, geodesic_angle

_TWINS = 16  # number of samples among the matches of a known geometry
_PEAKS = 6  # number of candidates of each kind that are refined
_MIN_TURN_RAD = float(np.deg2rad(1.5))
_MIN_DIRECTION_RAD = float(np.deg2rad(2.5))


@dataclass(frozen=True, eq=False)
class _Geometry:
    """A relative pose, and which matches agree with it, (M,)."""

    pose: Rigid3
    agreeing: NDArray[np.bool_]


def distinct_geometries(
    best: Rigid3,
    first: FloatArray,
    second: FloatArray,
    *,
    rng: np.random.Generator,
    threshold_rad: float,
    min_inliers: int,
    most: int,
) -> list[Rigid3]:
    """Return the best relative pose, and others with enough matches of their own.

    The others are searched one at a time, each among the matches that none of the previous ones explains. A pose is
    accepted only if its own matches are more than chance among those, by the same test as for the best one; it must
    differ from all previous ones by 1.5° of rotation or 2.5° of direction. The best pose is replaced if most of its
    matches lie on one plane, and fit the plane's other pose together with more of the remaining matches.

    Args:
        best: second_from_first of the best geometry, |t| = 1.
        first: (M, 3) unit bearings of all matches.
        second: (M, 3) unit bearings.
        rng: draws the samples.
        threshold_rad: maximum Sampson error of an inlier.
        min_inliers: minimum number of independent matches of the best geometry; others need 0.6 times this number of
            their own, and a twelfth of the number of the best one.
        most: maximum number of other poses.
    """
    search = _Search(first, second, rng, threshold_rad, min_inliers)
    best, twins = search.better_twin(best)
    known = [search.geometry(best)]
    # Number of samples among the matches that the best geometry does not explain.
    pool = np.concatenate([twins, search.solutions(np.flatnonzero(~known[0].agreeing), 96)])
    while len(known) <= most:
        geometry = search.next_geometry(known, pool)
        if geometry is None:
            break
        known.append(geometry)
        pool = np.concatenate([pool, search.solutions(np.flatnonzero(geometry.agreeing), _TWINS)])
    return [geometry.pose for geometry in known]


def are_distinct(pose: Rigid3, other: Rigid3) -> bool:
    """Return whether two relative poses differ by 1.5° of rotation or 2.5° of direction."""
    turn = float(geodesic_angle(pose.rotation, other.rotation))
    return turn > _MIN_TURN_RAD or float(angle_between(pose.translation, other.translation)) > _MIN_DIRECTION_RAD


@dataclass(frozen=True, eq=False)
class _Search:
    """The search for further geometries of a pair."""

    first: FloatArray
    second: FloatArray
    rng: np.random.Generator
    threshold_rad: float
    min_inliers: int

    def geometry(self, pose: Rigid3) -> _Geometry:
        """Return a pose with the matches that agree with it."""
        return _Geometry(pose, agreement(pose, self.first, self.second, threshold_rad=self.threshold_rad)[1])

    def solutions(self, among: NDArray[np.intp], count: int) -> FloatArray:
        """Return the essential matrices of samples of five matches, (N, 3, 3)."""
        if len(among) < 5:
            return np.zeros((0, 3, 3))
        drawn = among[draw_samples(self.rng, len(among), batch=count, sample=5)]
        return essentials_from_five(self.first[drawn], self.second[drawn])[0]

    def better_twin(self, best: Rigid3) -> tuple[Rigid3, FloatArray]:
        """Return the best pose or, if it costs less, another pose that fits its matches, and all essential matrices."""
        twins = self.solutions(np.flatnonzero(self.geometry(best).agreeing), _TWINS)
        order = self.rng.permutation(len(self.first))
        p, q = self.first[order], self.second[order]
        poses = [best]
        for essential in least_essentials(twins, p, q, threshold_rad=2 * self.threshold_rad, count=_PEAKS):
            rough = facing_pose(essential, p, q, threshold_rad=2 * self.threshold_rad)
            if are_distinct(rough, best):
                poses.append(self._settled(rough, p, q, widths=(2.0, 1.0)))
        costs = facing_costs(poses, self.first, self.second, threshold_rad=self.threshold_rad)
        return poses[int(np.argmin(costs))], twins

    def next_geometry(self, known: Sequence[_Geometry], pool: FloatArray) -> _Geometry | None:
        """Return the geometry with most matches of its own; None unless these are more than chance."""
        searched = ~np.any([geometry.agreeing for geometry in known], axis=0)
        # Own independent matches, relative to the number that a best geometry needs.
        needed = max(0.6 * self.min_inliers, 0.08 * float(known[0].agreeing.sum()))
        rest = self.rng.permutation(np.flatnonzero(searched))
        if len(rest) < needed:
            return None
        p, q = self.first[rest], self.second[rest]
        rough = [
            self._settled(pose, p, q, widths=(3.0, 2.0))
            for pose in self._candidates(known, pool, p=p, q=q)
            if agreement(pose, p, q, threshold_rad=3 * self.threshold_rad)[1].sum() >= needed
        ]
        support = [int(agreement(pose, p, q, threshold_rad=1.5 * self.threshold_rad)[1].sum()) for pose in rough]
        chosen: list[Rigid3] = []
        for idx in np.argsort(support, kind="stable")[::-1]:
            # Number of candidates that are verified.
            if support[idx] < needed or len(chosen) == 4:
                break
            if all(are_distinct(rough[idx], other) for other in chosen):
                chosen.append(rough[idx])
        found = [self.geometry(self._settled(pose, self.first, self.second, widths=(1.5, 1.0))) for pose in chosen]
        found.sort(key=lambda geometry: -int((geometry.agreeing & searched).sum()))
        for geometry in found:
            if _is_other(geometry, known, searched) and self._significant(geometry, known, searched, needed=needed):
                return geometry
        return None

    def _candidates(
        self, known: Sequence[_Geometry], pool: FloatArray, *, p: FloatArray, q: FloatArray
    ) -> list[Rigid3]:
        """Return poses that some of the unexplained matches, p and q, support.

        There are two kinds: the known rotations with directions from pairs of these matches, and the essential matrices
        of the pool.
        """
        found: list[Rigid3] = []
        wide_rad = 2 * self.threshold_rad  # the rotation is only approximate for these matches
        for rotation in _distinct_rotations(known):
            directions, costs = direction_candidates(rotation, p, q, rng=self.rng, threshold_rad=wide_rad)
            found += [Rigid3(rotation, direction) for direction in _peaks(directions, costs)]
        finalists = least_essentials(pool, p, q, threshold_rad=wide_rad, count=_PEAKS)
        return found + [facing_pose(essential, p, q, threshold_rad=wide_rad) for essential in finalists]

    def _settled(self, pose: Rigid3, p: FloatArray, q: FloatArray, *, widths: Sequence[float]) -> Rigid3:
        """Refine on the matches within successively narrower bands, in units of the threshold."""
        bands = [widen * self.threshold_rad for widen in widths]
        return refined_on_agreeing(pose, p, q, thresholds_rad=bands, max_iterations=6)[0]

    def _significant(
        self, geometry: _Geometry, known: Sequence[_Geometry], searched: NDArray[np.bool_], *, needed: float
    ) -> bool:
        turn = min(float(geodesic_angle(geometry.pose.rotation, other.pose.rotation)) for other in known)
        # Two matches determine the direction if the rotation is known.
        sample, models = (2, 1) if turn < float(np.deg2rad(2.0)) else (5, 10)
        _, false_alarms = significance_of_pose(
            geometry.pose,
            self.first[searched],
            self.second[searched],
            agreeing=geometry.agreeing[searched],
            rng=self.rng,
            threshold_rad=self.threshold_rad,
            fewest=needed,
            sample=sample,
            models_per_sample=models,
        )
        return false_alarms <= MAX_LOG10_FALSE_ALARMS


def _is_other(geometry: _Geometry, known: Sequence[_Geometry], searched: NDArray[np.bool_]) -> bool:
    """Return whether a geometry differs from all known ones, and is not one of them adapted to a few more matches."""
    mostly_own = 2 * (geometry.agreeing & searched).sum() > geometry.agreeing.sum()
    for other in known:
        if not are_distinct(geometry.pose, other.pose):
            return False
        turn = float(geodesic_angle(geometry.pose.rotation, other.pose.rotation))
        between = float(angle_between(geometry.pose.translation, other.pose.translation))
        if turn < float(np.deg2rad(5.0)) and between < float(np.deg2rad(20.0)) and not mostly_own:
            return False
    return True


def _distinct_rotations(known: Sequence[_Geometry]) -> list[FloatArray]:
    kept: list[FloatArray] = []
    for geometry in known:
        if all(geodesic_angle(geometry.pose.rotation, other) > _MIN_TURN_RAD for other in kept):
            kept.append(geometry.pose.rotation)
    return kept


def _peaks(directions: FloatArray, costs: FloatArray) -> list[FloatArray]:
    """Return the directions of lowest cost that are not close to one another."""
    left = directions[np.argsort(costs, kind="stable")]
    kept: list[FloatArray] = []
    while len(left) and len(kept) < _PEAKS:
        kept.append(left[0])
        left = left[left @ left[0] < np.cos(_MIN_DIRECTION_RAD)]
    return kept
