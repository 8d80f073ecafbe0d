"""How surprising it would be to find so many agreeing matches by chance (a-contrario model selection)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from pano_mvs.geometry import Rigid3

FloatArray = NDArray[np.float64]

MAX_LOG10_FALSE_ALARMS = -6.0


def log10_false_alarms(
    inliers: int, candidates: int, *, chance: float, sample: int, models_per_sample: int = 1
) -> float:
    """Return log₁₀ of the expected number of equally good models among random matches.

    NFA = models · (n − s) · C(n, k) · C(k, s) · p^(k − s) (Moisan & Stival 2004; Moulon et al. 2012): below 0 the
    model is more than chance, and by how much.

    Args:
        inliers: k, independent matches that agree.
        candidates: n, independent matches at all.
        chance: p, the probability that a random match agrees with a given model.
        sample: s, matches that determine the model.
        models_per_sample: how many models one sample may give.
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
    """Return the probability that a wrong match agrees with a relative pose, measured on shuffled matches.

    Key points crowd (near the horizon, say), and so do epipolar circles; the share of shuffled matches that agree
    takes both into account where a formula for even spread would not.

    Args:
        pose: second_from_first, |t| = 1.
        first: (M, 3) bearings of the matches in the first image.
        second: (M, 3) in the second.
        rng: draws the pairs.
        threshold_rad: Sampson error below which a match agrees, if it lies in front of both cameras.
        draws: how many pairs.
    """
    from pano_mvs.algorithms.two_view.kernels_agreement import count_chance

    pairs = rng.integers(len(first), size=(draws, 2))
    p, q = np.ascontiguousarray(first), np.ascontiguousarray(second)
    rotation, translation = np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.translation)
    agreeing, drawn = count_chance(rotation, translation, p, q, pairs, threshold_rad)
    return float((agreeing + 1) / (drawn + 1))


def independent_count(first: FloatArray, second: FloatArray, *, cell_rad: float = 0.025) -> int:
    """Return how many matches count as independent: at most one from each small cell of either image.

    A crowd of key points on one detail stands or falls together and must not be counted as many witnesses.

    Args:
        first: (M, 3) unit bearings.
        second: (M, 3) unit bearings.
        cell_rad: width of a cell.
    """
    return min(_cells(bearings, cell_rad) for bearings in (first, second))


def _cells(bearings: FloatArray, cell_rad: float) -> int:
    """Return in how many cells bearings lie; one number names a cell, since rows of three are slow to sort."""
    cells = np.floor(bearings / cell_rad).astype(np.int64)
    side = 2 * int(np.ceil(1 / cell_rad)) + 3
    return len(np.unique(cells @ np.array([side * side, side, 1])))


def _log_binomial(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))
