"""Detect areas of one colour, as left by stitchers, crops or logos."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.masks.areas import large_areas
from pano_mvs.algorithms.panoramas import squarely_dilated
from pano_mvs.core.arrays import Mask
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings


@checks_settings
def areas_of_color(
    picture: NDArray[np.uint8],
    color_rgb: tuple[int, int, int],
    *,
    tolerance: Annotated[int, Setting("maximum difference of a channel, in grey levels", ge=0, le=255)] = 8,
    min_area_deg2: Annotated[float, Setting("minimum size of an area, in square degrees", ge=0)] = 4.0,
    margin_px: Annotated[int, Setting("width in pixels by which areas are dilated", ge=0, le=64)] = 2,
) -> Mask:
    """Return the pixels, (H, W), of large connected areas of one colour, across the seam and the poles.

    Args:
        picture: (H, W, 3) uint8 RGB, the full sphere.
        color_rgb: the colour.

    Raises:
        UsageError: if the image is not an (H, W, 3) uint8 array, or a setting is out of bounds.
    """
    if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
        raise UsageError(f"an image must be (H, W, 3) uint8, got {picture.shape} {picture.dtype}")
    alike = np.asarray((np.abs(picture.astype(np.int16) - np.array(color_rgb, np.int16)) <= tolerance).all(axis=-1))
    if not alike.any():
        return alike
    return squarely_dilated(large_areas(alike, min_area_deg2), min(margin_px, len(alike)))
