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

    P2' = max(P1, P2 / (1 + (contrast / p2_contrast)ⁿ)), n = 1 or 2, with the largest step of the channels as the
    contrast; beyond a pole and over the seam too.

    Args:
        reference: (H, W, C), the `contrast_picture` of a sweep.
        direction: (rows, columns) of the step, each −1, 0 or 1.
        settings: p1, p2, p2_contrast, p2_falloff.
        rows: of which rows to return them.
    """
    height, width = reference.shape[:2]
    start, stop, _ = rows.indices(height)
    around = padded_channels(reference).astype(np.int16)
    before = around[:, 1 + start - direction[0] : 1 + stop - direction[0], 1 - direction[1] :][:, :, :width]
    contrast = np.abs(around[:, 1 + start : 1 + stop, 1:-1] - before).max(axis=0)
    penalties: NDArray[np.uint16] = penalty_table(settings, height)[contrast]
    return penalties


def padded_channels(reference: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the channels, (H, W, C) to (C, H + 2, W + 2), with a pixel around them beyond poles and seam."""
    return np.stack([pad_panorama(np.ascontiguousarray(channel), 1) for channel in np.moveaxis(reference, -1, 0)])


def penalty_table(settings: SweepSettings, height: int) -> NDArray[np.uint16]:
    """Return P2 for each contrast, (256,) uint16, for a picture of `height` rows."""
    p1, p2 = settings.penalties(height)
    if settings.p2_contrast == 0:
        return np.full(256, p2, np.uint16)
    contrast = np.arange(256) / settings.p2_contrast
    power = {"inverse": 1, "square": 2}[settings.p2_falloff]
    return np.rint(np.maximum(p1, p2 / (1 + contrast**power))).astype(np.uint16)


def warm_up(size_hw: tuple[int, int]) -> tuple[int, int]:
    """Return how many steps a path takes before it counts: beyond the pole, and before the seam.

    A path has no beginning on a sphere. It starts this far before the first pixel that counts, so that what it carries
    there comes from the picture and not from where the columns happen to start.
    """
    height, width = size_hw
    return height // 8, width
