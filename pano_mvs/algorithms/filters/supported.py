"""Find unconfirmed pixels that belong to a confirmed surface: those with its range and colour right beside it.

Like hysteresis in an edge detector, a low confidence is enough next to a high one. A solver that treats all unconfirmed
pixels alike pulls the background beside a thin object onto the object, and the object onto the background.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.panoramas import contrast_around, largest_channel
from pano_mvs.core.arrays import Mask
from pano_mvs.geometry import pad_panorama
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import WEAK_CONFIDENCE

_RADIUS = 2


def supported_pixels(range_map: RangeMap, guide: NDArray[np.uint8], *, min_confidence: int) -> Mask:
    """Return the weak pixels, (H, W), that a confirmed neighbour supports.

    A pixel is supported if its surroundings of 5×5 pixels have texture and contain a confirmed pixel that differs by
    less than 2 % in range and by less than 20 grey levels in colour.

    `range_map`: (H, W), the full sphere. `guide`: (H, W, 3) RGB panorama. `min_confidence`: smallest confidence of
    confirmed pixels.
    """
    weak = (range_map.confidence >= WEAK_CONFIDENCE[0]) & (range_map.confidence < min_confidence)
    supported = np.zeros_like(weak)
    if not (range_map.confidence >= min_confidence).any():
        return supported
    rows, columns = np.nonzero(weak & has_texture(guide))
    ranges = pad_panorama(
        np.where(range_map.confidence >= min_confidence, range_map.range, np.float32(np.nan)), _RADIUS
    )
    colors = pad_panorama(guide, _RADIUS).astype(np.int16)
    own, color = range_map.range[rows, columns], guide[rows, columns].astype(np.int16)
    for row in range(2 * _RADIUS + 1):
        for column in range(2 * _RADIUS + 1):
            with np.errstate(invalid="ignore"):
                # Neighbours of one surface differ by less than this share of their range, and by fewer grey levels in
                # every colour.
                same = np.abs(ranges[rows + row, columns + column] - own) < 0.02 * own
            same &= largest_channel(np.abs(colors[rows + row, columns + column] - color)) < 20
            supported[rows[same], columns[same]] = True
    return supported


def has_texture(guide: NDArray[np.uint8]) -> Mask:
    """Return the pixels, (H, W), around which a colour has contrast."""
    # Without as many grey levels between the darkest and the brightest pixel of the window, ranges agree by chance.
    return contrast_around(guide, _RADIUS) >= 16
