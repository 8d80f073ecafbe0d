"""Weights of the sources at each pixel: how likely each of them sees what the reference sees.

A source is occluded, or sees a surface from too far aside, over areas. So how well it matches at the pixels around says
more than its match at one pixel, and one good source is enough where the others match badly (E. Zheng et al.,
"PatchMatch based joint view selection and depthmap estimation", 2014; J. L. Schönberger et al., "Pixelwise view
selection for unstructured multi-view stereo", 2016).
"""

from __future__ import annotations

import numpy as np

from pano_mvs.core.arrays import FloatImage
from pano_mvs.geometry import pad_panorama

# Standard deviation of the correlation, from 1, of a source that sees the surface.
_SIGMA = 0.3
# Pixels on either side of a pixel whose matches count for it.
_RADIUS = 2
# Share of the rounds before in what is known after a round.
_MEMORY = 0.5


class ViewWeights:
    """The weights of all sources, and what they are made of.

    Attributes:
        views: (S, H, W) float32. A round replaces it by correlations, −2 where a source does not count; `update`
            replaces these by weights, at most 1, which is that of the best source.
        known: whether `views` holds weights: from the first `update` on.
    """

    def __init__(self, sources: int, size_hw: tuple[int, int]) -> None:
        self.views: FloatImage = np.zeros((sources, *size_hw), np.float32)
        self.known = False
        self._match: FloatImage = np.zeros((0, *size_hw), np.float32)

    def update(self) -> None:
        """Replace correlations by weights.

        The match of a source is exp(−(1 − ρ)² / 2σ²), averaged over 5 × 5 pixels, and over the rounds with half of the
        weight for all earlier ones. Weights are the squares of the matches over the best one.
        """
        if not self.known:
            self._match = np.empty_like(self.views)
        for idx, correlation in enumerate(self.views):
            match = _mean_around(np.exp(-(((1 - correlation) / _SIGMA) ** 2) / 2) * (correlation > -1.5))
            self._match[idx] = _MEMORY * self._match[idx] + (1 - _MEMORY) * match if self.known else match
        best = np.maximum(self._match.max(axis=0), np.float32(1e-6))
        np.square(self._match / best, out=self.views)
        self.known = True


def _mean_around(picture: FloatImage) -> FloatImage:
    """Return the mean over each pixel and its neighbours, across the seam and the poles; the same sum at each pixel."""
    height, width = picture.shape
    padded = pad_panorama(picture.astype(np.float32), _RADIUS)
    side = 2 * _RADIUS + 1
    rows = np.zeros((height, width + 2 * _RADIUS), np.float32)
    for shift in range(side):
        rows += padded[shift : shift + height]
    result = np.zeros((height, width), np.float32)
    for shift in range(side):
        result += rows[:, shift : shift + width]
    return result / np.float32(side**2)
