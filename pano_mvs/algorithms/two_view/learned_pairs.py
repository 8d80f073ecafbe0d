"""The odds that the relative pose of a pair is right if a network has found its matches.

A network matches by the arrangement of key points as well. Its false matches, such as those of equal doors, agree with
one another far more often than shuffled ones, so that their number alone says little. But false poses have marks of
their own. They hardly ever show a floor: below the cameras, the points of false matches do not lie at one height. The
verticals of the two images do not agree. What looks alike in two places mostly matches as if it were seen from one
place: with little parallax, so that the direction is hardly determined, and with cameras that seem to be close together
compared with their height above the points below them. Walls say most: in a house they have two directions, which a
true pose keeps to some tenths of a degree, and tripods stand at one height. A false pose mostly has neither.
"""

from __future__ import annotations

from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np

from pano_mvs.algorithms.points.floor import floor_below
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, angle_between, geodesic_angle, ranges_from_bearings, rotation_from_rotvec
from pano_mvs.scene import Features, TwoView

CERTAIN = -250.0
"""Enough whatever the marks: in ten places, no false pair has as few false alarms (10⁻²³³); equal offices have some."""
_SETTLED, _SETTLED_ODDS, _HOPELESS = -100.0, 5.0, -5.0
"""What three pairs of views of 60 pairs of ZInD's sample tour settle. Of 12 that they verify with at most the first
number, all views move no geometry by a degree; of 8 others, one by 7°. Of 31 that they do not verify and that have more
than the third, all views verify none; of 9 others, one. A copy of a room had odds of 3.3 by three pairs of views, and
less than one to one by all of them: with walls, odds below the second settle nothing."""
_BELOW = 0.25  # sine of how far below the horizon a match may lie on a floor


class Marks(NamedTuple):
    """What speaks for or against a relative pose beside the number of matches that agree.

    Attributes:
        tilt: angle between the verticals of the two images, in degrees.
        floor: share of the matches below the horizon that lie at the height of the floor; 0 without a floor.
        near: whether the cameras are closer together than their height above this floor: log₂ of how much, 0 to 1.
        parallax: log₂ of the median angle between the rays of the matches, in degrees.
        open: log₂ of the standard deviation of the direction of the baseline, in degrees.
        walls: log₂ of the angle by which the pose turns the walls of one image against those of the other, in degrees,
            from 0.25 to 16; NaN unless both show walls.
        level: log₂ of how far the baseline is from level, in degrees, from 0.5 to 16; NaN unless both show walls.
    """

    tilt: float
    floor: float
    near: float
    parallax: float
    open: float
    walls: float = np.nan
    level: float = np.nan


WEIGHTS = (-6.346, 1.724, -1.120, 3.005, -1.796, 0.677, -1.025)
"""Of `terms_of` in the logarithm of the odds that a pose is right, as `poses.tours.pair_evidence` of the tools fits."""

WEIGHTS_WITH_WALLS = (-7.983, 2.211, 0.0, 1.278, -4.314, 1.311, -0.898, -1.689, -0.393)
"""The same of pairs of which both images show walls, fitted to 201 pairs of eight rendered houses and a real one."""

ACCEPTED_ODDS = float(np.log(5.0))
"""A pose is accepted with five to one, because a wrong one costs as much as five missed ones."""

ACCEPTED_ODDS_WITH_WALLS = float(np.log(12.0))
"""With twelve to one if both images show walls: of nine places, each judged by the others, this accepts 130 right pairs
and one wrong one; five to one accepts 134 and four."""

PARALLEL = 2.0
"""Largest mark `walls` of a pose that they do not contradict: 4°. True poses of a real house have up to 3.2°."""

WEAKEST, PRIOR_ODDS = -3.0, -0.3
"""log₁₀ of the false alarms of the weakest pairs that count, and the logarithm of the odds of any such pair."""


def is_settled(view: TwoView, marks: Marks | None) -> bool:
    """Return whether further matches hardly change a pair: its geometry is clear, or there is no sign of one.

    Views that are most alike may show what is far away, so that two places seem to be one: this is left open.

    Args:
        view: the geometry of the pair by a part of its matches.
        marks: of this geometry; None without one.
    """
    if view.geometry == "rotation":
        return False
    if not view or marks is None:
        return view.log10_false_alarms > _HOPELESS
    is_clear = np.isnan(marks.walls) or log_odds_of(view.log10_false_alarms, marks) >= _SETTLED_ODDS
    return view.log10_false_alarms <= _SETTLED and bool(is_clear)


def terms_of(log10_false_alarms: float, marks: Marks) -> FloatArray:
    """Return what counts for and against a pose: one, the exponent of its false alarms, and its known marks, (K,)."""
    known = [mark for mark in marks if not np.isnan(mark)]
    return np.array([1.0, min(-log10_false_alarms, 400.0) / 100.0, *known], np.float64)


def log_odds_of(log10_false_alarms: float, marks: Marks) -> float:
    """Return the natural logarithm of the odds that the pose of a learned pair is right."""
    weights = WEIGHTS if np.isnan(marks.walls) else WEIGHTS_WITH_WALLS
    return float(terms_of(log10_false_alarms, marks) @ weights)


