"""Refine ranges at the full size of the image files, in strips, in bounded memory.

The dense stages work at a size at which all of their arrays fit into memory. Their result is enlarged, twice at a time,
and refined at each size, as `refine_at_scale` does: ranges move to where the images match best, and pixels without
detail at a size keep the range of the coarser one. A strip holds all columns of some rows, and as many rows more as the
windows and rounds reach; so the result does not depend on the strips. Only the grey levels of the sources are in memory
as a whole, because a strip can be seen anywhere in them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np

from pano_mvs.algorithms.patchmatch.refine import WindowSettings, margin_of_part, refine_part, swept_limits
from pano_mvs.algorithms.scales import EnlargedRangeMap, detail_energy, least_detail
from pano_mvs.algorithms.sweep.preparation import pixels_with_valid_window
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap

if TYPE_CHECKING:  # kernels compile on import
    from pano_mvs.algorithms.patchmatch.kernels_match import Sources

STRIP_ROWS = 128
"""Rows that are refined together."""

# Detail is measured up to this many rows away, in pictures that are halved.
_DETAIL_MARGIN = 16
# Noise is measured at every such row and column.
_NOISE_STEP = 4


def widths_between(width: int, full: int) -> list[int]:
    """Return the widths at which ranges of a width are refined, up to the full one; [] if they have it already."""
    found: list[int] = []
    while full > width:
        found.insert(0, full)
        full = full // 8 * 4
        # Sizes differ by this factor or more.
        if full < 1.5 * width:
            break
    return found


def sources_in_grey(
    pictures: Iterable[tuple[Picture, Mask]],
    *,
    sizes_hw: Sequence[tuple[int, int]],
    source_from_reference: Sequence[Rigid3],
    settings: WindowSettings,
) -> Sources:
    """Return the sources for `refine_part` in two bytes a pixel; one picture is loaded at a time.

    `pictures`: (Hs, Ws, 3) uint8 RGB of each source, and the pixels, (Hs, Ws), that are not ignored. `sizes_hw`: their
    sizes. `source_from_reference`: pose of each source relative to the reference.
    """
    from pano_mvs.algorithms.patchmatch.kernels_match import pad_grey  # compiles on import

    shapes = np.array([(height, width, width + 2) for height, width in sizes_hw])
    ends = np.cumsum([(height + 2) * (width + 2) for height, width in sizes_hw])
    starts = np.array([0, *ends[:-1]])
    grey = np.empty(int(ends[-1]), np.uint16)
    each = iter(pictures)
    for (height, width), start, end in zip(sizes_hw, starts, ends, strict=True):
        picture, mask = next(each)
        reach = ceil(settings.reach * height / sizes_hw[0][0])
        votes = mask if mask.all() else pixels_with_valid_window(mask, reach)
        pad_grey(picture, votes, grey[start:end].reshape(height + 2, width + 2))
        del picture, mask, votes  # before the next ones are loaded
    matrices = np.stack([np.column_stack([pose.rotation, pose.translation]) for pose in source_from_reference])
    return grey, starts, shapes, matrices, np.zeros(0, np.uint8), starts


def refine_in_strips(
    range_map: RangeMap,
    reference: Picture,
    sources: Sources,
    *,
    source_from_reference: Sequence[Rigid3],
    rounds: int,
    view_weights: bool,
    strip_rows: int = STRIP_ROWS,
    **windows: Any,
) -> Iterator[RangeMap]:
    """Yield the ranges of a panorama, from the top, refined from those of a smaller one.

    `range_map`: (h, w). `reference`: (H, W, 3) uint8 RGB, H > h. `sources`: see `sources_in_grey`.
    `source_from_reference`: pose of each source relative to the reference. `rounds`, `view_weights`, `windows`: as of
    `refine_range`. `strip_rows`: rows of a strip, a multiple of 4; the result does not depend on it.

    Returns:
        Strips with the confidences, uncertainties and sky of the nearest pixels of `range_map`, without normals.

    Raises:
        UsageError: if the reference is not larger than the range map, or its height is odd.
    """
    height, width = reference.shape[:2]
    if height <= range_map.range.shape[0] or height % 2:
        raise UsageError(
            f"the reference must be larger than its range map {range_map.range.shape}, with an even number of rows, "
            f"got {reference.shape}"
        )
    settings = WindowSettings(**windows)
    enlarged = EnlargedRangeMap(range_map, (height, width))
    margin = max(margin_of_part(rounds, settings.window), _DETAIL_MARGIN) + 3 & ~3
    least = _least_detail(reference, strip_rows)
    numbers, limits = settings.numbers(width, source_from_reference), swept_limits(range_map)
    for rows, around in _strips(height, strip_rows, margin):
        start, picture = enlarged.rows(around), reference[around]
        refined = refine_part(
            start,
            picture,
            sources,
            numbers=numbers,
            window=settings.window,
            rounds=rounds,
            view_weights=view_weights,
            limits=limits,
            part=(around.start, height),
        )
        ranges = np.where(detail_energy(picture) < least, start.range, refined.range)
        inner = slice(rows.start - around.start, rows.stop - around.start)
        yield RangeMap(
            np.ascontiguousarray(ranges[inner]),
            start.confidence[inner],
            uncertainty=None if start.uncertainty is None else start.uncertainty[inner],
            sky=None if start.sky is None else start.sky[inner],
        )


def enlarged_strips(range_map: RangeMap, size_hw: tuple[int, int]) -> Iterator[RangeMap]:
    """Yield the ranges of a panorama, from the top, as `refine_in_strips` does, without refining them."""
    enlarged = EnlargedRangeMap(range_map, size_hw)
    for rows, _ in _strips(size_hw[0], STRIP_ROWS, 0):
        yield enlarged.rows(rows)


def _strips(height: int, strip_rows: int, margin: int) -> Iterator[tuple[slice, slice]]:
    """Yield the rows of each strip, and those with its margins."""
    for first in range(0, height, strip_rows):
        last = min(first + strip_rows, height)
        # A last strip that is narrow has more margin above it, as windows at a pole need some rows.
        yield slice(first, last), slice(max(min(first, height - strip_rows) - margin, 0), min(last + margin, height))


def _least_detail(reference: Picture, strip_rows: int) -> float:
    """Return the energy of detail that is above the noise, from some of the pixels below 45° of elevation."""
    height = reference.shape[0]
    some = []
    for rows, around in _strips(height, strip_rows, _DETAIL_MARGIN):
        energy = detail_energy(reference[around])[rows.start - around.start : rows.stop - around.start]
        places = np.arange(rows.start, rows.stop)
        wanted = (places >= height // 4) & (places < height - height // 4) & (places % _NOISE_STEP == 0)
        some.append(energy[wanted, ::_NOISE_STEP])
    return least_detail(np.concatenate(some))


def joined_strips(strips: Iterable[RangeMap]) -> RangeMap:
    """Return one range map of all strips."""
    parts = list(strips)
    known = [part.uncertainty for part in parts if part.uncertainty is not None]
    skies = [part.sky for part in parts if part.sky is not None]
    return RangeMap(
        np.concatenate([part.range for part in parts]),
        np.concatenate([part.confidence for part in parts]),
        uncertainty=np.concatenate(known) if known else None,
        sky=np.concatenate(skies) if skies else None,
    )
