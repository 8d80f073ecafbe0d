"""Penalties of semi-global matching, and its paths on the sphere, for all backends."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.geometry import pad_panorama

# (rows, columns) of one step of the six paths from pole to pole; the two along a row are handled on their own.
DIRECTIONS = ((1, 0), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1))


def step_penalties(
    reference: NDArray[np.uint8], direction: tuple[int, int], settings: SweepSettings, *, rows: slice = slice(None)
) -> NDArray[np.uint16]:
    """Return P2 of the step into each pixel, (H, W) uint16: smaller where the picture has an edge.

    P2' = max(P1, P2 / (1 + |ΔI| / contrast)), ΔI the step of the mean colour; beyond a pole and over the seam too.

    Args:
        reference: (H, W, C).
        direction: (rows, columns) of the step, each −1, 0 or 1.
        settings: p1, p2, p2_contrast.
        rows: of which rows to return them.
    """
    height, width, channels = reference.shape
    start, stop, _ = rows.indices(height)
    around = padded_brightness(reference)
    before = around[1 + start - direction[0] : 1 + stop - direction[0], 1 - direction[1] : 1 - direction[1] + width]
    contrast = np.abs(around[1 + start : 1 + stop, 1:-1] - before)
    penalties: NDArray[np.uint16] = penalty_table(settings, height, channels)[contrast]
    return penalties


def padded_brightness(reference: NDArray[np.uint8]) -> NDArray[np.int16]:
    """Return the sum of the colours, (H, W, C) to (H + 2, W + 2), with a pixel around it beyond poles and seam."""
    total = np.zeros(reference.shape[:2], np.int16)
    for channel in range(reference.shape[2]):  # many times as fast as `sum` over a short last axis
        total += reference[..., channel]
    return pad_panorama(total, 1)


def penalty_table(settings: SweepSettings, height: int, channels: int) -> NDArray[np.uint16]:
    """Return P2 for each step of the sum of the colours, (255 C + 1,) uint16, for a picture of `height` rows."""
    p1, p2 = settings.penalties(height)
    contrast = np.arange(255 * channels + 1) / channels
    if settings.p2_contrast == 0:
        return np.full(len(contrast), p2, np.uint16)
    return np.rint(np.maximum(p1, p2 / (1 + contrast / settings.p2_contrast))).astype(np.uint16)


def warm_up(size_hw: tuple[int, int]) -> tuple[int, int]:
    """Return how many steps a path takes before it counts: beyond the pole, and before the seam.

    A path has no beginning on a sphere. It starts this far before the first pixel that counts, so that what it carries
    there comes from the picture and not from where the columns happen to start.
    """
    height, width = size_hw
    return height // 8, width
