"""How sharp a panorama is, to tell the best of some frames of a video."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

_WIDEST = 2048


def sharpness(picture: NDArray[np.uint8]) -> float:
    """Return how sharp a panorama is: the variance of its Laplacian over that of its grey levels.

    Only the band of 45° around the equator counts: rows near the poles are stretched, and show tripods and skies.
    Dividing makes frames comparable whose exposure differs. Comparable are frames of one scene, not scenes.

    Args:
        picture: (H, W, 3) uint8, any order of the colours; the seam wraps.

    Returns:
        A number that is 0 for a picture without any structure, and falls as motion or defocus blurs it.

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
