"""Matches between the images of two models, and their errors under a similarity of the models."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.placement.placed_model import PlacedModel
from pano_mvs.algorithms.poses.placement.view_graph import Edge
from pano_mvs.core.arrays import FloatArray
from pano_mvs.geometry import Similarity3
from pano_mvs.scene import TwoView

THRESHOLD_RAD = float(np.deg2rad(0.4))
"""Maximum error of a match that agrees with a similarity."""


@dataclass(frozen=True, eq=False)
class CrossMatches:
    """Matches between the images of two models, each seen along a ray from a centre in its model's world."""

    cameras: NDArray[np.intp]  # (M, 2) positions of the two images
    centers: FloatArray  # (M, 2, 3) centres of the two cameras
    rays: FloatArray  # (M, 2, 3) unit rays
    ranges: FloatArray  # (M, 2) known ranges along the rays, NaN where unknown

    @classmethod
    def between(cls, first: PlacedModel, second: PlacedModel, views: Mapping[Edge, TwoView]) -> CrossMatches:
        """Return all matches of pairs of an image of either model, verified or not.

        Args:
            first: a model.
            second: another model of the same capture, which shares no image with the first one.
            views: (image of the first model, image of the second one) to their pair.
        """
        parts = []
        for pair, view in sorted(views.items()):
            matches = view.all_matches_idx[:, :: 1 if pair[0] < pair[1] else -1]
            both = list(zip((first, second), pair, matches.T, strict=True))
            centers = np.stack([model.cameras[image].center for model, image, _ in both])
            rays = [model.pairs.bearings[image][own] @ model.cameras[image].rotation for model, image, own in both]
            parts.append(
                (
                    np.tile(np.array([pair], np.intp), (len(matches), 1)),
                    np.tile(centers[None], (len(matches), 1, 1)),
                    np.stack(rays, axis=1),
                    np.stack([model.known_ranges(image)[own] for model, image, own in both], axis=1),
                )
            )
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def __len__(self) -> int:
        """Return the number of matches."""
        return len(self.cameras)

    def __getitem__(self, chosen: NDArray[np.generic]) -> CrossMatches:
        """Return some of the matches."""
        return CrossMatches(self.cameras[chosen], self.centers[chosen], self.rays[chosen], self.ranges[chosen])

    @property
    def points(self) -> FloatArray:
        """The points in the world of either model, (M, 2, 3), NaN where unknown."""
        return self.centers + self.ranges[..., None] * self.rays

    @property
    def known(self) -> NDArray[np.bool_]:
        """Whether the point is known in at least one of the models, (M,)."""
        return np.asarray(np.isfinite(self.ranges).any(axis=1))

    def errors(self, similarity: Similarity3) -> tuple[FloatArray, FloatArray]:
        """Return the error of each match in radians, (M,), and its residuals, (M, 7); see `kernels_alignment`.

        The error is the larger of the angles between known points and the rays to them in the other model; the
        spherical Sampson error if neither point is known.
        """
        from pano_mvs.algorithms.poses.joining import kernels_alignment as kernels

        errors, residuals = np.empty(len(self)), np.empty((len(self), 7))
        kernels.match_errors(
            np.concatenate([similarity.rotation.ravel(), similarity.translation, [similarity.scale]]),
            np.ascontiguousarray(self.centers),
            np.ascontiguousarray(self.rays),
            np.ascontiguousarray(self.ranges),
            errors,
            residuals,
        )
        return errors, residuals

    def cost(self, similarity: Similarity3) -> float:
        """Return Σ min(error² / threshold², 1); a match without known point agrees more easily and counts a fifth."""
        weight = np.where(self.known, 1.0, 0.2)
        return float((weight * np.minimum((self.errors(similarity)[0] / THRESHOLD_RAD) ** 2, 1.0)).sum())
