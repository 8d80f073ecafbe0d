"""Refine plain surfaces again, from the ranges that later filters gave them.

On a surface with little texture, a sweep finds one of many minima, and slanted planes refine only within a fraction of
a pixel of it. Filters that look at more than a window, such as planes on plain walls, often come closer to the right
minimum. There, even a weak texture is enough to confirm and to refine the range. As in ACMP (Q. Xu and W. Tao, "Planar
prior assisted PatchMatch multi-view stereo", AAAI 2020), they are hypotheses, and the match of the images counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from pano_mvs.algorithms.filters.supported import has_texture
from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.algorithms.patchmatch.refine import refine_range
from pano_mvs.algorithms.scales import enlarged_range_map, reduced, reduced_range_map, with_coarser
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.core.errors import UsageError
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

    `range_map`: as of `refine_range`, likewise the following arguments and the result. `reference`: (H, W, 3) uint8
    RGB; 2^halvings and 2^levels divide H and W. `sources`: one or more (Hs, Ws, 3) uint8 RGB. `source_from_reference`:
    pose of each source relative to the reference. `halvings`: how often the reference is halved for the first rounds;
    0: all rounds at its own size. `levels`: number of coarser sizes at which ranges are refined as well, for pixels
    without detail at a finer one. `source_masks`: for each source (Hs, Ws), False where it is ignored. `rounds`: number
    of rounds; after a reduced size, at most two follow at a larger one that is not sharp. `settings`: other settings of
    `refine_range`.
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


def refine_plain_surfaces(
    range_map: RangeMap, filtered: RangeMap, reference: Picture, *, sources: Sequence[Picture], **settings: Any
) -> tuple[RangeMap, float]:
    """Refine pixels without texture again, from the ranges of a filtered map, where filters changed them.

    All other pixels keep their ranges: at edges and on thin objects, more rounds only smooth, and ranges that filters
    smoothed across an edge would confirm each other in all views.

    `range_map`: (H, W), refined once, as of `refine_range`. `filtered`: (H, W), the same after the consistency check
    and filters that keep most confirmed ranges. `reference`: (H, W, 3) uint8 RGB. `sources`: one or more (Hs, Ws, 3)
    uint8 RGB. `settings`: other arguments of `refine_at_scale`.

    Returns:
        The range map, with the confidences that it had and the sky of the filtered map, and the share of its valid
        pixels that were refined again.

    Raises:
        UsageError: if the range maps differ in size, or as `refine_range`.
    """
    if range_map.range.shape != filtered.range.shape:
        raise UsageError(f"both range maps must have one size, got {range_map.range.shape} and {filtered.range.shape}")
    again = plain_and_changed(range_map, filtered, reference)
    start = RangeMap(np.where(again, filtered.range, range_map.range), range_map.confidence, sky=range_map.sky)
    refined = refine_at_scale(start, reference, sources, **settings)
    ranges = np.where(again, refined.range, range_map.range)
    normals = refined.normals_in_cam
    if range_map.normals_in_cam is not None and normals is not None:
        normals = np.where(again[..., None], normals, range_map.normals_in_cam)
    share = float(again.sum() / max(int(range_map.valid.sum()), 1))
    refined = RangeMap(ranges, range_map.confidence, normals, sky=filtered.sky)
    return with_ranges(refined, ranges), share


def plain_and_changed(range_map: RangeMap, filtered: RangeMap, reference: Picture) -> Mask:
    """Return the pixels, (H, W), that were seen, have no texture, and have another range in the filtered map."""
    seen = (range_map.confidence >= WEAK_CONFIDENCE[0]) & filtered.valid
    return np.asarray(seen & (filtered.range != range_map.range) & ~has_texture(reference))
