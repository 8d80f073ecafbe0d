"""Ranges of several resolutions: each pixel has that of the finest one at which the panorama shows more than noise.

The more pixels a panorama has, the smaller is the surface that a window of a few pixels covers. On surfaces with little
texture, such a window contains nothing but noise and compression artefacts, although the same surface has texture at
half the resolution, where these average out. So panoramas of many pixels are matched at several resolutions, and what
contains no detail at one of them keeps the range of the next coarser one.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

from pano_mvs.algorithms.sharp_scale import enlarged_range_map, finest_detail
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.geometry import pad_panorama
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import WEAK_CONFIDENCE

# At fewer columns, a window of a few pixels spans several degrees: furniture melts into blobs.
_MIN_WIDTH = 1024
_MAX_LEVELS = 3
# Detail is measured within this many pixels; less than this multiple of the noise is noise.
_RADIUS_PX, _DETAIL_OVER_NOISE = 7, 3.0
# The plainest pixels contain only noise. Those with less, in grey levels, are overexposed or painted.
_PLAIN_SHARE, _LEAST_NOISE = 0.05, 0.2


def coarser_levels(size_hw: tuple[int, int]) -> int:
    """Return how often a panorama can be halved to 1024 columns or more, at most three times."""
    height, width = size_hw
    levels = 0
    while levels < _MAX_LEVELS and width >> (levels + 1) >= _MIN_WIDTH and not (height | width) & (1 << levels):
        levels += 1
    return levels


def without_detail(picture: Picture) -> Mask:
    """Return the pixels, (H, W), around which the finest detail of a panorama (H, W, 3) is not above its noise."""
    height = picture.shape[0]
    if min(picture.shape[:2]) <= 2 * _RADIUS_PX:
        return np.zeros(picture.shape[:2], np.bool_)
    detail = finest_detail(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY).astype(np.float32))
    side = 2 * _RADIUS_PX + 1
    energy = cv2.blur(pad_panorama(detail * detail, _RADIUS_PX), (side, side))
    energy = energy[_RADIUS_PX:-_RADIUS_PX, _RADIUS_PX:-_RADIUS_PX]
    around_equator = energy[height // 4 : height - height // 4]
    noisy = around_equator[around_equator >= _LEAST_NOISE**2]
    noise = float(np.quantile(noisy, _PLAIN_SHARE)) if noisy.size else _LEAST_NOISE**2
    return np.asarray(energy < _DETAIL_OVER_NOISE**2 * noise)


def with_coarser(fine: RangeMap, coarse: RangeMap, picture: Picture) -> RangeMap:
    """Return a range map with the ranges, confidences and normals of a coarser one where the picture has no detail.

    Args:
        fine: (H, W). Filled and invalid pixels do not change.
        coarse: its size is a fraction of H and W. Pixels that it has no range for keep the fine one.
        picture: (H, W, 3) uint8 RGB of the fine one.
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

    Args:
        levels: number of coarser levels.
        picture_at: returns the panorama, halved a number of times.
        measure: returns its ranges.
    """
    found = measure(levels)
    for halvings in reversed(range(levels)):
        found = with_coarser(measure(halvings), found, picture_at(halvings))
    return found
