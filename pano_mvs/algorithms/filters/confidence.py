"""Weights and thresholds of pixel confidences."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.replacement import with_ranges
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE, WEAK_CONFIDENCE

# Tuned on range maps of our sweep after the consistency check, of two scenes; any value from 0.03 to 0.003 works.
_WEAK_WEIGHT, _FILLED_WEIGHT = 0.01, 0.0005


def confidence_weight(confidence: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the weight of the data term, in [0, 1], for each confidence c.

    c / 255 for consistent pixels (128–255), 0.01 c / 127 for weak ones (64–127), and a twentieth of that, with c / 63,
    for filled ones (1–63). Weak pixels that no view confirms are wrong so often that a larger weight does more harm
    than good.
    """
    filled, weak = FILLED_CONFIDENCE[1], WEAK_CONFIDENCE[1]
    c = confidence.astype(np.float64)
    seen = np.where(confidence > weak, c / CONSISTENT_CONFIDENCE[1], _WEAK_WEIGHT * c / weak)
    weight: NDArray[np.float64] = np.where(confidence > filled, seen, _FILLED_WEIGHT * c / filled)
    return weight


@checks_settings
def require_confidence(
    range_map: RangeMap,
    *,
    min_confidence: Annotated[
        int, Setting("minimum confidence; 128: confirmed pixels", ge=1, le=255)
    ] = CONSISTENT_CONFIDENCE[0],
) -> RangeMap:
    """Return a range map with only the pixels of at least this confidence.

    Args:
        range_map: (H, W).
        min_confidence: 128 keeps pixels that other views confirm, 64 all pixels that were seen.

    Raises:
        UsageError: if min_confidence is out of bounds.
    """
    kept = range_map.confidence >= min_confidence
    ranges: NDArray[np.float32] = np.where(kept, range_map.range, np.float32(np.nan))
    return with_ranges(range_map, ranges, np.where(kept, range_map.confidence, np.uint8(0)))
