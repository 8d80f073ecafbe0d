"""How certain an alignment of two models is: significance against chance, and standard deviations."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.joining.cross_matches import CrossMatches, parts_of
from pano_mvs.algorithms.two_view.significance import log10_false_alarms
from pano_mvs.core.arrays import FloatArray

_SAMPLE, _MODELS = 4, 4  # seven degrees of freedom, two from each match with a known point
_CELL_RAD = 0.025
_WIDER = 1.0, 2.0, 4.0, 8.0, 16.0, 32.0  # radii within which false pairings are counted, in units of the threshold
_ENOUGH_PAIRINGS = 8


def log10_false_alignments(
    similarity: FloatArray, known: CrossMatches, agreeing: NDArray[np.bool_], *, threshold_rad: float
) -> tuple[int, float]:
    """Return the number of independent matches that agree, and log10 of the equally good alignments by chance.

    Args:
        similarity: first_from_second in one vector, (13,).
        known: the matches whose point is known in one of the models.
        agreeing: which of them agree.
        threshold_rad: maximum error of a match that agrees.
    """
    chosen = known[np.flatnonzero(agreeing)]
    witnesses = _independent(chosen)
    if witnesses <= _SAMPLE:
        return witnesses, 1.0
    # Also among the agreeing matches alone: these may be clustered more than all matches, as in a door.
    chance = max(_chance(similarity, some, threshold_rad=threshold_rad) for some in (known, chosen))
    candidates = max(_independent(known), witnesses)
    alarms = log10_false_alarms(witnesses, candidates, chance=chance, sample=_SAMPLE, models_per_sample=_MODELS)
    return witnesses, alarms


def deviations(
    similarity: FloatArray, jacobian: FloatArray, inliers: CrossMatches, *, noise_rad: float
) -> tuple[float, float, float]:
    """Return the standard deviations of rotation and offset in degrees, and of the scale.

    Args:
        similarity: first_from_second in one vector, (13,).
        jacobian: (R, 6 or 7) derivatives of the residuals by turn, shift and logarithm of the scale.
        inliers: the matches that agree; those on one detail count as one.
        noise_rad: standard deviation of their errors.
    """
    if not len(jacobian) or not len(inliers):
        return 180.0, 180.0, np.inf
    noise = noise_rad * float(np.sqrt(len(inliers) / _independent(inliers)))
    hessian = jacobian.T @ jacobian
    size = len(hessian)
    covariance = noise**2 * np.linalg.inv(hessian + 1e-12 * np.trace(hessian) * np.eye(size))
    rotation, shift, scale = parts_of(similarity)
    offsets = scale * inliers.centers[:, 1] @ rotation.T + shift - inliers.centers[:, 0]
    nearest = max(float(np.linalg.norm(offsets, axis=1).min()), 1e-9)
    turn_deg = float(np.rad2deg(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0))))
    offset_deg = float(np.rad2deg(np.sqrt(max(np.linalg.eigvalsh(covariance[3:6, 3:6])[-1], 0)) / nearest))
    return turn_deg, offset_deg, float(np.sqrt(max(covariance[6, 6], 0))) if size == 7 else 0.0


def _independent(matches: CrossMatches) -> int:
    """Return the number of matches on different details: at most one from each small cell of either image."""
    counts = []
    for side in (0, 1):
        cells = np.floor(matches.rays[:, side] / _CELL_RAD).astype(np.int64)
        counts.append(len(np.unique(cells, axis=0)))
    return min(counts)


def _chance(similarity: FloatArray, matches: CrossMatches, *, threshold_rad: float) -> float:
    """Return the probability that a false match with a known point agrees, measured on false pairings.

    Key points are clustered, as in a door. Few pairings are as close as the threshold, so the smallest radius that
    contains enough of them is used, and scaled by the area.
    """
    rotation, shift, scale = parts_of(similarity)
    forward, rays, centers = matches.points[:, 0], matches.rays[:, 1], matches.centers[:, 1]
    in_second = (forward - shift) @ rotation / scale
    use = np.isfinite(in_second[:, 0])
    if use.sum() < use.size / 2:
        forward, rays, centers = matches.points[:, 1], matches.rays[:, 0], matches.centers[:, 0]
        in_second = scale * forward @ rotation.T + shift
        use = np.isfinite(in_second[:, 0])
    rays = rays[use]
    cosine = _unit(in_second[use] - centers[use]) @ rays.T
    apart = rays @ rays.T < np.cos(_CELL_RAD)
    total = max(int(apart.sum()), 1)
    everywhere = 0.25 * threshold_rad**2
    for widen in _WIDER:
        near = int(((cosine > np.cos(widen * threshold_rad)) & apart).sum())
        if near >= _ENOUGH_PAIRINGS:
            return float(min(max(near / total / widen**2, everywhere), 1.0))
    return float(everywhere)


def _unit(vectors: FloatArray) -> FloatArray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12), np.float64)
