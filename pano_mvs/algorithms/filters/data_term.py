"""What the filters that smooth within the surfaces of a panorama have in common: their guide and their data term."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.confidence import confidence_weight
from pano_mvs.algorithms.filters.settings import Domain
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.scene import RangeMap


def require_guide(guide: NDArray[np.uint8], range_map: RangeMap) -> None:
    """Check that a guide is a panorama of the size of its range map.

    Raises:
        UsageError: if it is not (H, W, 3) uint8.
    """
    height, width = range_map.range.shape
    if guide.shape != (height, width, 3) or guide.dtype != np.uint8:
        raise UsageError(
            f"the guide must be ({height}, {width}, 3) uint8 like the range map, got {guide.shape} {guide.dtype}"
        )


def data_term(range_map: RangeMap, domain: Domain) -> tuple[FloatArray, FloatArray]:
    """Return the values to smooth and their weights, (H, W) each; both are 0 where the range is invalid.

    Args:
        range_map: (H, W) with a valid pixel.
        domain: "inverse": the values are 1/range; "range": ranges.

    Returns:
        The values, and `confidence_weight` relative to the largest weight of the map.
    """
    valid = range_map.valid
    target = np.zeros(valid.shape)
    target[valid] = range_map.range[valid]
    if domain == "inverse":
        target[valid] = 1 / target[valid]
    weight = np.where(valid, confidence_weight(range_map.confidence), 0.0)
    weight /= weight.max()
    return target, weight
