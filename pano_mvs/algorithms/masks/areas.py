"""Areas of pixels on the sphere."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sphere_windows import box_sum
from pano_mvs.core.arrays import Mask
from pano_mvs.geometry import pad_panorama, pixel_solid_angle


def area_labels(pixels: Mask) -> NDArray[np.int64]:
    """Return the connected area of each pixel, across the seam and the poles, (H, W); −1 elsewhere."""
    from pano_mvs.algorithms.filters.kernels_fill import label_surfaces  # compiles on import

    labels = label_surfaces(np.where(pixels, np.float32(1), np.float32(np.nan)), 1.0)
    return np.asarray(labels).reshape(pixels.shape)


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
