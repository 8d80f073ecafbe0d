"""Colours and masks of a face of a panorama."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.faces.sampling import nearest_pixels, sample_view
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import PinholeView, pad_panorama

# Bicubic interpolation uses no pixel farther away than this from the one that contains the position.
_REACH_PX = 2


def face_image(panorama: NDArray[np.uint8], view: PinholeView) -> NDArray[np.uint8]:
    """Render the image of a face, (h, w, 3) uint8 RGB.

    The interpolation is bicubic. If a face is coarser than the panorama, each of its pixels is the average of several
    samples, spaced by at most a pixel of the panorama's equator, so that fine texture does not alias.

    Args:
        panorama: (H, W, 3) uint8 RGB, the full sphere.
        view: the face.

    Raises:
        UsageError: if the panorama is not such an array.
    """
    if panorama.ndim != 3 or panorama.dtype != np.uint8 or panorama.shape[1] % 2:
        raise UsageError(f"a panorama is (H, W, 3) uint8 with even W, got {panorama.shape} {panorama.dtype}")
    return sample_view(panorama, view, samples=_samples(panorama.shape[1], view))


def face_mask(valid: NDArray[np.bool_], view: PinholeView) -> NDArray[np.bool_]:
    """Return the valid pixels of a face, (h, w) bool: pixels of `face_image` without any contribution of masked pixels.

    The mask grows by the two pixels of the interpolation's support, and by the width of a face's pixel.

    Args:
        valid: (H, W) bool of the panorama; False is ignored.
        view: the face.
    """
    if valid.all():
        return np.ones(view.size_hw, np.bool_)
    reach = min(_REACH_PX, *valid.shape)
    window = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    padded = cv2.erode(pad_panorama(valid.astype(np.uint8), reach), window)
    clear = padded[reach:-reach, reach:-reach] > 0
    result = np.ones(view.size_hw, np.bool_)
    samples = _samples(valid.shape[1], view)
    for y in range(samples):
        for x in range(samples):
            offset_xy = ((x + 0.5) / samples, (y + 0.5) / samples)
            result &= clear[nearest_pixels(view, (valid.shape[0], valid.shape[1]), offset_xy=offset_xy)]
    return result


def _samples(width: int, view: PinholeView) -> int:
    """Return the number of samples in each pixel of a face, along each direction."""
    return max(1, int(np.ceil(width / (2 * np.pi) / view.focal_px - 1e-6)))
