"""The resolutions at which a panorama is matched.

Consumer panoramas are often softer than their number of pixels suggests. A window of a few pixels then shows blur,
noise and compression artefacts, and matches worse than the same window at half the resolution. So ranges are measured
at the resolution at which the panorama is sharp, and brought back to the nominal one.

The more pixels a panorama has, the smaller is the surface that a window of a few pixels covers. On surfaces with little
texture, it contains nothing but noise, although the same surface has texture at half the resolution. So panoramas of
many pixels are matched at several resolutions, and what contains no detail at one of them keeps the range of the next
coarser one.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import filtered, reduced_mask, reduced_panorama
from pano_mvs.core.arrays import FloatImage, Mask, Picture
from pano_mvs.geometry import pad_panorama
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import WEAK_CONFIDENCE

_BLOCK_PX = 16
_MAX_HALVINGS = 2
# Pixels on one surface differ by less than this share of their range.
_SURFACE_STEP = 0.025


def sharp_halvings(picture: Picture) -> int:
    """Return how often a panorama can be halved before it loses detail: 0 if it is sharp at its own size.

    A panorama that is not sharp at half its size either is halved again. In natural images, the contrast of details
    falls slowly with their size (D. J. Field, "Relations between the statistics of natural images and the response
    properties of cortical cells", 1987): the finest detail of a sharp image has more than half of the contrast of the
    next coarser one. Blur removes the finest detail first.

    `picture`: (H, W, 3) uint8 RGB. Rows above and below 45° of elevation are ignored, since they are stretched.

    Returns:
        0, 1 or 2; the reduced panorama has at least 512 columns.
    """
    height, width = picture.shape[:2]
    details = _details(picture)
    contrast = [_relative_detail(fine, coarse) for fine, coarse in pairwise(details)]
    for halvings in range(_MAX_HALVINGS):
        factor = 2 << halvings
        # Panoramas are not reduced below this width.
        is_small = height % factor or width % (2 * factor) or width < factor * 512
        # The contrast of the detail between two resolutions over that of the detail between the lower one and the next:
        # 0.6 to 0.9 for sharp pictures, 0.3 after a blur of a pixel. After more blur, noise hides that the finest
        # detail is gone; but then little is left of the next one, too.
        if is_small or (contrast[halvings] >= 0.3 and contrast[halvings + 1] >= 0.4):
            return halvings
    return _MAX_HALVINGS


def reduced(pictures: list[Picture], masks: list[Mask], *, halvings: int) -> tuple[list[Picture], list[Mask]]:
    """Return panoramas and masks that are no wider than the first one halved a number of times; all as is for 0."""
    if not halvings:
        return pictures, masks
    width = pictures[0].shape[1] >> halvings
    return [reduced_panorama(one, width) for one in pictures], [reduced_mask(one, width) for one in masks]


def enlarged_range_map(range_map: RangeMap, size_hw: tuple[int, int]) -> RangeMap:
    """Return a range map at a multiple of its size, without normals; the same map if it has that size already.

    1/range is linear between pixels of one surface; elsewhere, the nearest pixel counts.
    """
    if range_map.range.shape == size_hw:
        return range_map
    factor = size_hw[0] // range_map.range.shape[0]
    nearest = range_map.range.repeat(factor, axis=0).repeat(factor, axis=1)
    padded = pad_panorama((1 / range_map.range).astype(np.float32), 1)
    size = padded.shape[1] * factor, padded.shape[0] * factor
    between = cv2.resize(padded, size, interpolation=cv2.INTER_LINEAR)[factor:-factor, factor:-factor]
    with np.errstate(invalid="ignore", divide="ignore"):
        smooth = 1 / between
        on_surface = np.abs(smooth / nearest - 1) < _SURFACE_STEP
    ranges = np.where(on_surface, smooth, nearest).astype(np.float32)
    return RangeMap(ranges, range_map.confidence.repeat(factor, axis=0).repeat(factor, axis=1))


class EnlargedRangeMap:
    """A range map at a larger size, not only a multiple of its own, some rows at a time; as `enlarged_range_map`.

    Uncertainties and the sky are those of the nearest pixels.
    """

    def __init__(self, range_map: RangeMap, size_hw: tuple[int, int]) -> None:
        self._map, self._size_hw = range_map, size_hw
        self._inverse = pad_panorama((1 / range_map.range).astype(np.float32), 1)

    def rows(self, rows: slice) -> RangeMap:
        """Return some rows."""
        places = np.arange(rows.start, rows.stop), np.arange(self._size_hw[1])
        shares = [small / large for small, large in zip(self._map.range.shape, self._size_hw, strict=True)]
        at = np.ix_(
            *(
                (2 * place + 1) * small // (2 * large)
                for place, small, large in zip(places, self._map.range.shape, self._size_hw, strict=True)
            )
        )
        (above, down), (left, across) = (_between(place, share) for place, share in zip(places, shares, strict=True))
        upper, lower = self._inverse[above], self._inverse[above + 1]
        column = upper + (lower - upper) * down[:, None]
        between = column[:, left] + (column[:, left + 1] - column[:, left]) * across
        nearest = self._map.range[at]
        with np.errstate(invalid="ignore", divide="ignore"):
            smooth = 1 / between
            on_surface = np.abs(smooth / nearest - 1) < _SURFACE_STEP
        uncertainty, sky = self._map.uncertainty, self._map.sky
        return RangeMap(
            np.where(on_surface, smooth, nearest).astype(np.float32),
            self._map.confidence[at],
            uncertainty=None if uncertainty is None else uncertainty[at],
            sky=None if sky is None else sky[at],
        )


def _between(places: NDArray[np.int64], share: float) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return the pixel before each place in an array with one pixel more at the front, and the part to the next."""
    exact = (places + 0.5) * share + 0.5
    before = np.floor(exact)
    return before.astype(np.int64), (exact - before).astype(np.float32)


def reduced_range_map(range_map: RangeMap, *, halvings: int) -> RangeMap:
    """Return a range map at a fraction of its size, without normals.

    A pixel gets the mean of 1/range of its pixels if they are on one surface, otherwise their median (the farther one
    of two), and the highest of their confidences.
    """
    factor = 1 << halvings
    height, width = range_map.range.shape
    blocks = (height // factor, factor, width // factor, factor)
    inverse = np.moveaxis((1 / range_map.range).reshape(blocks), 1, 2).reshape(*blocks[::2], factor**2)
    inverse = np.sort(inverse, axis=-1)  # NaN last
    count = np.isfinite(inverse).sum(axis=-1, keepdims=True)
    middle = np.take_along_axis(inverse, np.maximum(count - 1, 0) // 2, axis=-1)[..., 0]
    farthest = np.take_along_axis(inverse, np.maximum(count - 1, 0), axis=-1)[..., 0]
    mean = np.nansum(inverse, axis=-1) / np.maximum(count[..., 0], 1)
    smooth = farthest <= inverse[..., 0] * (1 + _SURFACE_STEP)
    confidence = np.moveaxis(range_map.confidence.reshape(blocks), 1, 2).reshape(*blocks[::2], factor**2).max(axis=-1)
    return RangeMap((1 / np.where(smooth, mean, middle)).astype(np.float32), confidence)


def _details(picture: Picture) -> list[FloatImage]:
    """Return the detail that each halving removes, around the equator; two more than the number of halvings allowed."""
    height = picture.shape[0]
    grey = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)[height // 4 : height - height // 4].astype(np.float32)
    details = []
    for _ in range(_MAX_HALVINGS + 2):
        details.append(finest_detail(grey))
        grey = _halved(grey)
    return details


def finest_detail(grey: FloatImage) -> FloatImage:
    """Return the detail of an image (H, W) that is lost if it is halved."""
    enlarged = cv2.resize(_halved(grey), grey.shape[::-1], interpolation=cv2.INTER_CUBIC)
    return np.asarray(grey - enlarged, np.float32)


def _halved(grey: FloatImage) -> FloatImage:
    size = max(1, grey.shape[1] // 2), max(1, grey.shape[0] // 2)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.float32)


def _relative_detail(fine: FloatImage, coarse: FloatImage) -> float:
    """Return the contrast of the finer detail over that of the coarser one, where the coarser one is strongest."""
    finer, coarser = _energy(fine, 2 * _BLOCK_PX), _energy(coarse, _BLOCK_PX)
    if not finer.size or not coarser.size:
        return 1.0
    shape = np.minimum(finer.shape, coarser.shape)
    finer, coarser = finer[: shape[0], : shape[1]], coarser[: shape[0], : shape[1]]
    # Details are compared where the picture has most texture, because elsewhere they are noise.
    textured = coarser >= np.quantile(coarser, 1 - 0.25)
    energy = float(coarser[textured].mean())
    # The plainest blocks contain nothing but noise.
    noise = float(np.quantile(finer, 0.1))
    return float(np.sqrt(max(float(finer[textured].mean()) - noise, 0.0) / energy)) if energy > 0 else 1.0


def _energy(detail: FloatImage, side: int) -> FloatImage:
    """Return the mean square of each block of `side` × `side` pixels."""
    rows, columns = detail.shape[0] // side, detail.shape[1] // side
    blocks = np.square(detail[: rows * side, : columns * side]).reshape(rows, side, columns, side)
    return np.asarray(blocks.mean(axis=(1, 3)), np.float32)


_RADIUS_PX = 7
"""Detail is measured within this many pixels."""

_LEAST_NOISE = 0.2
"""Pixels with less noise, in grey levels, are overexposed or painted."""


def coarser_levels(size_hw: tuple[int, int]) -> int:
    """Return how often a panorama can be halved to 1024 columns or more, at most three times."""
    height, width = size_hw
    levels = 0
    # At fewer columns, a window of a few pixels spans several degrees: furniture melts into blobs.
    while levels < 3 and width >> (levels + 1) >= 1024 and not (height | width) & (1 << levels):
        levels += 1
    return levels


def without_detail(picture: Picture) -> Mask:
    """Return the pixels, (H, W), around which the finest detail of a panorama (H, W, 3) is not above its noise."""
    height = picture.shape[0]
    if min(picture.shape[:2]) <= 2 * _RADIUS_PX:
        return np.zeros(picture.shape[:2], np.bool_)
    energy = detail_energy(picture)
    return np.asarray(energy < least_detail(energy[height // 4 : height - height // 4]))


def detail_energy(picture: Picture) -> FloatImage:
    """Return the mean square of the finest detail around each pixel, (H, W), of a panorama or rows of it (H, W, 3)."""
    detail = finest_detail(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32))
    side = 2 * _RADIUS_PX + 1
    return filtered(detail * detail, _RADIUS_PX, lambda padded: cv2.blur(padded, (side, side)))


def least_detail(around_equator: FloatImage) -> float:
    """Return the `detail_energy` that is above the noise, from that of pixels below 45° of elevation."""
    noisy = around_equator[around_equator >= _LEAST_NOISE**2]
    # The plainest pixels contain only noise; what is less than three times the noise is noise.
    noise = float(np.quantile(noisy, 0.05)) if noisy.size else _LEAST_NOISE**2
    return 3.0**2 * noise


def with_coarser(fine: RangeMap, coarse: RangeMap, picture: Picture) -> RangeMap:
    """Return a range map with the ranges, confidences and normals of a coarser one where the picture has no detail.

    `fine`: (H, W). Filled and invalid pixels do not change. `coarse`: its size is a fraction of H and W. Pixels that it
    has no range for keep the fine one. `picture`: (H, W, 3) uint8 RGB of the fine one.
    """
    enlarged = enlarged_range_map(coarse, (picture.shape[0], picture.shape[1]))
    seen = fine.confidence >= WEAK_CONFIDENCE[0]
    plain = without_detail(picture) & enlarged.valid & seen
    normals = fine.normals_in_cam
    if normals is not None and coarse.normals_in_cam is not None:
        factor = len(plain) // len(coarse.range)
        normals = np.where(
            plain[..., None], coarse.normals_in_cam.repeat(factor, axis=0).repeat(factor, axis=1), normals
        )
    return RangeMap(
        np.where(plain, enlarged.range, fine.range),
        np.where(plain, enlarged.confidence, fine.confidence),
        normals,
        sky=fine.sky,
    )


def ranges_of_levels(levels: int, picture_at: Callable[[int], Picture], measure: Callable[[int], RangeMap]) -> RangeMap:
    """Return the ranges of all levels in one map.

    `levels`: number of coarser levels. `picture_at`: returns the panorama, halved a number of times. `measure`: returns
    its ranges.
    """
    found = measure(levels)
    for halvings in reversed(range(levels)):
        found = with_coarser(measure(halvings), found, picture_at(halvings))
    return found
