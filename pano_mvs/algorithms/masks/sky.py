"""Find the sky in a panorama: judge its areas by a fitted model, and learn the colours of the sky from those found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.logistic import Model
from pano_mvs.algorithms.masks.areas import (
    area_labels,
    area_sizes,
    border_shares,
    dilated,
    opened_areas,
    reduced_to_width,
)
from pano_mvs.algorithms.masks.sky_coefficients import FIRST, LATER
from pano_mvs.algorithms.masks.sky_features import Labels, View, area_features, compare_with_source
from pano_mvs.algorithms.panoramas import box_sum, contrast_around, filtered, largest_channel, nearest_resized
from pano_mvs.core.arrays import FloatArray, Mask, Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pad_panorama, ray_grid
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, RangeMap

_TOLERANCE = 7.0
_BAND_PX, _BAND_BESIDE_PX = 2, 3


@dataclass(frozen=True, eq=False)
class SkyColors:
    """The colours of the sky in every direction.

    `mean`: (H, W, 3) float32 expected colour. `tolerance`: (H, W) float32 largest difference of a channel from it, in
    grey levels.
    """

    mean: NDArray[np.float32]
    tolerance: NDArray[np.float32]

    def match(self, picture: Picture) -> Mask:
        """Return the pixels of a picture of the same size, (H, W), that have the colours of the sky."""
        return np.asarray(largest_channel(np.abs(picture - self.mean)) <= self.tolerance)


def sky_colors(picture: Picture, seeds: Mask) -> SkyColors:
    """Learn the colours of the sky from pixels that are sky: local means, and a smooth function of direction elsewhere.

    `picture`: (H, W, 3) uint8. `seeds`: (H, W), at least one pixel.
    """
    levels = picture.astype(np.float64)
    x, y, z = np.moveaxis(ray_grid((seeds.shape[0], seeds.shape[1])), -1, 0)
    terms = np.stack([np.ones_like(x), x, y, z, x * x, y * y, x * y, x * z, y * z], axis=-1)
    step = max(1, int(seeds.sum()) // 4000)
    factors = np.linalg.lstsq(terms[seeds][::step], levels[seeds][::step], rcond=None)[0]
    low, high = np.quantile(levels[seeds], [0.01, 0.99], axis=0)
    mean = np.asarray(np.clip(terms @ factors, low, high))
    spread = np.full(seeds.shape, np.sqrt(float(((levels - mean)[seeds] ** 2).max(axis=-1).mean())))
    for radius in (24, 6):
        if 2 * radius >= picture.shape[0]:
            continue
        count = box_sum(seeds.astype(np.float64), radius)
        share = np.clip(count / 40.0, 0, 1)
        local = box_sum(levels * seeds[..., None], radius) / np.maximum(count, 1)[..., None]
        mean = share[..., None] * local + (1 - share)[..., None] * mean
        squares = box_sum(largest_channel((levels - mean) ** 2) * seeds, radius) / np.maximum(count, 1)
        spread = share * np.sqrt(squares) + (1 - share) * spread
    tolerance = np.minimum(_TOLERANCE + 3.0 * spread, 40.0)
    return SkyColors(mean.astype(np.float32), tolerance.astype(np.float32))


def sharpened_sky(sky: Mask, colors: SkyColors, picture: Picture) -> Mask:
    """Return the sky at the resolution of a picture, with edges where the picture has them.

    Near its edges, a pixel is sky if its colour is nearer to that of the sky than to that of what is beside it.

    `sky`: (h, w). `colors`: of the same size. `picture`: (H, W, 3) uint8, of that size or larger.
    """
    height, width = picture.shape[:2]
    scale = max(1, round(width / sky.shape[1]))
    wide = _resized(sky.astype(np.float32), (height, width)) >= 0.5
    mean = _resized(colors.mean, (height, width))
    band = dilated(wide, _BAND_PX * scale) & dilated(~wide, _BAND_PX * scale)
    away = largest_channel(np.abs(picture - mean))
    weights = (~wide | band) * np.maximum(away - _TOLERANCE, 0) ** 2
    beside, total = _box(picture * weights[..., None], _BAND_BESIDE_PX * scale), _box(weights, _BAND_BESIDE_PX * scale)
    beside /= np.maximum(total, 1e-6)[..., None]
    between = mean - beside
    position = ((picture - beside) * between).sum(axis=-1) / np.maximum((between**2).sum(axis=-1), 1e-6)
    # A pixel that is far from the colours of the sky, for what lies beside it, is something else.
    limit = np.maximum(_resized(colors.tolerance, (height, width)), 0.5 * np.linalg.norm(between, axis=-1))
    nearer = np.where(total > 1, position > 0.5, wide) & (away <= limit)
    return np.where(band, nearer, wide)


def _resized(values: NDArray[np.float32], size_hw: tuple[int, int]) -> NDArray[np.float32]:
    if values.shape[:2] == size_hw:
        return values
    pad = 1
    scale_y, scale_x = size_hw[0] / values.shape[0], size_hw[1] / values.shape[1]
    padded = pad_panorama(values, pad)
    columns = ((np.arange(size_hw[1]) + 0.5) / scale_x - 0.5 + pad).astype(np.float32)
    rows = ((np.arange(size_hw[0]) + 0.5) / scale_y - 0.5 + pad).astype(np.float32)
    at_x, at_y = np.meshgrid(columns, rows)
    return np.asarray(cv2.remap(padded, at_x, at_y, cv2.INTER_LINEAR), np.float32)


def _box(values: NDArray[np.float32], radius: int) -> NDArray[np.float32]:
    side = 2 * radius + 1
    return filtered(values.astype(np.float32), radius, lambda padded: cv2.blur(padded, (side, side)))


MAX_SOURCES = 4
"""More sources than this add little."""

MIN_PROBABILITY = 5 / 6
"""An area is sky above this: five missed ones cost as much as a surface that is lost, as in the verdict on cameras."""


def sky_pixels(
    range_map: RangeMap,
    picture: Picture,
    sources: Sequence[Picture],
    *,
    source_from_reference: Sequence[Rigid3],
    valid: Mask,
    source_valid: Sequence[Mask],
    up: FloatArray | None = None,
) -> Mask:
    """Return the pixels, (H, W), that show the sky.

    The smooth areas of the picture are judged by the model of `sky_coefficients` from what `sky_features` measures.
    The colours of those that are sky, as a function of direction, then give further areas, behind branches and in
    windows, which are judged by the same model, and by how alike they are. Edges follow the picture.

    Args:
        range_map: of the reference, after the check by other views.
        picture: the reference, (H, W, 3) uint8.
        sources: of which the first `MAX_SOURCES` are used.
        source_from_reference: pose of each.
        valid: (H, W), False is ignored.
        source_valid: the same of each source.
        up: (3,) unit direction away from gravity in the camera frame of the reference, if it is known.

    Raises:
        UsageError: if the sizes do not fit together, or there is no source.
    """
    if picture.shape[:2] != range_map.range.shape or valid.shape != range_map.range.shape:
        raise UsageError(f"the picture is {picture.shape[:2]}, its ranges are {range_map.range.shape}")
    if not sources or not len(sources) == len(source_from_reference) == len(source_valid):
        raise UsageError("the sky needs one or more sources, each with its pose and mask")
    if picture.shape[1] < 64:
        return np.zeros_like(valid)
    used = list(zip(sources, source_valid, source_from_reference, strict=True))[:MAX_SOURCES]
    view = view_of(range_map, picture, valid, sources=used, up=up)
    sky = judged_areas(view, (FIRST, LATER))[0]
    if not sky.any():
        return np.zeros_like(valid)
    colors = sky_colors(view.picture, sky)
    found = sharpened_sky(sky, colors, picture) & valid
    surface = view.solid | (view.consistent & (view.heights < 0))
    return np.asarray(found & ~nearest_resized(surface, valid.shape), np.bool_)


def view_of(
    range_map: RangeMap,
    picture: Picture,
    valid: Mask,
    *,
    sources: Sequence[tuple[Picture, Mask, Rigid3]],
    up: FloatArray | None = None,
) -> View:
    """Return the reference and its comparisons with the sources, at `WIDTH` columns or fewer."""
    small, small_valid = reduced_to_width(picture, valid)
    ranges = nearest_resized(range_map.range, small_valid.shape)
    consistent = nearest_resized(range_map.confidence, small_valid.shape) >= CONSISTENT_CONFIDENCE[0]
    small_sources = [(*reduced_to_width(source, mask), pose) for source, mask, pose in sources]
    comparisons = tuple(
        compare_with_source(small, ranges, source, source_valid=mask, source_from_reference=pose)
        for source, mask, pose in small_sources
    )
    return View(small, small_valid, ranges, consistent, comparisons, up)


def judged_areas(view: View, models: tuple[Model, Model]) -> tuple[Mask, list[tuple[Labels, dict[str, FloatArray]]]]:
    """Return the sky, (H, W), and the areas of each round, with what was measured on them."""
    far = opened_areas(view.far, 1)  # clouds
    # Grey levels between the darkest and the brightest pixel of a 3×3 window of a smooth area.
    smooth = view.valid & (far | (contrast_around(view.picture, 1) < 16))
    # Smaller areas of the sphere are not judged without known sky.
    areas = _numbered(area_labels(smooth), view, min_share=1e-4)
    sky: Mask = np.zeros_like(view.valid)
    away = np.zeros(view.valid.shape, np.float32)  # from the colours of the sky, once these are known
    done: list[tuple[Labels, dict[str, FloatArray]]] = []
    while (areas >= 0).any() and len(done) < 3:
        features = area_features(view, areas)
        if done:
            features |= {
                "first": models[0].log_odds(features),
                "like": _mean(away, areas),
                "touches": border_shares(areas, sky)[: int(areas.max()) + 1],
            }
        taken = (areas >= 0) & (models[min(len(done), 1)].probabilities(features) > MIN_PROBABILITY)[areas]
        done.append((areas, features))
        if not taken.any():
            break
        sky = sky | taken
        colors = sky_colors(view.picture, sky)
        away = np.asarray(largest_channel(np.abs(view.picture - colors.mean)) / colors.tolerance)
        # Farther from known sky, its colours are not known.
        reached = view.valid & ~sky & dilated(sky, min(40, len(sky) // 2 - 1))
        areas = _numbered(area_labels(reached & (far | (away <= 1))), view)
    return _without_specks(sky, view), done


def _mean(values: NDArray[np.float32], areas: Labels) -> FloatArray:
    """Return the mean of values (H, W) in each area."""
    inside = areas >= 0
    return np.asarray(np.bincount(areas[inside], values[inside]) / np.bincount(areas[inside]))


def _without_specks(sky: Mask, view: View) -> Mask:
    """Return the sky with the specks in it that are too small to be judged and that other views do not confirm."""
    labels = area_labels(view.valid & ~sky)
    sizes, known = (area_sizes(labels, view.weights * part) for part in (1.0, view.confirmed))
    # Larger parts within the sky are something else.
    small = (sizes < 1e-3 * view.weights.sum()) & (2 * known < sizes) & (border_shares(labels, sky) > 0.99)
    return np.asarray(sky | ((labels >= 0) & small[labels]), np.bool_)


def _numbered(labels: Labels, view: View, *, min_share: float = 0.0) -> Labels:
    """Return labels from 0 on, (H, W), of the areas of at least a share of the sphere; −1 elsewhere."""
    sizes = area_sizes(labels, view.weights)
    kept = np.flatnonzero(sizes > min_share * view.weights.sum())
    numbers = np.full(labels.size, -1)
    numbers[kept] = np.arange(len(kept))
    return np.where(labels >= 0, numbers[labels], -1)
