"""Remove small isolated surfaces from a range map."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import pixel_solid_angle
from pano_mvs.scene import RangeMap


@checks_settings
def remove_speckles(
    range_map: RangeMap,
    *,
    max_size_px: Annotated[float, Setting("remove smaller surfaces; area in pixels at the equator", gt=0)] = 60.0,
    max_relative_step: Annotated[float, Setting("maximum relative step between pixels of one surface", gt=0)] = 0.03,
) -> RangeMap:
    """Remove connected surfaces up to a given solid angle.

    Adjacent pixels (across the seam and the poles) belong to one surface if their ranges differ by at most
    `max_relative_step`. The size of a surface is the sum of its pixels' solid angles.

    Args:
        range_map: (H, W) with even W, the full sphere.

    Raises:
        UsageError: if a limit is out of bounds.
    """
    from pano_mvs.algorithms.filters.kernels_fill import label_surfaces  # compiles on import

    height, width = range_map.range.shape
    # Copied, since the kernel is compiled once more for arrays that are read-only.
    labels = label_surfaces(np.array(range_map.range, order="C"), max_relative_step)
    seen = labels >= 0
    equator_px = pixel_solid_angle((height, width)) * height * width / (2 * np.pi**2)
    sizes = np.bincount(labels[seen], weights=np.repeat(equator_px, width)[seen], minlength=height * width)
    small = seen & (sizes[np.maximum(labels, 0)] <= max_size_px)
    removed = small.reshape(height, width)
    ranges: NDArray[np.float32] = np.where(removed, np.float32(np.nan), range_map.range)
    return with_ranges(range_map, ranges, np.where(removed, np.uint8(0), range_map.confidence))
