"""Matches between the images of two models, and their errors under a similarity of the models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Similarity3

BoolArray = NDArray[np.bool_]

_WITHOUT_POINT = 0.2  # weight of a match without known point, which agrees more easily


@dataclass(frozen=True, eq=False)
class CrossMatches:
    """Matches between the images of two models, each seen along a ray from a centre in its model's world.

    Attributes:
        cameras: (M, 2) positions of the two images.
        keypoints: (M, 2) positions of the two key points.
        centers: (M, 2, 3) centres of the two cameras.
        rays: (M, 2, 3) unit rays.
        ranges: (M, 2) known ranges along the rays, NaN where unknown.
    """

    cameras: NDArray[np.intp]
    keypoints: NDArray[np.int32]
    centers: FloatArray
    rays: FloatArray
    ranges: FloatArray

    def __len__(self) -> int:
        """Return the number of matches."""
        return len(self.cameras)

    def __getitem__(self, chosen: NDArray[np.generic]) -> CrossMatches:
        """Return some of the matches."""
        return CrossMatches(
            self.cameras[chosen], self.keypoints[chosen], self.centers[chosen], self.rays[chosen], self.ranges[chosen]
        )

    @property
    def points(self) -> FloatArray:
        """The points in the world of either model, (M, 2, 3), NaN where unknown."""
        return self.centers + self.ranges[..., None] * self.rays

    @property
    def known(self) -> BoolArray:
        """Whether the point is known in at least one of the models, (M,)."""
        return np.asarray(np.isfinite(self.ranges).any(axis=1))


def stacked(parts: Sequence[CrossMatches]) -> CrossMatches:
    """Return all matches of several lists as one."""
    return CrossMatches(*(np.concatenate(some) for some in zip(*map(_arrays, parts), strict=True)))


def _arrays(matches: CrossMatches) -> tuple[NDArray[np.generic], ...]:
    """Return the arrays of matches in the order of the fields."""
    return matches.cameras, matches.keypoints, matches.centers, matches.rays, matches.ranges


def vector_of(similarity: Similarity3) -> FloatArray:
    """Return rotation, translation and scale of a similarity in one vector, (13,), as the search handles them."""
    return np.concatenate([similarity.rotation.ravel(), similarity.translation, [similarity.scale]])


def parts_of(similarity: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return rotation (3, 3), translation (3,) and scale of a similarity that is stored in one vector."""
    return similarity[:9].reshape(3, 3), similarity[9:12], float(similarity[12])


def match_errors(similarity: Similarity3, matches: CrossMatches) -> FloatArray:
    """Return the error of each match in radians, (M,).

    The larger of the angles between known points and the rays to them in the other model; the spherical Sampson error
    if neither point is known.
    """
    return errors_and_residuals(vector_of(similarity), matches)[0]


def errors_and_residuals(similarity: FloatArray, matches: CrossMatches) -> tuple[FloatArray, FloatArray]:
    """Return the error of each match, (M,), and its residuals, (M, 7); see `kernels_alignment` for both."""
    from pano_mvs.algorithms.poses.joining import kernels_alignment as kernels

    errors, residuals = np.empty(len(matches)), np.empty((len(matches), 7))
    kernels.match_errors(
        np.ascontiguousarray(similarity),
        np.ascontiguousarray(matches.centers),
        np.ascontiguousarray(matches.rays),
        np.ascontiguousarray(matches.ranges),
        errors,
        residuals,
    )
    return errors, residuals


def alignment_cost(similarity: FloatArray, matches: CrossMatches, *, threshold_rad: float) -> float:
    """Return Σ min(error² / threshold², 1), in which a match without known point counts a fifth."""
    weight = np.where(matches.known, 1.0, _WITHOUT_POINT)
    errors = errors_and_residuals(similarity, matches)[0]
    return float((weight * np.minimum((errors / threshold_rad) ** 2, 1.0)).sum())
