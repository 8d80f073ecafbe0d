"""How significant a relative pose must be if a network has found its matches, by what else speaks for it.

A network matches by the arrangement of key points as well. Its false matches, such as those of equal doors, agree with
one another far more often than shuffled ones, so that their number alone says little. But false poses have marks of
their own. They hardly ever show a floor: below the cameras, the points of false matches do not lie at one height. The
verticals of the two images do not agree, and neither do the heights of the cameras. What looks alike in two places
mostly matches as if it were seen from one place: a rotation alone nearly explains it, and the cameras seem to be close
together compared with their height above the points below them.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from pano_mvs.algorithms.points.floor import floor_below
from pano_mvs.algorithms.two_view.significance import MAX_LOG10_FALSE_ALARMS
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, angle_between, nearest_rotation, ranges_from_bearings
from pano_mvs.scene import Features

_UNIT = 50.0  # log₁₀ of the false alarms is counted in doublings of this
CERTAIN = -250.0
"""Enough whatever the marks: in ten places, no false pair has as few false alarms (10⁻²¹¹); equal offices have some."""
_ALIKE_DEG = 5.0  # what a rotation leaves counts below this
_BELOW = 0.25  # sine of how far below the horizon a match may lie on a floor


class Marks(NamedTuple):
    """What speaks for or against a relative pose beside the number of matches that agree; none is negative.

    Attributes:
        alike: log₂ of how many times closer than 5° the best rotation alone brings the matches; 0 if not closer.
        tilt: angle between the verticals of the two images, in degrees.
        climb: angle of the baseline with the horizon, in degrees.
        floor: share of the matches below the horizon that lie at the height of the floor; 0 without a floor.
        near: log₂ of the height of the cameras above this floor in units of their distance; 0 if it is less.
    """

    alike: float
    tilt: float
    climb: float
    floor: float
    near: float


_MOST_DEG = 4.0
"""Tilt and climb count up to here: verticals may be unknown, and stairs climb."""

WEIGHTS = (0.847, 0.634, -0.718, -0.609, -0.706, 3.504, -1.377)
"""Of `terms_of` in the logarithm of the odds that a pose is right, as `poses.tours.pair_evidence` of the tools fits."""

ACCEPTED_ODDS = float(np.log(5.0))
"""A pose is accepted with five to one, because a wrong one costs as much as five missed ones."""


def terms_of(log10_false_alarms: float, marks: Marks) -> FloatArray:
    """Return what counts for and against a pose: one, log₂ of the exponent of its false alarms, and its marks, (7,)."""
    doublings = np.log2(max(-log10_false_alarms, 1.0) / _UNIT)
    return np.array([1.0, doublings, *np.minimum(marks, _MOST_DEG)], np.float64)


def marks_of(first: Features, second: Features, pose: Rigid3, *, rays: tuple[FloatArray, FloatArray]) -> Marks:
    """Return the marks of a relative pose.

    Args:
        first: key points of the first image, whose `ups` are the candidates for its zenith.
        second: those of the second one.
        pose: second_from_first, |t| = 1.
        rays: (M, 3) unit rays of the matches that agree, in either image.
    """
    p, q = rays
    left_deg = np.rad2deg(np.median(angle_between(p @ nearest_rotation(q.T @ p).T, q)))
    alike = float(np.log2(max(1.0, _ALIKE_DEG / max(float(left_deg), 0.1))))
    ranges, others = ranges_from_bearings(p, q, pose)
    seen = (ranges > 0) & (others > 0)
    points = ranges[seen, None] * p[seen]
    found = []
    for one, other in product(np.array(first.ups), np.array(second.ups) @ pose.rotation):
        up = (one + other) / max(float(np.linalg.norm(one + other)), 1e-12)
        floor = floor_below(points, np.stack([np.zeros(3), pose.center]), up)
        below = min(int((p @ one < -_BELOW).sum()), int((q @ pose.rotation @ other < -_BELOW).sum()))
        marks = Marks(
            alike=alike,
            tilt=float(np.rad2deg(angle_between(one, other))),
            climb=float(np.rad2deg(np.arcsin(min(abs(float(pose.center @ up)), 1.0)))),
            floor=min(1.0, floor.points / below) if floor and below else 0.0,
            near=float(np.log2(max(1.0, floor.depth))),
        )
        found.append(marks)
    # Of the likely zeniths of turned cameras, those that speak most for the pose.
    return max(found, key=lambda marks: float(terms_of(-_UNIT, marks) @ WEIGHTS))


def max_log10_of_learned(marks: Marks, *, weak: bool = False) -> float:
    """Return log₁₀ of the most false alarms with which a pair of learned matches is accepted by itself.

    Args:
        marks: what else speaks for its pose.
        weak: without `CERTAIN`: relative to what do weak pairs count?
    """
    odds = float(terms_of(-_UNIT, marks) @ WEIGHTS)
    demanded = -_UNIT * 2.0 ** ((ACCEPTED_ODDS - odds) / WEIGHTS[1])
    return float(min(demanded if weak else max(demanded, CERTAIN), MAX_LOG10_FALSE_ALARMS))
