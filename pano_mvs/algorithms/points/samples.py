"""Sample the surfaces that one view sees, evenly over its sphere."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import pixel_from_ray, ray_from_pixel, spiral_rays
from pano_mvs.scene import RangeMap
from pano_mvs.scene.surfaces import SurfaceSamples


@checks_settings
def sample_surface(
    image: NDArray[np.uint8],
    valid: NDArray[np.bool_],
    range_map: RangeMap,
    *,
    count: Annotated[int, Setting("number of evenly spread directions to sample in each view", ge=1)] = 80_000,
    min_confidence: Annotated[int, Setting("minimum confidence of ranges (128: consistent)", ge=1, le=255)] = 128,
) -> SurfaceSamples:
    """Return points of the surfaces that a view sees, one for each of `count` evenly spread directions.

    The density of samples is uniform on the sphere; a point is on the ray through its pixel's centre. Directions that
    are masked or have no range of sufficient confidence give no point, and no pixel gives two.

    Args:
        image: (H, W, 3) uint8 RGB.
        valid: (H, W) bool; False is ignored.
        range_map: of the same size.
        count: number of directions.
        min_confidence: minimum confidence of ranges; from 128 on, other views confirm them.

    Raises:
        UsageError: if the sizes differ.
    """
    size_hw = (range_map.range.shape[0], range_map.range.shape[1])
    if image.shape[:2] != size_hw or valid.shape != size_hw:
        raise UsageError(f"image {image.shape[:2]}, mask {valid.shape} and range map {size_hw} differ in size")
    whole = np.floor(pixel_from_ray(spiral_rays(count), size_hw)).astype(np.intp)
    row, column = np.minimum(whole[:, 1], size_hw[0] - 1), whole[:, 0] % size_hw[1]
    pixels = np.unique(row * size_hw[1] + column)
    row, column = np.divmod(pixels, size_hw[1])
    good = valid[row, column] & (range_map.confidence[row, column] >= min_confidence) & range_map.valid[row, column]
    row, column = row[good], column[good]
    return SurfaceSamples(
        bearings=ray_from_pixel(np.stack([column + 0.5, row + 0.5], axis=-1), size_hw),
        ranges=np.asarray(range_map.range[row, column], np.float32),
        colors_rgb=np.asarray(image[row, column], np.uint8),
        confidence=np.asarray(range_map.confidence[row, column], np.uint8),
    )
