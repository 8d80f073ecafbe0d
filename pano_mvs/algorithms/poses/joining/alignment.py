"""The similarity that joins two models of the same capture, from matches between their images."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.joining.cross_matches import CrossMatches, alignment_cost, errors_and_residuals, parts_of
from pano_mvs.algorithms.poses.joining.evidence import deviations, log10_false_alignments
from pano_mvs.algorithms.poses.joining.floors import LENGTH_STD
from pano_mvs.algorithms.poses.joining.proposals import PairHypothesis, least_costly, pair_proposals
from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Similarity3, rotation_from_rotvec

_FINALISTS = 10
_MAX_EVALUATIONS = 12
_MIN_REFINED = 8


@dataclass(frozen=True, eq=False)
class KnownLengths:
    """What is known of lengths between two models without matches.

    Attributes:
        scale: of first_from_second; None if unknown.
        centers: (K, 2, 3) camera centres of pairs with a known length, each in its own model.
        lengths: (K,) distances between them in the unit of the first model.
    """

    scale: float | None = None
    centers: FloatArray = field(default_factory=lambda: np.zeros((0, 2, 3)))
    lengths: FloatArray = field(default_factory=lambda: np.zeros(0))

    @classmethod
    def between(
        cls,
        first: PlacedModel,
        second: PlacedModel,
        lengths: Mapping[tuple[int, int], float],
        *,
        scale: float | None,
    ) -> KnownLengths:
        """Return the lengths of pairs of an image of either model."""
        centers = [[first.cameras[i].center, second.cameras[j].center] for i, j in lengths]
        return cls(scale, np.array(centers).reshape(-1, 2, 3), np.array(list(lengths.values())))

    def deviations(self, similarity: FloatArray) -> FloatArray:
        """Return how far the lengths of an alignment are from the known ones, (K,), in standard deviations."""
        rotation, shift, scale = parts_of(similarity)
        placed = scale * self.centers[:, 1] @ rotation.T + shift
        found = np.linalg.norm(placed - self.centers[:, 0], axis=1)
        return np.asarray(np.log(np.maximum(found, 1e-12) / self.lengths) / LENGTH_STD)


@dataclass(frozen=True, eq=False)
class Alignment:
    """A similarity of two models, and its evidence.

    Attributes:
        first_from_second: moves the second model into the world of the first one.
        inliers: (M,) bool, the matches that agree.
        witnesses: number of independent inliers whose point is known.
        log10_false_alarms: expected number of equally good alignments among random matches.
        rotation_std_deg: standard deviation of the rotation about its least certain axis.
        offset_std_deg: that of the cameras of the second model, as an angle at the nearest camera of the first one.
        scale_std: relative standard deviation of the scale; 0 if the second model has one camera, or it was known.
        threshold_rad: maximum error of an inlier.
    """

    first_from_second: Similarity3
    inliers: NDArray[np.bool_]
    witnesses: int
    log10_false_alarms: float
    rotation_std_deg: float
    offset_std_deg: float
    scale_std: float
    threshold_rad: float


def align_models(
    matches: CrossMatches,
    *,
    threshold_rad: float,
    has_scale: bool,
    hypotheses: Mapping[tuple[int, int], Sequence[PairHypothesis]],
    known: KnownLengths | None = None,
) -> list[Alignment]:
    """Return the similarities of two models on which most of their matches agree, best first.

    Each relative pose of an image of either model suggests a similarity. Its lengths are those of its matches, or those
    with which most matches agree. The best are refined on all matches together: those with a known point by the angles
    between rays and point, the others by their epipolar error.

    Args:
        matches: between the images of the two models.
        threshold_rad: maximum error of an inlier.
        has_scale: whether the second model has a scale of its own, i.e. more than one camera.
        hypotheses: relative poses of pairs of images.
        known: what is known of the lengths from elsewhere.
    """
    known = known or KnownLengths()
    proposals = pair_proposals(matches, hypotheses, threshold_rad=threshold_rad, scale=known.scale)
    finalists = [
        _refined(start, matches, known, threshold_rad=threshold_rad, has_scale=has_scale and known.scale is None)
        for start in least_costly(proposals, matches, threshold_rad=threshold_rad, count=_FINALISTS)
    ]
    costs = [alignment_cost(similarity, matches, threshold_rad=threshold_rad) for similarity, _ in finalists]
    order = np.argsort(costs, kind="stable")
    ranked = [finalists[idx] for idx in order]
    return [_judged(similarity, jacobian, matches, threshold_rad=threshold_rad) for similarity, jacobian in ranked]


def _refined(
    similarity: FloatArray, matches: CrossMatches, known: KnownLengths, *, threshold_rad: float, has_scale: bool
) -> tuple[FloatArray, FloatArray]:
    """Return the similarity refined on the matches near it, and the derivatives of its residuals."""
    jacobian = np.zeros((0, 7))
    for widen in (3.0, 1.5):
        near = errors_and_residuals(similarity, matches)[0] < widen * threshold_rad
        if near.sum() < _MIN_REFINED:
            break
        similarity, jacobian = _least_squares(
            similarity, matches[np.flatnonzero(near)], known, scale_rad=0.5 * threshold_rad, size=7 if has_scale else 6
        )
    return similarity, jacobian


def _least_squares(
    start: FloatArray, matches: CrossMatches, known: KnownLengths, *, scale_rad: float, size: int
) -> tuple[FloatArray, FloatArray]:
    """Minimise the Cauchy loss of all residuals over turn, shift and, if `size` is 7, scale."""
    from scipy.optimize import least_squares  # slow to import

    middle = matches.centers[:, 1].mean(axis=0)

    def residuals(step: FloatArray) -> FloatArray:
        similarity = _stepped(start, step, middle)
        own = errors_and_residuals(similarity, matches)[1].ravel()
        return np.concatenate([own, scale_rad * known.deviations(similarity)]) if len(known.lengths) else own

    solved = least_squares(residuals, np.zeros(size), loss="cauchy", f_scale=scale_rad, max_nfev=_MAX_EVALUATIONS)
    return _stepped(start, solved.x, middle), np.asarray(solved.jac)


def _stepped(similarity: FloatArray, step: FloatArray, middle: FloatArray) -> FloatArray:
    """Return a similarity turned, shifted and scaled a little about a point of the second model."""
    rotation, shift, scale = parts_of(similarity)
    place = scale * rotation @ middle + shift
    turned = rotation_from_rotvec(step[:3]) @ rotation
    scaled = scale * np.exp(np.clip(step[6], -1, 1)) if len(step) == 7 else scale
    return np.concatenate([turned.ravel(), place + step[3:6] - scaled * turned @ middle, [scaled]])


def _judged(similarity: FloatArray, jacobian: FloatArray, matches: CrossMatches, *, threshold_rad: float) -> Alignment:
    errors = errors_and_residuals(similarity, matches)[0]
    inliers = errors < threshold_rad
    rotation, shift, scale = parts_of(similarity)
    witnesses, alarms = log10_false_alignments(
        similarity, matches[np.flatnonzero(matches.known)], inliers[matches.known], threshold_rad=threshold_rad
    )
    noise_rad = max(float(np.sqrt(np.mean(errors[inliers] ** 2))) if inliers.any() else 0.0, 0.2 * threshold_rad)
    stds = deviations(similarity, jacobian, matches[np.flatnonzero(inliers)], noise_rad=noise_rad)
    return Alignment(
        first_from_second=Similarity3(scale, rotation, shift),
        inliers=inliers,
        witnesses=witnesses,
        log10_false_alarms=alarms,
        rotation_std_deg=stds[0],
        offset_std_deg=stds[1],
        scale_std=stds[2],
        threshold_rad=threshold_rad,
    )
