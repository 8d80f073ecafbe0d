"""Similarities of two models that are worth refining, from relative poses of pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from pano_mvs.algorithms.poses.joining.cross_matches import CrossMatches, alignment_cost
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3

_LENGTHS = np.geomspace(0.1, 30.0, 80)


@dataclass(frozen=True, eq=False)
class PairHypothesis:
    """A relative pose of two images, one of each model, in the axes of the worlds.

    Attributes:
        second_from_first: |t| = 1.
        lengths: of the translation, in the unit of either model; NaN if the ranges of its matches do not determine it.
    """

    second_from_first: Rigid3
    lengths: tuple[float, float]


def pair_proposals(
    matches: CrossMatches,
    hypotheses: Mapping[tuple[int, int], Sequence[PairHypothesis]],
    *,
    threshold_rad: float,
    scale: float | None = None,
) -> list[FloatArray]:
    """Return similarities from relative poses of two images, one of each model, with the given scale if it is known.

    Returns:
        Rotation, translation and scale of first_from_second in one vector each, (13,).
    """
    found: list[FloatArray] = []
    for cameras, some in hypotheses.items():
        pair = np.flatnonzero((matches.cameras == cameras).all(axis=1))
        if len(pair):
            centers = matches.centers[pair[0]]
            found += [_with_lengths(one, centers, matches, threshold_rad=threshold_rad, scale=scale) for one in some]
    return found


def least_costly(
    similarities: list[FloatArray], matches: CrossMatches, *, threshold_rad: float, count: int
) -> list[FloatArray]:
    """Return the similarities with the lowest costs, best first."""
    costs = [alignment_cost(one, matches, threshold_rad=threshold_rad) for one in similarities]
    return [similarities[idx] for idx in np.argsort(costs, kind="stable")[:count]]


def _with_lengths(
    hypothesis: PairHypothesis,
    centers: FloatArray,
    matches: CrossMatches,
    *,
    threshold_rad: float,
    scale: float | None,
) -> FloatArray:
    """Return the similarity with the relative pose of two cameras and, if its lengths are unknown, the best ones.

    Matches with a point known in the first model depend on the distance in the unit of the first model alone, and
    likewise in the second.
    """
    rotation, direction = hypothesis.second_from_first.rotation.T, hypothesis.second_from_first.center
    lengths = np.array(hypothesis.lengths)
    costs = [
        _costs_of_lengths(side, hypothesis.second_from_first, matches, centers=centers, threshold_rad=threshold_rad)
        if np.isnan(lengths[side])
        else None
        for side in (0, 1)
    ]
    for side, each in enumerate(costs):
        if each is not None:
            lengths[side] = _LENGTHS[int(np.argmin(each))] if np.ptp(each) > 0 else 1.0
    if scale is not None:
        # The side whose matches determine its length better.
        gains = [np.inf if each is None else float(np.ptp(each)) for each in costs]
        if gains[0] >= gains[1]:
            lengths[1] = lengths[0] / scale
        else:
            lengths[0] = lengths[1] * scale
    ratio = lengths[0] / lengths[1]
    place = centers[0] + lengths[0] * direction
    return np.concatenate([rotation.ravel(), place - ratio * rotation @ centers[1], [ratio]])


def _costs_of_lengths(
    side: int, second_from_first: Rigid3, matches: CrossMatches, *, centers: FloatArray, threshold_rad: float
) -> FloatArray:
    """Return the costs of the matches whose point is known in one model, for each of `_LENGTHS` in its unit."""
    rotation, direction = second_from_first.rotation.T, second_from_first.center
    # Only matches of the one camera: the rest of its model is at distances that depend on both lengths.
    of_camera = np.abs(matches.centers[:, 1 - side] - centers[1 - side]).max(axis=1) < 1e-9
    known = matches[np.flatnonzero(of_camera & np.isfinite(matches.ranges[:, side]))]
    turn = rotation if side == 0 else rotation.T
    towards = direction if side == 0 else -rotation.T @ direction
    seen = known.points[None, :, side] - (centers[side] + _LENGTHS[:, None, None] * towards)
    cosine = np.sum((seen @ turn) * known.rays[:, 1 - side], axis=2) / np.linalg.norm(seen, axis=2)
    return np.asarray(np.minimum(2 * (1 - cosine) / (2 * threshold_rad) ** 2, 1.0).sum(axis=1))
