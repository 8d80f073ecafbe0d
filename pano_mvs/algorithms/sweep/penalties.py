"""Penalties of semi-global matching, and its paths on the sphere, for all backends."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.geometry import pad_panorama

# (rows, columns) of one step of the six paths from pole to pole; the two along a row are handled on their own.
DIRECTIONS = ((1, 0), (1, 1), (1, -1), (-1, 0), (-1, 1), (-1, -1))
_ROWS_AT_ONCE = 256


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
    height, width = reference.shape[:2]
    p1, p2 = settings.penalties(height)
    start, stop, _ = rows.indices(height)
    if settings.p2_contrast == 0:
        return np.full((stop - start, width), p2, np.uint16)
    padded = pad_panorama(reference, 1)
    penalties = np.empty((stop - start, width), np.uint16)
    for first in range(start, stop, _ROWS_AT_ONCE):  # in 64 bits, a whole picture would take a gigabyte at 8192×4096
        last = min(first + _ROWS_AT_ONCE, stop)
        around = padded[first : last + 2].mean(axis=-1)
        before = around[1 - direction[0] : 1 - direction[0] + last - first, 1 - direction[1] : 1 - direction[1] + width]
        contrast = np.abs(around[1:-1, 1:-1] - before)
        penalty = np.maximum(p1, p2 / (1 + contrast / settings.p2_contrast))
        penalties[first - start : last - start] = np.rint(penalty)
    return penalties


def warm_up(size_hw: tuple[int, int]) -> tuple[int, int]:
    """Return how many steps a path takes before it counts: beyond the pole, and before the seam.

    A path has no beginning on a sphere. It starts this far before the first pixel that counts, so that what it carries
    there comes from the picture and not from where the columns happen to start.
    """
    height, width = size_hw
    return height // 8, width
