"""Detect pixels without a match: the sky, and surfaces without texture, where all ranges cost about the same."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.winner import Winners
from pano_mvs.geometry import pad_panorama

# Grey levels between the darkest and the brightest pixel of a window below which it is bare.
_MIN_CONTRAST = 10
_CONTRAST_RADIUS = 2
# The nearest planes are this share of all.
_NEAREST_SHARE = 0.03
# The last plane is as good as infinitely far if parallax there is less than this.
_MIN_PARALLAX_PX = 1.0


def has_match(winners: Winners, work: SweepInput) -> NDArray[np.bool_]:
    """Return where the winner means something, (H, W).

    Limits lie a little outside the scene, so that few surfaces are at a limit. A pixel that runs to the nearest
    planes or to the last one has no match if its surroundings are bare: a chance decided. (Near planes are blurred, and
    so win on bare walls more often than others.) One that runs to the last plane has none either if that plane looks
    the same as infinity: it is the sky, or something that turns with the camera, and any range beyond the last plane
    but one would do as well. Everything else is kept: what is bare between the limits was filled in from its
    surroundings, mostly rightly.
    """
    planes = work.settings.planes
    last = winners.plane == planes - 1
    first = winners.plane < max(1, round(_NEAREST_SHARE * planes))
    baseline = max(float(np.linalg.norm(pose.translation)) for pose in work.source_from_reference)
    parallax_px = baseline / work.ranges[-1] * work.reference.shape[1] / (2 * np.pi)
    unmatched = (last | first) & is_bare(work.reference)
    if parallax_px < _MIN_PARALLAX_PX:
        unmatched |= last
    return np.asarray(~unmatched)


def is_bare(picture: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Return the pixels, (H, W), around which no colour of a picture (H, W, C) changes enough to be matched."""
    radius = _CONTRAST_RADIUS
    window = np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)
    bare = np.ones(picture.shape[:2], np.bool_)
    for plane in np.moveaxis(picture, -1, 0):
        padded = np.ascontiguousarray(pad_panorama(plane, radius))
        contrast = cv2.dilate(padded, window).astype(np.int16) - cv2.erode(padded, window)
        bare &= contrast[radius:-radius, radius:-radius] < _MIN_CONTRAST
    return bare
