"""The similarity that joins two models of the same capture, from matches between their images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.joining.cross_matches import THRESHOLD_RAD, CrossMatches
from pano_mvs.algorithms.poses.joining.floors import KnownLengths
from pano_mvs.algorithms.poses.placement.view_graph import Edge
from pano_mvs.algorithms.two_view.significance import CELL_RAD, independent_count, log10_false_alarms
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Rigid3, Similarity3, rotation_from_rotvec

_LENGTHS = np.geomspace(0.1, 30.0, 80)


@dataclass(frozen=True, eq=False)
class PairHypothesis:
    """A relative pose of two images, one of each model, in the axes of the worlds."""

    second_from_first: Rigid3  # |t| = 1
    # of the translation, in the unit of either model; NaN if the ranges of its matches do not determine it
    lengths: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Alignment:
    """A similarity of two models, and its evidence."""

    first_from_second: Similarity3  # moves the second model into the world of the first one
    inliers: NDArray[np.bool_]  # (M,) the matches that agree
    log10_false_alarms: float  # expected number of equally good alignments among random matches
    rotation_std_deg: float  # standard deviation of the rotation about its least certain axis
    # that of the cameras of the second model, as an angle at the nearest camera of the first one
    offset_std_deg: float
    scale_std: float  # that of the scale, relative; 0 if the second model has one camera, or it was known


def align_models(
    matches: CrossMatches,
    *,
    has_scale: bool,
    hypotheses: Mapping[Edge, Sequence[PairHypothesis]],
    starts: Sequence[Similarity3] = (),
    known: KnownLengths,
) -> list[Alignment]:
    """Return the similarities of two models on which most of their matches agree, best first.

    Each relative pose of an image of either model suggests a similarity. Its lengths are those of its matches, or those
    with which most matches agree. The best are refined on all matches together: those with a known point by the angles
    between rays and point, the others by their epipolar error.

    Args:
        matches: between the images of the two models.
        has_scale: whether the second model has a scale of its own, i.e. more than one camera.
        hypotheses: relative poses of pairs of images.
        starts: further similarities first_from_second to be refined, with the scale that is known if there is one.
        known: what is known of the lengths from elsewhere.
    """
    if not matches.known.any() and not len(known.lengths):
        return []
    proposals: list[Similarity3] = []
    for cameras, some in hypotheses.items():
        pair = np.flatnonzero((matches.cameras == cameras).all(axis=1))
        if len(pair):
            centers = matches.centers[pair[0]]
            proposals += [_with_lengths(one, centers, matches, scale=known.scale) for one in some]
    if has_scale and known.scale is not None:
        starts = [_with_scale(start, matches, scale=known.scale) for start in starts]
    finalists = [
        _refined(start, matches, known, has_scale=has_scale and known.scale is None)
        for start in [*starts, *sorted(proposals, key=matches.cost)[:10]]
    ]
    finalists.sort(key=lambda finalist: matches.cost(finalist[0]))
    return [_measured(*finalist, matches) for finalist in finalists]


def _with_scale(start: Similarity3, matches: CrossMatches, *, scale: float) -> Similarity3:
    """Return a similarity with another scale that leaves the middle of the cameras of the second model in place."""
    middle = matches.centers[:, 1].mean(axis=0)
    return Similarity3(scale, start.rotation, start.apply(middle[None])[0] - scale * start.rotation @ middle)


def _with_lengths(
    hypothesis: PairHypothesis,
    centers: FloatArray,
    matches: CrossMatches,
    *,
    scale: float | None,
) -> Similarity3:
    """Return the similarity with the relative pose of two cameras and, if its lengths are unknown, the best ones.

    Matches with a point known in the first model depend on the distance in the unit of the first model alone, and
    likewise in the second.
    """
    rotation, direction = hypothesis.second_from_first.rotation.T, hypothesis.second_from_first.center
    lengths = np.array(hypothesis.lengths)
    costs = [
        _costs_of_lengths(side, hypothesis.second_from_first, matches, centers=centers)
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
    return Similarity3(float(ratio), rotation, place - ratio * rotation @ centers[1])


def _costs_of_lengths(
    side: int, second_from_first: Rigid3, matches: CrossMatches, *, centers: FloatArray
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
    return np.asarray(np.minimum(2 * (1 - cosine) / (2 * THRESHOLD_RAD) ** 2, 1.0).sum(axis=1))


def _refined(
    similarity: Similarity3, matches: CrossMatches, known: KnownLengths, *, has_scale: bool
) -> tuple[Similarity3, FloatArray]:
    """Return the similarity refined on the matches near it, and the derivatives of its residuals."""
    jacobian = np.zeros((0, 7))
    for widen in (3.0, 1.5):
        near = matches.errors(similarity)[0] < widen * THRESHOLD_RAD
        if near.sum() < 8:
            break
        similarity, jacobian = _least_squares(
            similarity, matches[np.flatnonzero(near)], known, size=7 if has_scale else 6
        )
    return similarity, jacobian


def _least_squares(
    start: Similarity3, matches: CrossMatches, known: KnownLengths, *, size: int
) -> tuple[Similarity3, FloatArray]:
    """Minimise the Cauchy loss of all residuals over turn, shift and, if `size` is 7, scale."""
    from scipy.optimize import least_squares  # slow to import

    middle, scale_rad = matches.centers[:, 1].mean(axis=0), 0.5 * THRESHOLD_RAD

    def residuals(step: FloatArray) -> FloatArray:
        similarity = _stepped(start, step, middle)
        own = matches.errors(similarity)[1].ravel()
        return np.concatenate([own, scale_rad * known.deviations(similarity)]) if len(known.lengths) else own

    solved = least_squares(residuals, np.zeros(size), loss="cauchy", f_scale=scale_rad, max_nfev=12)
    return _stepped(start, solved.x, middle), np.asarray(solved.jac)


def _stepped(similarity: Similarity3, step: FloatArray, middle: FloatArray) -> Similarity3:
    """Return a similarity turned, shifted and scaled a little about a point of the second model."""
    place = similarity.scale * similarity.rotation @ middle + similarity.translation
    turned = rotation_from_rotvec(step[:3]) @ similarity.rotation
    scaled = similarity.scale * float(np.exp(np.clip(step[6], -1, 1))) if len(step) == 7 else similarity.scale
    return Similarity3(scaled, turned, place + step[3:6] - scaled * turned @ middle)


def _measured(similarity: Similarity3, jacobian: FloatArray, matches: CrossMatches) -> Alignment:
    """Return a similarity with how certain it is.

    Args:
        similarity: first_from_second.
        jacobian: (R, 6 or 7) derivatives of the residuals by turn, shift and logarithm of the scale.
        matches: between the images of the two models.
    """
    errors = matches.errors(similarity)[0]
    inliers = errors < THRESHOLD_RAD
    alarms = _log10_false_alarms(similarity, matches[np.flatnonzero(matches.known)], inliers[matches.known])
    stds = 180.0, 180.0, np.inf
    agreeing = matches[np.flatnonzero(inliers)]
    if len(jacobian) and len(agreeing):
        noise_rad = max(float(np.sqrt(np.mean(errors[inliers] ** 2))), 0.2 * THRESHOLD_RAD)
        # Matches on one detail count as one.
        noise_rad *= float(np.sqrt(len(agreeing) / independent_count(*agreeing.rays.swapaxes(0, 1))))
        hessian = jacobian.T @ jacobian
        covariance = noise_rad**2 * np.linalg.inv(hessian + 1e-12 * np.trace(hessian) * np.eye(len(hessian)))
        offsets = similarity.apply(agreeing.centers[:, 1]) - agreeing.centers[:, 0]
        nearest = max(float(np.linalg.norm(offsets, axis=1).min()), 1e-9)
        turn, offset = (
            float(np.sqrt(max(np.linalg.eigvalsh(covariance[part, part])[-1], 0)))
            for part in (slice(0, 3), slice(3, 6))
        )
        scale_std = float(np.sqrt(max(covariance[6, 6], 0))) if len(hessian) == 7 else 0.0
        stds = float(np.rad2deg(turn)), float(np.rad2deg(offset / nearest)), scale_std
    return Alignment(similarity, inliers, alarms, *stds)


def _log10_false_alarms(similarity: Similarity3, known: CrossMatches, agreeing: NDArray[np.bool_]) -> float:
    """Return log10 of the number of equally good alignments by chance.

    Args:
        similarity: first_from_second.
        known: the matches whose point is known in one of the models.
        agreeing: which of them agree.
    """
    sample = 4  # seven degrees of freedom, two from each match with a known point
    chosen = known[np.flatnonzero(agreeing)]
    witnesses = independent_count(*chosen.rays.swapaxes(0, 1))
    if witnesses <= sample:
        return 1.0
    # Also among the agreeing matches alone: these may be clustered more than all matches, as in a door.
    chance = max(_chance(similarity, some) for some in (known, chosen))
    candidates = max(independent_count(*known.rays.swapaxes(0, 1)), witnesses)
    return log10_false_alarms(witnesses, candidates, chance=chance, sample=sample, models_per_sample=4)


def _chance(similarity: Similarity3, matches: CrossMatches) -> float:
    """Return the probability that a false match with a known point agrees, measured on false pairings.

    Key points are clustered, as in a door. Few pairings are as close as the threshold, so the smallest radius that
    contains enough of them is used, and scaled by the area.
    """
    forward, rays, centers = matches.points[:, 0], matches.rays[:, 1], matches.centers[:, 1]
    in_second = (forward - similarity.translation) @ similarity.rotation / similarity.scale
    use = np.isfinite(in_second[:, 0])
    if use.sum() < use.size / 2:
        rays, centers = matches.rays[:, 0], matches.centers[:, 0]
        in_second = similarity.apply(matches.points[:, 1])
        use = np.isfinite(in_second[:, 0])
    rays, towards = rays[use], in_second[use] - centers[use]
    cosine = towards / np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), 1e-12) @ rays.T
    apart = rays @ rays.T < np.cos(CELL_RAD)
    total = max(int(apart.sum()), 1)
    everywhere = 0.25 * THRESHOLD_RAD**2
    for widen in (1.0, 2.0, 4.0, 8.0, 16.0, 32.0):
        near = int(((cosine > np.cos(widen * THRESHOLD_RAD)) & apart).sum())
        if near >= 8:
            return float(min(max(near / total / widen**2, everywhere), 1.0))
    return float(everywhere)
