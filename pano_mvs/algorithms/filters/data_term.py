"""What filters have in common: their settings, their guide, the weights of confidences, and the data term."""

from __future__ import annotations

from typing import Annotated, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, FILLED_CONFIDENCE, WEAK_CONFIDENCE

Window: TypeAlias = Annotated[int, Setting("side length in pixels, odd", ge=3, le=15, odd=True)]
Domain: TypeAlias = Annotated[Literal["range", "inverse"], Setting("quantity to smooth: range or 1/range")]
MaxHoleDeg: TypeAlias = Annotated[
    float, Setting("larger holes, such as a sky, are not filled (diameter of a disc); 0: fill all", ge=0)
]


def confidence_weight(confidence: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the weight of the data term, in [0, 1], for each confidence c.

    c / 255 for consistent pixels (128–255), 0.01 c / 127 for weak ones (64–127), and a twentieth of that, with c / 63,
    for filled ones (3–63). Weak pixels that no view confirms are wrong so often that a larger weight does more harm
    than good.
    """
    filled, weak = FILLED_CONFIDENCE[1], WEAK_CONFIDENCE[1]
    c = confidence.astype(np.float64)
    # Tuned on range maps of our sweep after the consistency check, of two scenes; any value from 0.03 to 0.003 works.
    seen = np.where(confidence > weak, c / CONSISTENT_CONFIDENCE[1], 0.01 * c / weak)
    weight: NDArray[np.float64] = np.where(confidence > filled, seen, 0.0005 * c / filled)
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

    Raises:
        UsageError: if min_confidence is out of bounds.
    """
    kept = range_map.confidence >= min_confidence
    ranges: NDArray[np.float32] = np.where(kept, range_map.range, np.float32(np.nan))
    return with_ranges(range_map, ranges, np.where(kept, range_map.confidence, np.uint8(0)))


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

    `range_map`: (H, W) with a valid pixel. `domain`: "inverse": the values are 1/range; "range": ranges.

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
