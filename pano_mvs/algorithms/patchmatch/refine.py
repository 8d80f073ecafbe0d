"""Refine a range map by slanted planes: ranges between the depth hypotheses of a sweep, and normals.

A sweep compares fronto-parallel windows at fixed ranges; its result is accurate to a fraction of a plane and biased on
slanted surfaces. Here two steps alternate, the data term and the smoothness term of one energy:

* a plane is fitted robustly to the ranges around each pixel (planes of disparity: Bleyer, Rhemann and Rother,
  "PatchMatch stereo", 2011, section 3; the sphere's counterpart of disparity is the inverse range q, linear in the ray
  on a plane: q = p · d);
* a window on that plane is sampled in the sources through the homography R + t pᵀ of rays, and q is moved to its most
  likely value: a Gauss–Newton step on the zero-mean normalised correlation (Lucas and Kanade, 1981) in q and its two
  slopes, with the plane as a prior whose weight depends on the texture of the images.

Unlike PatchMatch, there is no random search: starting from a sweep there is little to search for, and propagating
planes of neighbours by correlation alone extends the nearer surface across edges that semi-global matching had found
(measured on four scenes). The method is deterministic, so that a rolled panorama gives the rolled result.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import ceil
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.supported import has_texture
from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.algorithms.scales import enlarged_range_map, reduced, reduced_range_map, with_coarser
from pano_mvs.algorithms.sweep.preparation import pixels_with_valid_window
from pano_mvs.algorithms.sweep.windows import column_offsets, column_stretch
from pano_mvs.core.arrays import FloatArray, FloatImage, Mask, Picture
from pano_mvs.core.bands import for_bands
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import Rigid3, pad_panorama, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import WEAK_CONFIDENCE

if TYPE_CHECKING:  # kernels compile on import
    from pano_mvs.algorithms.patchmatch.kernels_match import Sources
    from pano_mvs.algorithms.patchmatch.kernels_refine import Numbers


# Pixels on either side of a pixel whose matches count for it.
_RADIUS = 2
# Share of the rounds before in what is known after a round.
_MEMORY = 0.5


class ViewWeights:
    """The weights of all sources, and what they are made of.

    `views`: (S, H, W) float32. A round replaces it by correlations, −2 where a source does not count; `update` replaces
    these by weights, at most 1, which is that of the best source. `known`: whether `views` holds weights: from the
    first `update` on.
    """

    def __init__(self, sources: int, size_hw: tuple[int, int]) -> None:
        self.views: FloatImage = np.zeros((sources, *size_hw), np.float32)
        self.known = False
        self._match: FloatImage = np.zeros((0, *size_hw), np.float32)

    def update(self) -> None:
        """Replace correlations by weights.

        The match of a source is exp(−(1 − ρ)² / 2σ²), averaged over 5 × 5 pixels, and over the rounds with half of the
        weight for all earlier ones. Weights are the squares of the matches over the best one.
        """
        if not self.known:
            self._match = np.empty_like(self.views)
        for idx, correlation in enumerate(self.views):
            # Standard deviation of the correlation, from 1, of a source that sees the surface.
            picture = np.exp(-(((1 - correlation) / 0.3) ** 2) / 2) * (correlation > -1.5)
            height, width = picture.shape
            # The mean over each pixel and its neighbours, across the seam and the poles; the same sum at each pixel.
            padded = pad_panorama(picture.astype(np.float32), _RADIUS)
            side = 2 * _RADIUS + 1
            rows = np.zeros((height, width + 2 * _RADIUS), np.float32)
            for shift in range(side):
                rows += padded[shift : shift + height]
            result = np.zeros((height, width), np.float32)
            for shift in range(side):
                result += rows[:, shift : shift + width]
            match = result / np.float32(side**2)
            self._match[idx] = _MEMORY * self._match[idx] + (1 - _MEMORY) * match if self.known else match
        best = np.maximum(self._match.max(axis=0), np.float32(1e-6))
        np.square(self._match / best, out=self.views)
        self.known = True


_LUMA = np.array([0.2126, 0.7152, 0.0722])
# Maximum of a refined range, relative to the farthest swept one.
_BEYOND = 1.5
_FIT_RADIUS = 3
_SMALLEST_SIDE = 16
# A window extends two pixels per sample from its centre, and one and a half times as far in a source that is nearer.
SOURCE_REACH = 3.0


@checks_settings
def refine_range(
    range_map: RangeMap,
    reference: Picture,
    sources: Sequence[Picture],
    *,
    source_from_reference: Sequence[Rigid3],
    rounds: Annotated[int, Setting("number of rounds of fitting and matching planes", ge=0, le=32)] = 4,
    window: Annotated[
        int, Setting("samples along each side of the window, two pixels apart, odd", ge=3, le=15, odd=True)
    ] = 5,
    prior_px: Annotated[
        float, Setting("standard deviation of the prior of a plane's range, in pixels of parallax", gt=0)
    ] = 0.6,
    prior_slope: Annotated[
        float, Setting("standard deviation of the prior of its slope, in pixels of parallax per pixel", gt=0)
    ] = 0.1,
    noise: Annotated[float, Setting("minimum standard deviation of image noise, in grey levels", gt=0)] = 0.4,
    sigma_color: Annotated[
        float, Setting("contrast to the window's centre, in grey levels, at which a sample has half weight", gt=0)
    ] = 25.0,
    view_weights: Annotated[
        bool, Setting("weight sources by how well they match around a pixel; otherwise the better half counts")
    ] = True,
    source_masks: Sequence[Mask | None] | None = None,
) -> RangeMap:
    """Refine ranges between the depth hypotheses, and estimate normals.

    Args:
        range_map: (H, W) of the reference, full sphere, accurate to about a pixel of parallax; filled pixels
            (confidence 3–63) do not change, and invalid ones stay invalid.
        reference: (H, W, 3) uint8 RGB.
        sources: one or more (Hs, Ws, 3) uint8 RGB, each of its own size.
        source_from_reference: pose of each source relative to the reference.
        source_masks: for each source (Hs, Ws), False where it is ignored, or None.

    Returns:
        Ranges and normals; confidences are unchanged.

    Raises:
        UsageError: if shapes do not match or a parameter is out of bounds.
    """
    _check(range_map, reference, sources, poses=source_from_reference, masks=source_masks)
    height, width = range_map.range.shape
    settings = WindowSettings(window, prior_px, prior_slope, noise, sigma_color)
    return refine_part(
        range_map,
        reference,
        source_arrays(sources, source_from_reference, source_masks, reach=settings.reach / height),
        numbers=settings.numbers(width, source_from_reference),
        window=window,
        rounds=rounds,
        view_weights=view_weights,
        limits=swept_limits(range_map),
    )


@dataclass(frozen=True, slots=True)
class WindowSettings:
    """The settings of `refine_range` that say how windows are matched."""

    window: int
    prior_px: float
    prior_slope: float
    noise: float
    sigma_color: float

    @property
    def reach(self) -> float:
        """The largest distance of a sample from a window's centre in a source, in pixels of the reference."""
        return SOURCE_REACH * (self.window // 2)

    def numbers(self, width: int, source_from_reference: Sequence[Rigid3]) -> Numbers:
        """Return the kernel's numbers, see `refine_rows`, for a reference of this width."""
        # The change of inverse range that moves a point by one pixel at the widest baseline.
        pixel_q = 2 * np.pi / width / max(float(np.linalg.norm(pose.translation)) for pose in source_from_reference)
        # Samples of a window are neighbours, and not independent: 25 samples count as this many.
        return (
            np.float32(1 / self.sigma_color),
            np.float32(self.noise**2),
            (self.prior_px * pixel_q) ** -2,
            (self.prior_slope * pixel_q) ** -2,
            10.0,
            np.float32(0.5 * pixel_q),  # beyond half a pixel at the widest baseline, images are not linear
        )


def swept_limits(range_map: RangeMap) -> tuple[float, float]:
    """Return the farthest and the nearest range that a refined pixel may have."""
    swept = range_map.range[range_map.confidence >= WEAK_CONFIDENCE[0]]
    return (_BEYOND * float(swept.max()), float(swept.min()) / _BEYOND) if len(swept) else (1.0, 1.0)


def refine_part(
    range_map: RangeMap,
    reference: Picture,
    sources: Sources,
    *,
    numbers: Numbers,
    window: int,
    rounds: int,
    view_weights: bool,
    limits: tuple[float, float],
    part: tuple[int, int] | None = None,
) -> RangeMap:
    """Refine the ranges of some rows of a panorama, all columns of them.

    Rows within `margin_of_part` of an edge that is not a pole differ from what the whole panorama would give.

    `range_map`, `reference`: (h, W), as of `refine_range`. `sources`: see `source_arrays`. `numbers`: see
    `WindowSettings`. `window`, `rounds`, `view_weights`: as of `refine_range`. `limits`: see `swept_limits`. `part`:
    the first row, and the number of rows of the panorama; None: the rows are all of them.
    """
    import numba  # slow to import

    from pano_mvs.algorithms.patchmatch import kernels_refine  # compiles on import

    rows_here, width = range_map.range.shape
    top, height = part = part or (0, rows_here)
    here = slice(top, top + rows_here)
    offsets = column_offsets((height, width), 2 * (window // 2), spherical=True)[here, ::2].copy()
    stretches = column_stretch(height, spherical=True)[here].copy()
    near_offsets = column_offsets((height, width), _FIT_RADIUS, spherical=True)[here].copy()
    views = reference_arrays(reference, offsets, stretches), sources
    seen = range_map.confidence >= WEAK_CONFIDENCE[0]
    inverse = np.where(seen, 1 / range_map.range, np.float32(np.nan)).astype(np.float32)
    planes = np.empty((3, rows_here, width), np.float32)
    # Maximum relative difference in range of neighbours on a plane per radian: the tangent of a slant of 58°.
    max_step = 1.6 * 2 * np.pi / width

    def lay(first: int, rows: int) -> None:
        kernels_refine.fit_planes(inverse, first, rows, near_offsets, stretches, max_step, planes, part)

    def match(first: int, rows: int) -> None:
        kernels_refine.refine_rows(first, rows, planes, *views, numbers, weights.known, inverse, weights.views, part)

    threads = numba.get_num_threads()
    weights = ViewWeights(len(sources[1]), (rows_here, width))
    for left in reversed(range(rounds)):
        for_bands(lay, rows_here, threads=threads)
        for_bands(match, rows_here, threads=threads)
        inverse[~seen] = np.nan
        if view_weights and left:
            weights.update()
    for_bands(lay, rows_here, threads=threads)
    return _range_map_from_planes(planes, range_map, seen, limits=limits, rays=ray_grid((height, width), here))


def margin_of_part(rounds: int, window: int) -> int:
    """Return the number of rows at an edge that `refine_part` does not refine as it would in the whole panorama.

    A window lacks its pixels beyond the edge; a round looks at planes and weights around a pixel; the last planes are
    fitted once more.
    """
    return 2 * (window // 2) + rounds * (_FIT_RADIUS + _RADIUS) + _FIT_RADIUS


def _range_map_from_planes(
    planes: FloatImage, before: RangeMap, seen: Mask, *, limits: tuple[float, float], rays: FloatArray
) -> RangeMap:
    """Return the ranges along the rays and the normals of planes (3, H, W) where they are meaningful.

    A plane that intersects its ray far outside of the swept ranges is an accident: the swept range is kept.
    """
    height, width = before.range.shape
    inverse = np.einsum("ahw,hwa->hw", planes.astype(np.float64), rays)
    farthest, nearest = limits
    met = seen & (inverse * farthest > 1) & (inverse * nearest < 1)
    ranges = np.divide(1.0, inverse, out=before.range.astype(np.float64), where=met)
    length = np.linalg.norm(planes, axis=0)
    normals = np.full((height, width, 3), np.nan, np.float16)
    # p · ray > 0 at the surface, so −p points back to the camera.
    normals[met] = -(planes[:, met] / length[met]).T
    return RangeMap(ranges.astype(np.float32), before.confidence, normals, sky=before.sky)


def reference_arrays(
    reference: Picture, offsets: NDArray[np.int64], stretches: NDArray[np.float64]
) -> tuple[object, ...]:
    """Return the kernels' arguments for the reference image, see `refine_rows`."""
    width = reference.shape[1]
    side = offsets.shape[1]
    rows = np.arange(1 - side, side, 2)  # two pixels apart, as the columns at the equator
    pad = max(int(offsets.max()), int(rows[-1]))
    azimuth = 2 * np.pi * ((np.arange(-pad, width + pad) + 0.5) / width - 0.5)
    grey = pad_panorama((reference @ _LUMA).astype(np.float32), pad)
    return grey, np.stack([np.sin(azimuth), np.cos(azimuth)]).astype(np.float32), pad, stretches, rows, offsets


def source_arrays(
    sources: Sequence[Picture], poses: Sequence[Rigid3], masks: Sequence[Mask | None] | None, *, reach: float
) -> Sources:
    """Return the kernels' arguments for the sources, see `sum_windows`; `reach`: window size in image heights."""
    from pano_mvs.algorithms.patchmatch.kernels_match import pack_grey  # compiles on import

    pictures = [pack_grey(source).ravel() for source in sources]
    starts = np.cumsum([0, *(len(picture) for picture in pictures)])[:-1]
    valid = np.zeros(0, np.uint8)
    if masks is not None and not all(mask is None or mask.all() for mask in masks):
        given = [np.ones(s.shape[:2], np.bool_) if m is None else m for s, m in zip(sources, masks, strict=True)]
        voting = [pixels_with_valid_window(mask, ceil(reach * mask.shape[0])) for mask in given]
        valid = np.concatenate([_whole_patches(mask).ravel() for mask in voting])
    matrices = np.stack([np.column_stack([pose.rotation, pose.translation]) for pose in poses])
    shapes = np.array([(*source.shape[:2], source.shape[1] + 1) for source in sources])
    return np.concatenate(pictures), starts, shapes, matrices, valid, starts


def _whole_patches(mask: Mask) -> NDArray[np.uint8]:
    """Return which 2×2 patches of a mask are valid, (H, W) to (H + 1, W + 1), ordered as those of `pack_grey`."""
    padded = pad_panorama(mask, 1)
    return np.asarray(padded[:-1, :-1] & padded[1:, :-1] & padded[:-1, 1:] & padded[1:, 1:], np.uint8)


def _check(
    range_map: RangeMap,
    reference: Picture,
    sources: Sequence[Picture],
    *,
    poses: Sequence[Rigid3],
    masks: Sequence[Mask | None] | None,
) -> None:
    """Raise UsageError unless shapes and numbers match."""
    if len(sources) == 0 or len(poses) != len(sources) or (masks is not None and len(masks) != len(sources)):
        raise UsageError(
            f"refinement needs one pose (and one mask, if any) for each of one or more sources, got "
            f"{len(sources)} sources, {len(poses)} poses"
        )
    if reference.shape != (*range_map.range.shape, 3):
        raise UsageError(
            f"the reference must have the size of its range map, (*{range_map.range.shape}, 3), got {reference.shape}"
        )
    for name, picture in [("reference", reference), *((f"source {idx}", s) for idx, s in enumerate(sources))]:
        if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[2] != 3 or picture.shape[1] % 2:
            raise UsageError(
                f"{name}: refinement needs (H, W, 3) uint8 RGB of even width, got {picture.shape} {picture.dtype}"
            )
        if min(picture.shape[:2]) < _SMALLEST_SIDE:
            raise UsageError(
                f"{name}: refinement needs at least {_SMALLEST_SIDE} pixels on a side, got {picture.shape}"
            )
    for idx, mask in enumerate(masks or ()):
        if mask is not None and mask.shape != sources[idx].shape[:2]:
            raise UsageError(f"source {idx}: its mask must be {sources[idx].shape[:2]}, got {mask.shape}")
    if not any(np.linalg.norm(pose.translation) > 0 for pose in poses):
        raise UsageError("all sources were taken from the same place as the reference, so ranges cannot be measured")


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
            # After the reduced size, rounds at the panorama's own size place the edges.
            start, count = _continued(found, start), min(rounds, 2)
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

    On a surface with little texture, a sweep finds one of many minima, and slanted planes refine only within a fraction
    of a pixel of it. Filters that look at more than a window often come closer to the right minimum. There, even a weak
    texture is enough to confirm and to refine the range. As in ACMP (Q. Xu and W. Tao, "Planar prior assisted
    PatchMatch multi-view stereo", AAAI 2020), they are hypotheses, and the match of the images counts.

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
