"""Refine ranges by slanted planes, first at the resolution at which the panorama is sharp."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pano_mvs.algorithms.patchmatch.refine import refine_range
from pano_mvs.algorithms.plain_scale import with_coarser
from pano_mvs.algorithms.sharp_scale import enlarged_range_map, reduced, reduced_range_map
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import WEAK_CONFIDENCE

# After the reduced size, rounds at the panorama's own size place the edges.
_FINAL_ROUNDS = 2


def refine_at_scale(
    range_map: RangeMap,
    reference: Picture,
    sources: Sequence[Picture],
    *,
    source_from_reference: Sequence[Rigid3],
    halvings: int,
    levels: int = 0,
    source_masks: Sequence[Mask],
    rounds: int,
    **settings: Any,
) -> RangeMap:
    """Refine ranges at a reduced size, where a window spans more of a soft panorama, and then at its own size.

    Args:
        range_map: as of `refine_range`, likewise the following arguments and the result.
        reference: (H, W, 3) uint8 RGB; 2^halvings and 2^levels divide H and W.
        sources: one or more (Hs, Ws, 3) uint8 RGB.
        source_from_reference: pose of each source relative to the reference.
        halvings: how often the reference is halved for the first rounds; 0: all rounds at its own size.
        levels: number of coarser sizes at which ranges are refined as well, for pixels without detail at a finer one.
        source_masks: for each source (Hs, Ws), False where it is ignored.
        rounds: number of rounds; after a reduced size, at most two follow at a larger one that is not sharp.
        settings: other settings of `refine_range`.
    """
    settings = {**settings, "source_from_reference": source_from_reference}
    pictures = [reference, *sources]
    masks = [np.ones(reference.shape[:2], np.bool_), *source_masks]
    found: RangeMap | None = None
    for level in reversed(range(max(halvings, levels) + 1)):
        small, valid = reduced(pictures, masks, halvings=level)
        start, count = reduced_range_map(range_map, halvings=level) if level else range_map, rounds
        if found is not None and level < halvings:
            start, count = _continued(found, start), min(rounds, _FINAL_ROUNDS)
        fine = refine_range(start, small[0], small[1:], source_masks=valid[1:], rounds=count, **settings)
        if found is not None and level < levels:
            fine = replace(with_coarser(fine, found, small[0]), confidence=fine.confidence)
        found = fine
    assert found is not None
    return found


def _continued(coarse: RangeMap, swept: RangeMap) -> RangeMap:
    """Return swept ranges, (H, W), replaced by those that were refined at a smaller size."""
    enlarged = enlarged_range_map(coarse, (swept.range.shape[0], swept.range.shape[1])).range
    seen = (swept.confidence >= WEAK_CONFIDENCE[0]) & np.isfinite(enlarged)
    return RangeMap(np.where(seen, enlarged, swept.range).astype(np.float32), swept.confidence)
