"""Match the exposure of source images to the reference, from the surfaces that both see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import filtered
from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_from_pixel, ray_grid, sample_panorama

# A source is looked up between its pixels, which takes contrast away; so far from pixel centres along both axes the
# reference loses as much on average (w (1 − w) is 1/6, its mean), and smoothing leaves little of either.
_BETWEEN_PIXELS, _SMOOTHING_PX = 0.2113, 0.8


@dataclass(frozen=True, eq=False)
class Exposure:
    """reference ≈ gain · source + offset."""

    gain: NDArray[np.float64]  # (C,) float64 for each colour
    offset: NDArray[np.float64]  # (C,) float64 in grey levels

    def apply(self, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return the picture as the reference's exposure would have shown it, (H, W, C)."""
        levels = np.arange(256)[:, None] * self.gain + self.offset
        table = np.asarray(np.clip(np.rint(levels), 0, 255), dtype=np.uint8)
        return np.stack([table[picture[..., c], c] for c in range(picture.shape[-1])], axis=-1)


@dataclass(frozen=True, eq=False)
class KnownPixels:
    """What every source is compared with: pixels of the reference whose range is known roughly.

    `points`: (N, 3) in the reference's frame. `colors`: (N, C) of the reference, smoothed. `cut_off`: (N, 1) how much
    of the colours may have been cut off, 255 is all.
    """

    points: NDArray[np.float64]
    colors: NDArray[np.float64]
    cut_off: NDArray[np.float64]

    @classmethod
    def of(cls, reference: NDArray[np.uint8], ranges: NDArray[np.float32]) -> KnownPixels:
        """Return the pixels of a reference, (H, W, C), with a range, (h, w) at any resolution; NaN is left out."""
        known = np.isfinite(ranges)
        size_hw = reference.shape[0], reference.shape[1]
        pixels = pixel_from_ray(ray_grid((ranges.shape[0], ranges.shape[1]))[known], size_hw)
        pixels = np.floor(pixels) + 0.5 + _BETWEEN_PIXELS
        points = ray_from_pixel(pixels, size_hw) * ranges[known].astype(np.float64)[:, None]
        cut_off = sample_panorama(_smooth(_at_an_end(reference)), pixels)
        return cls(points, sample_panorama(_smooth(reference), pixels), cut_off)


def match_exposure(
    source: NDArray[np.uint8],
    source_from_reference: Rigid3,
    known: KnownPixels,
    *,
    source_mask: NDArray[np.bool_] | None = None,
) -> Exposure:
    """Return the exposure of a source against the reference, robustly, from pixels whose range is known roughly.

    Geman–McClure weights on a straight line through (source, reference) colours for each channel: occluded and wrong
    pixels drop out. Too few pixels, or a fit beyond reason, leave the channel as it is.

    `source`: (Hs, Ws, C) uint8. `source_mask`: (Hs, Ws) False is left out.
    """
    pixels = pixel_from_ray(source_from_reference.apply(known.points), source.shape[:2])
    seen = sample_panorama(_smooth(source), pixels)
    cut_off = sample_panorama(_smooth(_at_an_end(source)), pixels) + known.cut_off
    usable = cut_off[..., 0] < 10.0  # 255 is all
    if source_mask is not None:
        usable &= sample_panorama(source_mask, pixels) > 0.999
    lines = [_robust_line(seen[usable, c], known.colors[usable, c]) for c in range(seen.shape[-1])]
    return Exposure(np.array([gain for gain, _ in lines]), np.array([offset for _, offset in lines]))


def _robust_line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Return the slope and the intercept of y over x; (1, 0) where they cannot be known."""
    if len(x) < 50 or np.std(x) < 1:
        return 1.0, 0.0
    gain, offset = float(np.std(y) / np.std(x)), 0.0
    offset = float(np.median(y - gain * x))
    for _ in range(10):
        residual = y - gain * x - offset
        spread = 1.4826 * float(np.median(np.abs(residual))) + 0.5
        weight = 1 / (1 + (residual / (2 * spread)) ** 2) ** 2
        mean_x, mean_y = np.average(x, weights=weight), np.average(y, weights=weight)
        variance = float(np.sum(weight * (x - mean_x) ** 2))
        if variance < 1e-6 * len(x):
            return 1.0, 0.0
        gain = float(np.sum(weight * (x - mean_x) * (y - mean_y))) / variance
        offset = float(mean_y - gain * mean_x)
    darkest, brightest = np.quantile(x, [0.05, 0.95])
    change = max(abs(gain * level + offset - level) for level in (darkest, brightest))
    # No camera's exposures differ by more; a fit that says so has met moved things or bare walls. A smaller change of
    # all grey levels is ignored: wrong ranges and noise cause as much.
    if not 0.4 < gain < 2.5 or change < 2.0:
        return 1.0, 0.0
    return gain, offset


def _at_an_end(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return 255 where a colour is so dark or so bright that it may have been cut off, (H, W, 1)."""
    at_an_end = np.zeros(picture.shape[:2], np.bool_)
    for c in range(picture.shape[-1]):  # many times as fast as `any` over a short last axis
        at_an_end |= (picture[..., c] <= 3) | (picture[..., c] >= 252)
    return np.where(at_an_end[..., None], np.uint8(255), np.uint8(0))


def _smooth(picture: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return a picture, (H, W, C), in which neither noise nor interpolation makes a difference to speak of."""
    radius = int(np.ceil(3 * _SMOOTHING_PX))
    size = 2 * radius + 1, 2 * radius + 1
    smooth = filtered(picture, radius, lambda padded: cv2.GaussianBlur(padded.astype(np.float32), size, _SMOOTHING_PX))
    return smooth.reshape(picture.shape)


def shrink(picture: NDArray[np.uint8], rows: int) -> NDArray[np.uint8]:
    """Return a picture of at most `rows` rows, made smaller by a whole factor by averaging; (H, W, C)."""
    height, width = picture.shape[:2]
    factor = max(1, height // rows)
    while height % factor or width % (2 * factor):
        factor -= 1
    lines = np.asarray(np.sum([picture[row::factor] for row in range(factor)], axis=0, dtype=np.uint32))
    blocks = np.sum([lines[:, column::factor] for column in range(factor)], axis=0)
    return np.asarray(np.rint(blocks / factor**2), dtype=np.uint8)


def match_all(
    reference: NDArray[np.uint8],
    sources: Sequence[NDArray[np.uint8]],
    source_from_reference: Sequence[Rigid3],
    *,
    ranges: NDArray[np.float32],
    masks: Sequence[NDArray[np.bool_]] | None,
) -> list[NDArray[np.uint8]]:
    """Return all sources in the reference's exposure."""
    known = KnownPixels.of(reference, ranges)
    matched = []
    for idx, (source, pose) in enumerate(zip(sources, source_from_reference, strict=True)):
        mask = None if masks is None else masks[idx]
        matched.append(match_exposure(source, pose, known, source_mask=mask).apply(source))
    return matched
