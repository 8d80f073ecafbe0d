"""The colours of a sky as a function of direction, and edges of the sky that follow the picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.channels import largest_channel
from pano_mvs.algorithms.filters.sphere.box import box_sum
from pano_mvs.algorithms.masks.areas import dilated
from pano_mvs.geometry import pad_panorama, ray_grid

Mask = NDArray[np.bool_]
Picture = NDArray[np.uint8]

_RADII = (24, 6)
_MIN_SEEDS = 40.0
_TOLERANCE, _SPREAD, _MAX_TOLERANCE = 7.0, 3.0, 40.0
_BAND_PX, _BESIDE_PX = 2, 3


@dataclass(frozen=True, eq=False)
class SkyColors:
    """The colours of the sky in every direction.

    Attributes:
        mean: (H, W, 3) float32 expected colour.
        tolerance: (H, W) float32 largest difference of a channel from it, in grey levels.
    """

    mean: NDArray[np.float32]
    tolerance: NDArray[np.float32]

    def match(self, picture: Picture) -> Mask:
        """Return the pixels of a picture of the same size, (H, W), that have the colours of the sky."""
        return np.asarray(largest_channel(np.abs(picture - self.mean)) <= self.tolerance)


def sky_colors(picture: Picture, seeds: Mask) -> SkyColors:
    """Learn the colours of the sky from pixels that are sky: local means, and a smooth function of direction elsewhere.

    Args:
        picture: (H, W, 3) uint8.
        seeds: (H, W), at least one pixel.
    """
    levels = picture.astype(np.float64)
    mean = _polynomial(levels, seeds)
    spread = np.full(seeds.shape, np.sqrt(float(((levels - mean)[seeds] ** 2).max(axis=-1).mean())))
    for radius in _RADII:
        if 2 * radius >= picture.shape[0]:
            continue
        count = box_sum(seeds.astype(np.float64), radius)
        share = np.clip(count / _MIN_SEEDS, 0, 1)
        local = box_sum(levels * seeds[..., None], radius) / np.maximum(count, 1)[..., None]
        mean = share[..., None] * local + (1 - share)[..., None] * mean
        squares = box_sum(largest_channel((levels - mean) ** 2) * seeds, radius) / np.maximum(count, 1)
        spread = share * np.sqrt(squares) + (1 - share) * spread
    tolerance = np.minimum(_TOLERANCE + _SPREAD * spread, _MAX_TOLERANCE)
    return SkyColors(mean.astype(np.float32), tolerance.astype(np.float32))


def sharpened_sky(sky: Mask, colors: SkyColors, picture: Picture) -> Mask:
    """Return the sky at the resolution of a picture, with edges where the picture has them.

    Near its edges, a pixel is sky if its colour is nearer to that of the sky than to that of what is beside it.

    Args:
        sky: (h, w).
        colors: of the same size.
        picture: (H, W, 3) uint8, of that size or larger.
    """
    height, width = picture.shape[:2]
    scale = max(1, round(width / sky.shape[1]))
    wide = _resized(sky.astype(np.float32), (height, width)) >= 0.5
    mean = _resized(colors.mean, (height, width))
    band = dilated(wide, _BAND_PX * scale) & dilated(~wide, _BAND_PX * scale)
    away = largest_channel(np.abs(picture - mean))
    weights = (~wide | band) * np.maximum(away - _TOLERANCE, 0) ** 2
    beside, total = _box(picture * weights[..., None], _BESIDE_PX * scale), _box(weights, _BESIDE_PX * scale)
    beside /= np.maximum(total, 1e-6)[..., None]
    between = mean - beside
    position = ((picture - beside) * between).sum(axis=-1) / np.maximum((between**2).sum(axis=-1), 1e-6)
    # A pixel that is far from the colours of the sky, for what lies beside it, is something else.
    limit = np.maximum(_resized(colors.tolerance, (height, width)), 0.5 * np.linalg.norm(between, axis=-1))
    nearer = np.where(total > 1, position > 0.5, wide) & (away <= limit)
    return np.where(band, nearer, wide)


def _polynomial(levels: NDArray[np.float64], seeds: Mask) -> NDArray[np.float64]:
    """Return the quadratic function of direction that fits the colours of the seeds, limited to their range."""
    x, y, z = np.moveaxis(ray_grid((seeds.shape[0], seeds.shape[1])), -1, 0)
    terms = np.stack([np.ones_like(x), x, y, z, x * x, y * y, x * y, x * z, y * z], axis=-1)
    step = max(1, int(seeds.sum()) // 4000)
    factors = np.linalg.lstsq(terms[seeds][::step], levels[seeds][::step], rcond=None)[0]
    low, high = np.quantile(levels[seeds], [0.01, 0.99], axis=0)
    return np.asarray(np.clip(terms @ factors, low, high))


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
    padded = np.ascontiguousarray(pad_panorama(values.astype(np.float32), radius))
    return np.asarray(cv2.blur(padded, (side, side)))[radius:-radius, radius:-radius]
