"""Compare the colours of a panorama with those of its sources, at infinity and at its ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.masks.areas import DARK_LEVEL
from pano_mvs.algorithms.panoramas import largest_channel, mean_around
from pano_mvs.core.arrays import Mask
from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_grid, sample_panorama

Colors = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Comparison:
    """A source as seen from the reference."""

    # (H, W, 3) colours of the source where each pixel would be if it were infinitely far away; NaN where the source is
    # masked
    at_infinity: Colors
    at_range: Colors  # the same at the pixel's range; NaN where it has none
    parallax_px: NDArray[np.float32]  # (H, W) pixels of the reference between the two; 0 without a range


def compare_with_source(
    reference: NDArray[np.uint8],
    ranges: NDArray[np.float32],
    source: NDArray[np.uint8],
    *,
    source_valid: Mask,
    source_from_reference: Rigid3,
) -> Comparison:
    """Look a source up from a reference.

    `reference`: (H, W, 3) uint8. `ranges`: (H, W) of the reference, NaN without. `source`: (Hs, Ws, 3) uint8.
    `source_valid`: (Hs, Ws), False is ignored. `source_from_reference`: the pose of the source.
    """
    size_hw = (reference.shape[0], reference.shape[1])
    colors = mean_around(source)
    colors[~source_valid] = np.nan
    far = ray_grid(size_hw) @ source_from_reference.rotation.T
    known = np.isfinite(ranges)
    points = far * np.where(known, ranges, 1.0)[..., None] + source_from_reference.translation
    near = points / np.maximum(np.sqrt(_sum(points * points)), 1e-12)[..., None]
    angle = np.arccos(np.clip(_sum(far * near), -1, 1))
    source_hw = (source.shape[0], source.shape[1])
    at_range = sample_panorama(colors, pixel_from_ray(near, source_hw))
    at_range[~known] = np.nan
    return Comparison(
        sample_panorama(colors, pixel_from_ray(far, source_hw)).astype(np.float32),
        at_range.astype(np.float32),
        np.where(known, angle * size_hw[1] / (2 * np.pi), 0).astype(np.float32),
    )


def _sum(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return x + y + z of vectors (..., 3); `sum` over a short last axis takes several times as long."""
    return np.asarray(vectors[..., 0] + vectors[..., 1] + vectors[..., 2])


def source_errors(
    picture: NDArray[np.uint8], area: Mask, comparisons: Sequence[Comparison]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the colour differences to each source, (S, H, W) in grey levels, at infinity and at the ranges.

    NaN where a source is masked or a range is missing. Pixels of `area`, at their ranges, give the factor of each
    channel.
    """
    own = mean_around(picture)
    errors = []
    for source in comparisons:
        seen = area & np.isfinite(source.at_range[..., 0])
        gain = _gain(own[seen], source.at_range[seen]) if seen.any() else np.ones(3, np.float32)
        errors.append([largest_channel(np.abs(other / gain - own)) for other in (source.at_infinity, source.at_range)])
    found = np.array(errors, np.float32)
    return found[:, 0], found[:, 1]


def _gain(own: Colors, other: Colors) -> NDArray[np.float32]:
    return np.asarray(np.median((other + DARK_LEVEL) / (own + DARK_LEVEL), axis=0), np.float32)
