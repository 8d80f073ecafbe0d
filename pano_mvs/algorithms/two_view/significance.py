"""How surprising it would be to find so many agreeing matches by chance (a-contrario model selection)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from pano_mvs.algorithms.two_view.essential import in_front, sampson_angles
from pano_mvs.geometry import Rigid3, skew

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


def chance_of_agreement(
    agrees: Callable[[FloatArray, FloatArray], NDArray[np.bool_]],
    first: FloatArray,
    second: FloatArray,
    *,
    rng: np.random.Generator,
    draws: int = 20_000,
) -> float:
    """Return the probability that a wrong match agrees with a model, measured on shuffled matches.

    Key points crowd (near the horizon, say), and so do epipolar circles; the share of shuffled matches that agree
    takes both into account where a formula for even spread would not.

    Args:
        agrees: tells which of paired rays, (N, 3) and (N, 3), agree with the model.
        first: (M, 3) bearings of the matches in the first image.
        second: (M, 3) in the second.
        rng: draws the pairs.
        draws: how many.
    """
    pairs = rng.integers(len(first), size=(draws, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    agreeing = int(agrees(first[pairs[:, 0]], second[pairs[:, 1]]).sum())
    return (agreeing + 1) / (len(pairs) + 1)


def chance_of_pose(
    pose: Rigid3, first: FloatArray, second: FloatArray, *, rng: np.random.Generator, threshold_rad: float
) -> float:
    """Return the probability that a wrong match agrees with a relative pose (see `chance_of_agreement`)."""
    essential = skew(pose.translation) @ pose.rotation

    def agrees(first: FloatArray, second: FloatArray) -> NDArray[np.bool_]:
        near = sampson_angles(essential, first, second) < threshold_rad
        near[near] = in_front(first[near], second[near], pose)
        return near

    return chance_of_agreement(agrees, first, second, rng=rng)


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
