"""What is measured on each area of a panorama that shows whether it is the sky, compared with its sources."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.masks.areas import DARK_LEVEL, dilated, pixel_weights
from pano_mvs.algorithms.panoramas import box_sum, largest_channel, mean_around
from pano_mvs.algorithms.sweep.preparation import is_bare
from pano_mvs.core.arrays import FloatArray, Mask, Picture
from pano_mvs.geometry import Rigid3, pad_panorama, pixel_from_ray, ray_grid, sample_panorama

# Grey levels by which colours agree better.
_CLEARLY = 3.0
# Where a surface lies beside an area, and from how many pixels a median is taken.
_BESIDE_PX, _MIN_PIXELS = 4, 8

Labels = NDArray[np.int64]
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


@dataclass(frozen=True, eq=False)
class View:
    """What is known of the reference at the comparison's resolution; arrays (H, W) or (H, W, 3).

    `up`: (3,) unit direction away from gravity in its camera frame, or None.
    """

    picture: Picture
    valid: Mask
    ranges: NDArray[np.float32]
    consistent: Mask
    comparisons: tuple[Comparison, ...]
    up: FloatArray | None = None

    @cached_property
    def weights(self) -> FloatArray:
        """The solid angle of each pixel."""
        return pixel_weights(self.valid.shape)

    @cached_property
    def colors(self) -> Colors:
        """The colours without noise."""
        return mean_around(self.picture)

    @cached_property
    def parallax_px(self) -> NDArray[np.float32]:
        """The largest parallax of each range; 0 without one."""
        return np.asarray(np.max([source.parallax_px for source in self.comparisons], axis=0))

    @cached_property
    def confirmed(self) -> Mask:
        """The pixels whose ranges other views confirm under a parallax."""
        # Below a pixel of parallax, infinity and the range look the same.
        return np.asarray(self.consistent & (self.parallax_px > 1.0))

    @cached_property
    def errors(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The colour differences to each source, (S, H, W) in grey levels, at infinity and at the ranges; NaN without.

        Confirmed pixels, at their ranges, give the factor of each channel.
        """
        own, errors = self.colors, []
        for source in self.comparisons:
            seen = self.confirmed & np.isfinite(source.at_range[..., 0])
            gain = np.ones(3, np.float32)
            if seen.any():
                ratios = (source.at_range[seen] + DARK_LEVEL) / (own[seen] + DARK_LEVEL)
                gain = np.asarray(np.median(ratios, axis=0), np.float32)
            errors.append([largest_channel(np.abs(at / gain - own)) for at in (source.at_infinity, source.at_range)])
        found = np.array(errors, np.float32)
        return found[:, 0], found[:, 1]

    @cached_property
    def least_errors(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The least of them, (H, W) each, since others may be occluded."""
        return np.fmin.reduce(self.errors[0]), np.fmin.reduce(self.errors[1])

    @cached_property
    def textured(self) -> Mask:
        """The confirmed pixels whose colours change enough to be matched."""
        return np.asarray(self.confirmed & ~is_bare(self.picture))

    @cached_property
    def usual_px(self) -> float:
        """The median parallax of the textured pixels, by solid angle; 0 without any."""
        order = np.argsort(self.parallax_px[self.textured])
        upto = np.cumsum(self.weights[self.textured][order])
        if not len(upto):
            return 0.0
        return float(self.parallax_px[self.textured][order][np.searchsorted(upto, 0.5 * upto[-1])])

    @cached_property
    def solid(self) -> Mask:
        """The confirmed pixels whose colours agree at their ranges and not at infinity, as most around them do.

        The sky has single ones by chance.
        """
        far, near = self.least_errors
        solid = self.confirmed & (near + _CLEARLY < far)
        return np.asarray(solid & (box_sum(solid.astype(np.float64), 1) > 0.5 * box_sum(np.ones(solid.shape), 1)))

    @cached_property
    def far(self) -> Mask:
        """The pixels whose colours agree at infinity and not at their ranges."""
        far, near = self.least_errors
        return np.asarray(far + _CLEARLY < near)

    @cached_property
    def heights(self) -> NDArray[np.float64]:
        """The sine of the angle above the horizon; NaN if it is unknown which way is up."""
        return ray_grid((self.valid.shape[0], self.valid.shape[1])) @ (
            np.full(3, np.nan) if self.up is None else self.up
        )

    @cached_property
    def lights(self) -> tuple[FloatArray, FloatArray]:
        """How bright and how blue each pixel is: the share of the sphere that is less so."""
        blueness = (self.colors[..., 2] + DARK_LEVEL) / (self.colors[..., 0] + DARK_LEVEL)
        return _ranks(largest_channel(self.colors), self.weights), _ranks(blueness, self.weights)


def area_features(view: View, areas: Labels) -> dict[str, FloatArray]:
    """Return what is measured on each area, name to (N,), NaN where it cannot be measured.

    `areas`: (H, W) the number of the area of each pixel, 0 to N − 1; −1 elsewhere.
    """
    count, inside = int(areas.max()) + 1, areas >= 0
    label, weights = areas[inside], view.weights[inside]
    total = np.bincount(label, weights, count)
    share = total / view.weights.sum()

    def mean(values: NDArray[Any]) -> FloatArray:
        return np.asarray(np.bincount(label, weights * values[inside], count) / total)

    edge = inside & dilated(~inside, 3)
    edge_far, edge_near = (_quantiles(error[edge], areas[edge], count, share=0.5) for error in view.least_errors)
    return {
        "up": mean(view.heights),
        "confirmed": mean(view.confirmed),
        # The probability that a pixel of the area is brighter, or bluer, than one outside: Mann and Whitney's U.
        "bright": (mean(view.lights[0]) - share / 2) / (1 - share),
        "blue": (mean(view.lights[1]) - share / 2) / (1 - share),
        "edge_prefers": np.log((edge_near + 1) / (edge_far + 1)),
        "surface": share * mean(view.solid),  # of the sphere: single ranges in the sky are chance, and edges are thin
        "apart": np.log1p(_quantiles(view.least_errors[0][inside], label, count, share=0.5)),
        "behind": _quantiles(np.fmax.reduce(view.errors[1])[edge], areas[edge], count, share=0.9),
        "far_beside": np.log((view.usual_px + 0.2) / (_quantiles(*_beside(view, areas), count, share=0.15) + 0.2)),
    }


def _beside(view: View, areas: Labels) -> tuple[NDArray[np.float32], Labels]:
    """Return the parallax of each textured pixel beside an area, and the area's number: (M,) each, with repetitions."""
    pad = _BESIDE_PX
    wide_areas = pad_panorama(areas, pad)
    found, labels = [], []
    height, width = areas.shape
    for y, x in _steps():
        beside = wide_areas[pad + y : pad + y + height, pad + x : pad + x + width]
        at = view.textured & (beside >= 0) & (beside != areas)
        found.append(view.parallax_px[at])
        labels.append(beside[at])
    return np.concatenate(found), np.concatenate(labels)


def _steps() -> Iterator[tuple[int, int]]:
    for distance in (_BESIDE_PX // 2, _BESIDE_PX):
        for y in (-distance, 0, distance):
            for x in (-distance, 0, distance):
                if y or x:
                    yield y, x


def _quantiles(values: NDArray[Any], labels: Labels, count: int, *, share: float) -> FloatArray:
    """Return a quantile of the finite values (M,) of each label, (N,); NaN for few of them."""
    known = np.isfinite(values)
    values, labels = values[known], labels[known]
    order = np.lexsort((values, labels))
    sizes = np.bincount(labels, minlength=count)
    enough = sizes >= _MIN_PIXELS
    at = np.cumsum(sizes) - sizes + (share * (sizes - 1)).astype(np.int64)
    found = np.full(count, np.nan)
    found[enough] = values[order][at[enough]]
    return found


def _ranks(values: NDArray[np.float32], weights: FloatArray) -> FloatArray:
    """Return the share of the sphere with smaller values than each pixel, (H, W); equal ones count half."""
    _, which = np.unique(values, return_inverse=True)
    sizes = np.bincount(which.ravel(), weights.ravel())
    upto = np.cumsum(sizes)
    return np.asarray(((upto - 0.5 * sizes) / upto[-1])[which].reshape(values.shape))
