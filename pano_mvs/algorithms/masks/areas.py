"""Areas of pixels on the sphere, and those of one colour, as left by stitchers, crops or logos."""

from __future__ import annotations

from functools import cache
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import box_sum, reduced_mask, reduced_panorama, squarely_dilated
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import pad_panorama, pixel_solid_angle, ray_grid

WIDTH = 512
"""Columns at which views are compared; larger ones are reduced."""

SQUARE_DEG_OF_SPHERE = 4 * np.pi * np.degrees(1) ** 2
DARK_LEVEL = 4.0
"""Added to grey levels before they are divided, because dark ones are mostly noise."""


def reduced_to_width(picture: Picture, valid: Mask) -> tuple[Picture, Mask]:
    """Return a panorama and its mask at `WIDTH` columns; smaller ones as they are."""
    return reduced_panorama(picture, WIDTH), reduced_mask(valid, WIDTH)


def area_labels(pixels: Mask) -> NDArray[np.int64]:
    """Return the connected area of each pixel, across the seam and the poles, (H, W); −1 elsewhere."""
    from pano_mvs.algorithms.filters.kernels_fill import label_surfaces  # compiles on import

    labels = label_surfaces(np.where(pixels, np.float32(1), np.float32(np.nan)), 1.0)
    return np.asarray(labels).reshape(pixels.shape)


def area_sizes(labels: NDArray[np.int64], weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the sum of weights (H, W) over the area of each label, (H W,)."""
    inside = labels >= 0
    return np.asarray(np.bincount(labels[inside], weights[inside], labels.size), np.float64)


def large_areas(pixels: Mask, min_area_deg2: float) -> Mask:
    """Return the connected areas of at least a size, (H, W)."""
    labels, weights = area_labels(pixels), pixel_weights(pixels.shape)
    sizes = area_sizes(labels, weights) / weights.sum() * SQUARE_DEG_OF_SPHERE
    return np.asarray((labels >= 0) & (sizes >= min_area_deg2)[labels])


def opened_areas(pixels: Mask, radius_px: int) -> Mask:
    """Return areas without bridges and specks narrower than twice a radius."""
    return dilated(~dilated(~pixels, radius_px), radius_px) & pixels


@cache
def off_nadir_deg(size_hw: tuple[int, int]) -> NDArray[np.float64]:
    """Return the angle of each pixel from straight down, (H, W)."""
    return np.asarray(np.degrees(np.arccos(np.clip(ray_grid(size_hw)[..., 1], -1, 1))), np.float64)


def dilated(pixels: Mask, radius_px: int) -> Mask:
    """Return pixels and what is within a radius, in pixels at the equator, with the same extent everywhere."""
    return np.asarray(box_sum(pixels.astype(np.float64), radius_px) > 0.5)


def pixel_weights(shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Return the solid angle of each pixel, (H, W), in pixels at the equator."""
    per_row = pixel_solid_angle((shape[0], shape[1]))
    return np.broadcast_to((per_row / per_row.max())[:, None], (shape[0], shape[1]))


def share_of_sphere(pixels: Mask) -> float:
    """Return the share of the sphere's solid angle that pixels, (H, W), cover."""
    weights = pixel_weights(pixels.shape)
    return float(weights[pixels].sum() / weights.sum())


def border_shares(labels: NDArray[np.int64], pixels: Mask) -> NDArray[np.float64]:
    """Return for each label the share of its area's border, by length, that lies on some pixels.

    `labels`: (H, W) as returned by `area_labels`. `pixels`: (H, W).

    Returns:
        (H W,), 0 for labels that are not in use.
    """
    all_weights = pixel_weights(labels.shape)
    whole, part = np.zeros(labels.size), np.zeros(labels.size)
    padded_labels, padded_pixels = pad_panorama(labels, 1), pad_panorama(pixels, 1)
    height, width = labels.shape
    for y, x in ((0, 1), (2, 1), (1, 0), (1, 2)):
        beside = padded_labels[y : y + height, x : x + width]
        edge = (labels >= 0) & (beside != labels)
        on = edge & padded_pixels[y : y + height, x : x + width]
        whole += np.bincount(labels[edge], all_weights[edge], labels.size)
        part += np.bincount(labels[on], all_weights[on], labels.size)
    return np.asarray(part / np.maximum(whole, 1e-12))


@checks_settings
def areas_of_color(
    picture: NDArray[np.uint8],
    color_rgb: tuple[int, int, int],
    *,
    tolerance: Annotated[int, Setting("maximum difference of a channel, in grey levels", ge=0, le=255)] = 8,
    min_area_deg2: Annotated[float, Setting("minimum size of an area, in square degrees", ge=0)] = 4.0,
    margin_px: Annotated[int, Setting("width in pixels by which areas are dilated", ge=0, le=64)] = 2,
) -> Mask:
    """Return the pixels, (H, W), of large connected areas of one colour, across the seam and the poles.

    Args:
        picture: (H, W, 3) uint8 RGB, the full sphere.

    Raises:
        UsageError: if the image is not an (H, W, 3) uint8 array, or a setting is out of bounds.
    """
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise UsageError(f"an image must be (H, W, 3) uint8, got {picture.shape} {picture.dtype}")
    alike = np.asarray((np.abs(picture.astype(np.int16) - np.array(color_rgb, np.int16)) <= tolerance).all(axis=-1))
    if not alike.any():
        return alike
    return squarely_dilated(large_areas(alike, min_area_deg2), min(margin_px, len(alike)))
