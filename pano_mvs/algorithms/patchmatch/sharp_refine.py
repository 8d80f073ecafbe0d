"""Refine ranges by slanted planes, first at the resolution at which the panorama is sharp."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.patchmatch.refine import refine_range
from pano_mvs.algorithms.sharp_scale import enlarged_range_map, reduced, reduced_range_map
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import WEAK_CONFIDENCE

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# After the reduced size, rounds at the panorama's own size place the edges.
_FINAL_ROUNDS = 2


def refine_at_scale(
    range_map: RangeMap,
    reference: Picture,
    sources: Sequence[Picture],
    *,
    source_from_reference: Sequence[Rigid3],
    halvings: int,
    source_masks: Sequence[Mask],
    rounds: int,
    **settings: Any,
) -> RangeMap:
    """Refine ranges at a reduced size, where a window spans more of a soft panorama, and then at its own size.

    Args:
        range_map: as of `refine_range`, likewise the following arguments and the result.
        reference: (H, W, 3) uint8 RGB; 2^halvings divides H and W.
        sources: one or more (Hs, Ws, 3) uint8 RGB.
        source_from_reference: pose of each source relative to the reference.
        halvings: how often the reference is halved for the first rounds; 0: all rounds at its own size.
        source_masks: for each source (Hs, Ws), False where it is ignored.
        rounds: number of rounds at the reduced size; at most two follow at the panorama's own size.
        settings: other settings of `refine_range`.
    """
    settings = {**settings, "source_from_reference": source_from_reference}
    if not halvings:
        return refine_range(range_map, reference, sources, source_masks=source_masks, rounds=rounds, **settings)
    everything = np.ones(reference.shape[:2], np.bool_)
    small, masks = reduced([reference, *sources], [everything, *source_masks], halvings=halvings)
    reduced_map = reduced_range_map(range_map, halvings=halvings)
    coarse = refine_range(reduced_map, small[0], small[1:], source_masks=masks[1:], rounds=rounds, **settings)
    height, width = range_map.range.shape
    enlarged = enlarged_range_map(coarse, (height, width)).range
    seen = (range_map.confidence >= WEAK_CONFIDENCE[0]) & np.isfinite(enlarged)
    start = RangeMap(np.where(seen, enlarged, range_map.range).astype(np.float32), range_map.confidence)
    rounds = min(rounds, _FINAL_ROUNDS)
    return refine_range(start, reference, sources, source_masks=source_masks, rounds=rounds, **settings)
