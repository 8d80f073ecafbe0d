"""Coarse to fine: a sweep at half the resolution restricts the search at full resolution.

1. The pictures at half size are swept at half as many planes (itself coarse to fine for more than two levels).
2. What it found, smoothed within each surface, guides the sweep at full size: every pixel is tried at seven planes
   around its guide, and at seven more around the other surface where two meet within a few pixels.
3. Where the picture has texture but matches at none of these (a rod too thin for half the resolution), tiles are swept
   over all ranges; what matches better there takes the place of one guide.
4. Semi-global matching runs among these candidates, and rides along the guides for free.

Memory: 42 bytes a pixel for costs and sums instead of 3 bytes for each pixel and plane.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.coarse_to_fine.guided import GuidedSweep
from pano_mvs.algorithms.sweep.coarse_to_fine.kernels_guides import split_layers
from pano_mvs.algorithms.sweep.exposure import shrink
from pano_mvs.algorithms.sweep.hypotheses import virtual_ranges
from pano_mvs.algorithms.sweep.numba.threads import workers
from pano_mvs.algorithms.sweep.preparation import SweepInput, pixels_with_valid_window
from pano_mvs.algorithms.sweep.winner import Winners, subplane_offset
from pano_mvs.geometry import pad_panorama

_MIN_ROWS = 64
_MIN_PLANES = 16
_MAX_PENALTY = 4000
# Two surfaces meet where positions within this many coarse pixels differ by more planes.
_SPLIT_RADIUS, _SPLIT_GAP = 2, 6.0


def find_winners_coarse_to_fine(work: SweepInput, *, find_coarsest: Callable[[SweepInput], Winners]) -> Winners:
    """Return the winning candidate of every pixel and the costs around it, close to those of the full sweep.

    Args:
        work: what to sweep.
        find_coarsest: sweeps all planes at the coarsest level, and images that cannot be halved (odd sides, fewer than
            128 rows).
    """
    coarse = _coarse_input(work)
    if coarse is None:
        return find_coarsest(work)
    found = find_winners_coarse_to_fine(coarse, find_coarsest=find_coarsest)
    guides = _guides(found, coarse, work)
    with workers() as pool:
        winners = GuidedSweep(work, guides, pool).find_winners()
    return replace(winners, rival=_rival(winners, found))


def _coarse_input(work: SweepInput) -> SweepInput | None:
    """Return the same sweep at half the size and half the planes, or None if this is the last level."""
    settings, (height, width) = work.settings, work.reference.shape[:2]
    if settings.levels < 2 or height % 2 or width % 4 or height // 2 < _MIN_ROWS:
        return None
    planes = max(min(_MIN_PLANES, settings.planes), -(-settings.planes // 2))
    # A step by one plane is as much longer as there are fewer of them.
    p1 = min(round(settings.p1 * (settings.planes - 1) / (planes - 1)), max(settings.p2, settings.p1), _MAX_PENALTY)
    ranges = virtual_ranges(
        work.ranges[0], work.ranges[-1], planes=planes, spacing=settings.spacing, baseline=work.baseline
    )
    return replace(
        work,
        reference=_halved(work.reference),
        sources=tuple(_halved(source) for source in work.sources),
        source_valid=_halved_masks(work),
        colors=None if work.colors is None else _halved(work.colors),
        ranges=ranges,
        settings=settings.replace(levels=settings.levels - 1, planes=planes, p1=p1),
    )


def _halved(picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return shrink(picture, -(-picture.shape[0] // 2))


def _halved_masks(work: SweepInput) -> tuple[NDArray[np.bool_], ...] | None:
    """Return where sources are valid at half size: a window's radius away from masked pixels."""
    if work.source_valid is None:
        return None
    radius = work.settings.compare_radius + work.settings.box_radius
    halves = [_halved(255 * mask.astype(np.uint8)[..., None])[..., 0] == 255 for mask in work.source_valid]
    return tuple(pixels_with_valid_window(half, -(-radius // 2)) for half in halves)


def _guides(found: Winners, coarse: SweepInput, work: SweepInput) -> NDArray[np.float32]:
    """Return the positions, among the planes of `work`, of the near and the far surface at every pixel, (2, H, W)."""
    position = found.position + subplane_offset(found, planes=coarse.settings.planes, shape="parabola")
    position *= (work.settings.planes - 1) / (coarse.settings.planes - 1)
    layers = np.empty((2, *position.shape), np.float32)
    padded = pad_panorama(position.astype(np.float32), _SPLIT_RADIUS)
    split_layers(padded, _SPLIT_RADIUS, np.float32(_SPLIT_GAP), layers)
    return np.stack([_doubled(layer) for layer in layers])


def _doubled(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a panorama of twice the size, bilinear, over the seam and the poles."""
    height, width = picture.shape
    doubled = cv2.resize(pad_panorama(picture, 1), (2 * width + 4, 2 * height + 4), interpolation=cv2.INTER_LINEAR)
    return np.asarray(doubled[2:-2, 2:-2], dtype=np.float32)


def _rival(winners: Winners, coarse: Winners) -> NDArray[np.float32]:
    """Return the rival's cost, (H, W): among the candidates if it is near, from the coarse sweep if it is far away."""
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.nan_to_num(coarse.rival / coarse.cost, nan=np.inf, posinf=np.inf)
        farther = winners.cost * ratio.repeat(2, axis=0).repeat(2, axis=1)
    return np.asarray(np.fmin(winners.rival, farther), dtype=np.float32)
