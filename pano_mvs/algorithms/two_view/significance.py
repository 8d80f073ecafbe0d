"""A-contrario model selection: the probability of finding as many inliers by chance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3

MAX_LOG10_FALSE_ALARMS = -6.0
CELL_RAD = 0.025
"""Matches in one cell of an image are right or wrong together."""


def log10_false_alarms(
    inliers: int, candidates: int, *, chance: float, sample: int, models_per_sample: int = 1
) -> float:
    """Return log₁₀ of the expected number of equally good models among random matches (NFA).

    NFA = models · (n − s) · C(n, k) · C(k, s) · p^(k − s) (Moisan & Stival 2004; Moulon et al. 2012). Values below 0
    are more than chance; the lower, the more significant.

    Args:
        inliers: k, number of independent inliers.
        candidates: n, number of independent matches.
        chance: p, the probability that a random match agrees with a given model.
        sample: s, number of matches that determine the model.
        models_per_sample: maximum number of models from one sample.
    """
    if inliers <= sample or candidates <= sample:
        return float(np.log10(max(candidates, 1)))
    trials = np.log(models_per_sample * (candidates - sample)) + _log_binomial(candidates, inliers)
    trials += _log_binomial(inliers, sample)
    return float((trials + (inliers - sample) * np.log(max(chance, 1e-12))) / np.log(10))


def chance_of_pose(
    pose: Rigid3,
    first: FloatArray,
    second: FloatArray,
    *,
    rng: np.random.Generator,
    threshold_rad: float,
    draws: int = 20_000,
) -> float:
    """Return the probability that a false match agrees with a relative pose, measured on shuffled matches.

    Key points are clustered (for example near the horizon), and so are epipolar circles; the share of shuffled matches
    that agree accounts for both, unlike a formula for uniform distributions.

    Args:
        pose: second_from_first, |t| = 1.
        first: (M, 3) bearings of the matches in the first image.
        second: (M, 3) in the second.
        rng: draws the pairs.
        threshold_rad: maximum Sampson error of an inlier, which must also be in front of both cameras.
        draws: number of pairs.
    """
    from pano_mvs.algorithms.two_view.kernels_agreement import count_chance

    pairs = rng.integers(len(first), size=(draws, 2))
    p, q = np.ascontiguousarray(first), np.ascontiguousarray(second)
    rotation, translation = np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.translation)
    agreeing, drawn = count_chance(rotation, translation, p, q, pairs, threshold_rad)
    return float((agreeing + 1) / (drawn + 1))


def significance_of_pose(
    pose: Rigid3,
    first: FloatArray,
    second: FloatArray,
    *,
    agreeing: NDArray[np.bool_],
    rng: np.random.Generator,
    threshold_rad: float,
    fewest: float,
    sample: int,
    models_per_sample: int,
) -> tuple[int, float]:
    """Return the number of independent matches that agree with a relative pose, and log₁₀ of its false alarms.

    Args:
        pose: second_from_first, |t| = 1.
        first: (M, 3) unit bearings of the matches in the first image.
        second: (M, 3) in the second.
        agreeing: (M,) which of them agree.
        rng: draws false matches.
        threshold_rad: maximum Sampson error of a match that agrees.
        fewest: with fewer independent matches, the false alarms are infinite.
        sample: number of matches that determine such a pose.
        models_per_sample: maximum number of poses from one sample.
    """
    own = first[agreeing], second[agreeing]
    witnesses = independent_count(*own) if agreeing.any() else 0
    if witnesses < fewest:
        return witnesses, np.inf
    # Also among the agreeing ones alone: if they are clustered along one epipolar circle, any match would agree.
    chance = max(chance_of_pose(pose, *rays, rng=rng, threshold_rad=threshold_rad) for rays in ((first, second), own))
    candidates = max(independent_count(first, second), witnesses)
    return witnesses, log10_false_alarms(
        witnesses, candidates, chance=chance, sample=sample, models_per_sample=models_per_sample
    )


def independent_count(first: FloatArray, second: FloatArray) -> int:
    """Return the number of independent matches: at most one from each cell of either image.

    The matches of a cluster of key points on one detail are right or wrong together, so they count as one.

    Args:
        first: (M, 3) unit bearings.
        second: (M, 3) unit bearings.
    """
    # One number per cell, since rows of three are slow to sort.
    side = 2 * int(np.ceil(1 / CELL_RAD)) + 3
    cells = (np.floor(bearings / CELL_RAD).astype(np.int64) @ [side * side, side, 1] for bearings in (first, second))
    return min(len(np.unique(numbers)) for numbers in cells)


def _log_binomial(n: int, k: int) -> float:
    from scipy.special import gammaln  # slow to import

    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))