def is_accepted(log10_false_alarms: float, marks: Marks, *, further: float = 0.0) -> bool:
    """Return whether a pose is so probable that it is accepted.

    Walls of real houses are at right angles to some degrees only. A pose that is as probable without them is refused
    only if they contradict it.

    Args:
        log10_false_alarms: of the pose.
        marks: what else speaks for it.
        further: what is known beside these, as a logarithm of odds.
    """
    if np.isnan(marks.walls):
        return log_odds_of(log10_false_alarms, marks) + further >= ACCEPTED_ODDS
    least = ACCEPTED_ODDS_WITH_WALLS - further
    without_walls = marks._replace(walls=np.nan, level=np.nan)
    is_probable = log_odds_of(log10_false_alarms, without_walls) >= least and marks.walls <= PARALLEL
    return is_probable or log_odds_of(log10_false_alarms, marks) >= least


def marks_of(
    first: Features,
    second: Features,
    pose: Rigid3,
    *,
    rays: tuple[FloatArray, FloatArray],
    direction_std_deg: float,
) -> Marks:
    """Return the marks of a relative pose.

    Args:
        first: key points of the first image, whose `ups` are the candidates for its zenith.
        second: those of the second one.
        pose: second_from_first, |t| = 1.
        rays: (M, 3) unit rays of the matches that agree, in either image.
        direction_std_deg: standard deviation of the direction of the baseline.
    """
    p, q = rays
    parallax_deg = float(np.rad2deg(np.median(angle_between(p @ pose.rotation.T, q))))
    ranges, others = ranges_from_bearings(p, q, pose)
    seen = (ranges > 0) & (others > 0)
    points = ranges[seen, None] * p[seen]
    walls, level = _marks_of_walls(first, second, pose)
    found = []
    for one, other in product(np.array(first.ups), np.array(second.ups) @ pose.rotation):
        up = (one + other) / max(float(np.linalg.norm(one + other)), 1e-12)
        floor = floor_below(points, np.stack([np.zeros(3), pose.center]), up)
        below = min(int((p @ one < -_BELOW).sum()), int((q @ pose.rotation @ other < -_BELOW).sum()))
        marks = Marks(
            tilt=min(float(np.rad2deg(angle_between(one, other))), 4.0),  # verticals may be unknown
            floor=min(1.0, floor.points / below) if floor and below else 0.0,
            near=float(np.log2(np.clip(floor.depth, 1.0, 2.0))),
            parallax=float(np.log2(max(parallax_deg, 0.5))),
            open=float(np.log2(max(direction_std_deg, 0.05))),
            walls=walls,
            level=level,
        )
        found.append(marks)
    # Of the likely zeniths of turned cameras, those that speak most for the pose.
    return max(found, key=lambda marks: log_odds_of(0.0, marks))


def _marks_of_walls(first: Features, second: Features, pose: Rigid3) -> tuple[float, float]:
    """Return the marks `walls` and `level` of a relative pose; NaN unless both images show walls."""
    if first.walls_from_cam is None or second.walls_from_cam is None:
        return np.nan, np.nan
    between = second.walls_from_cam @ pose.rotation @ first.walls_from_cam.T
    nearest = parallel_walls()[int(np.argmax(np.einsum("kij,ij->k", parallel_walls(), between)))]
    off_deg = np.rad2deg(geodesic_angle(between, nearest))
    heights = (first.walls_from_cam @ pose.center)[1], (second.walls_from_cam @ pose.translation)[1]
    tilt_deg = np.rad2deg(np.arcsin(np.clip(np.abs(heights), 0, 1)).mean())
    return float(np.log2(np.clip(off_deg, 0.25, 16.0))), float(np.log2(np.clip(tilt_deg, 0.5, 16.0)))


@cache
def parallel_walls() -> FloatArray:
    """Return the rotations (8, 3, 3) that keep walls at right angles: four turns, then those of an inverted camera."""
    turns = rotation_from_rotvec(np.outer(np.arange(4) * np.pi / 2, [0.0, 1.0, 0.0]))
    return np.concatenate([turns, turns @ np.diag([1.0, -1.0, -1.0])])


def weight_of_learned(log10_false_alarms: float, marks: Marks) -> float:
    """Return how much a pose says beside others: its likelihood ratio relative to that with which a pair is accepted.

    It is the logarithm of the odds beyond those of any pair; 0 if they are less, and 1 if the pair is just accepted by
    itself. Walls only lower it: what weights say of cameras was fitted without them, and a copy of a room has walls in
    the same directions.
    """
    without_walls = marks._replace(walls=np.nan, level=np.nan)
    log_odds = min(log_odds_of(log10_false_alarms, one) for one in (marks, without_walls))
    return max((log_odds - PRIOR_ODDS) / (ACCEPTED_ODDS - PRIOR_ODDS), float(log10_false_alarms <= CERTAIN), 0.0)
