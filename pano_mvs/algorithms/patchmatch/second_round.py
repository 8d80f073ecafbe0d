"""Refine plain surfaces again, from the ranges that later filters gave them.

On a surface with little texture, a sweep finds one of many minima, and slanted planes refine only within a fraction of
a pixel of it. Filters that look at more than a window, such as planes on plain walls, often come closer to the right
minimum. There, even a weak texture is enough to confirm and to refine the range. As in ACMP (Q. Xu and W. Tao, "Planar
prior assisted PatchMatch multi-view stereo", AAAI 2020), they are hypotheses, and the match of the images counts.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from pano_mvs.algorithms.filters.replacement import with_ranges
from pano_mvs.algorithms.filters.support.supported import has_texture
from pano_mvs.algorithms.patchmatch.sharp_refine import refine_at_scale
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import WEAK_CONFIDENCE


def refine_plain_surfaces(
    range_map: RangeMap, filtered: RangeMap, reference: Picture, *, sources: Sequence[Picture], **settings: Any
) -> tuple[RangeMap, float]:
    """Refine pixels without texture again, from the ranges of a filtered map, where filters changed them.

    All other pixels keep their ranges: at edges and on thin objects, more rounds only smooth, and ranges that filters
    smoothed across an edge would confirm each other in all views.

    Args:
        range_map: (H, W), refined once, as of `refine_range`.
        filtered: (H, W), the same after the consistency check and filters that keep most confirmed ranges.
        reference: (H, W, 3) uint8 RGB.
        sources: one or more (Hs, Ws, 3) uint8 RGB.
        settings: other arguments of `refine_at_scale`.

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
