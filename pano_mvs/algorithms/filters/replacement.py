"""Replace the ranges of a range map."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.uncertainty import replaced_uncertainty
from pano_mvs.scene import RangeMap


def with_ranges(
    range_map: RangeMap, ranges: NDArray[np.float32], confidence: NDArray[np.uint8] | None = None
) -> RangeMap:
    """Return a range map with other ranges (H, W), and other confidences if given.

    Normals are kept where the range did not change; for the uncertainty see `replaced_uncertainty`. The sky gets no
    range.
    """
    confidence = range_map.confidence if confidence is None else confidence
    if range_map.sky is not None:
        ranges = np.where(range_map.sky, np.float32(np.nan), ranges)
        confidence = np.where(range_map.sky, np.uint8(0), confidence)
    normals = range_map.normals_in_cam
    if normals is not None:
        normals = normals.copy()
        normals[ranges != range_map.range] = np.nan
    uncertainty = replaced_uncertainty(range_map, ranges, confidence)
    return RangeMap(ranges, confidence, normals, uncertainty, range_map.sky)
