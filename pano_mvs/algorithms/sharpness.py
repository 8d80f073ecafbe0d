"""Sharpness of a panorama, to select the best of several video frames."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_WIDEST = 2048


def sharpness(picture: NDArray[np.uint8]) -> float:
    """Return the sharpness of a panorama: the variance of its Laplacian over that of its grey levels.

    Only a band of 45° around the equator is used: rows near the poles are stretched, and show tripods and sky. The
    division makes frames with different exposure comparable. Only frames of the same scene are comparable.

    `picture`: (H, W, 3) uint8, in any order of the channels; the seam wraps.

    Returns:
        A number that is 0 for an image without structure, and decreases with motion blur and defocus.

    Source: Pech-Pacheco et al., "Diatom autofocusing in brightfield microscopy: a comparative study", ICPR 2000,
    section 2 (variance of the Laplacian).
    """
    height, width = picture.shape[:2]
    band = cv2.cvtColor(picture[height // 4 : height - height // 4], cv2.COLOR_BGR2GRAY)
    if width > _WIDEST:
        band = cv2.resize(band, (_WIDEST, round(band.shape[0] * _WIDEST / width)), interpolation=cv2.INTER_AREA)
    grey = np.pad(band.astype(np.float32), ((0, 0), (1, 1)), mode="wrap")
    contrast = float(grey[:, 1:-1].var())
    if contrast == 0.0:
        return 0.0
    return float(cv2.Laplacian(grey, cv2.CV_32F)[1:-1, 1:-1].var()) / contrast
