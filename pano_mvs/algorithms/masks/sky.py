"""Find the sky in a panorama: what is smooth, and looks the same in all views if it is infinitely far away."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.masks.areas import (
    area_labels,
    border_shares,
    dilated,
    pixel_weights,
    reduced_to_width,
    share_of_sphere,
)
from pano_mvs.algorithms.masks.sky_comparison import (
    Comparison,
    compare_with_source,
    errors_of_area,
    pixel_errors,
    source_errors,
)
from pano_mvs.algorithms.panoramas import box_sum, contrast_around, filtered, largest_channel, nearest_resized
from pano_mvs.algorithms.sweep.preparation import is_bare
from pano_mvs.core.arrays import Mask, Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import Rigid3, pad_panorama, ray_grid
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, RangeMap

_TOLERANCE, _SPREAD, _MAX_TOLERANCE = 7.0, 3.0, 40.0
_BAND_PX, _BAND_BESIDE_PX = 2, 3


@dataclass(frozen=True, eq=False)
class SkyColors:
    """The colours of the sky in every direction.

    `mean`: (H, W, 3) float32 expected colour. `tolerance`: (H, W) float32 largest difference of a channel from it, in
    grey levels.
    """

    mean: NDArray[np.float32]
    tolerance: NDArray[np.float32]

    def match(self, picture: Picture) -> Mask:
        """Return the pixels of a picture of the same size, (H, W), that have the colours of the sky."""
        return np.asarray(largest_channel(np.abs(picture - self.mean)) <= self.tolerance)


def sky_colors(picture: Picture, seeds: Mask) -> SkyColors:
    """Learn the colours of the sky from pixels that are sky: local means, and a smooth function of direction elsewhere.

    `picture`: (H, W, 3) uint8. `seeds`: (H, W), at least one pixel.
    """
    levels = picture.astype(np.float64)
    x, y, z = np.moveaxis(ray_grid((seeds.shape[0], seeds.shape[1])), -1, 0)
    terms = np.stack([np.ones_like(x), x, y, z, x * x, y * y, x * y, x * z, y * z], axis=-1)
    step = max(1, int(seeds.sum()) // 4000)
    factors = np.linalg.lstsq(terms[seeds][::step], levels[seeds][::step], rcond=None)[0]
    low, high = np.quantile(levels[seeds], [0.01, 0.99], axis=0)
    mean = np.asarray(np.clip(terms @ factors, low, high))
    spread = np.full(seeds.shape, np.sqrt(float(((levels - mean)[seeds] ** 2).max(axis=-1).mean())))
    for radius in (24, 6):
        if 2 * radius >= picture.shape[0]:
            continue
        count = box_sum(seeds.astype(np.float64), radius)
        share = np.clip(count / 40.0, 0, 1)
        local = box_sum(levels * seeds[..., None], radius) / np.maximum(count, 1)[..., None]
        mean = share[..., None] * local + (1 - share)[..., None] * mean
        squares = box_sum(largest_channel((levels - mean) ** 2) * seeds, radius) / np.maximum(count, 1)
        spread = share * np.sqrt(squares) + (1 - share) * spread
    tolerance = np.minimum(_TOLERANCE + _SPREAD * spread, _MAX_TOLERANCE)
    return SkyColors(mean.astype(np.float32), tolerance.astype(np.float32))


def sharpened_sky(sky: Mask, colors: SkyColors, picture: Picture) -> Mask:
    """Return the sky at the resolution of a picture, with edges where the picture has them.

    Near its edges, a pixel is sky if its colour is nearer to that of the sky than to that of what is beside it.

    `sky`: (h, w). `colors`: of the same size. `picture`: (H, W, 3) uint8, of that size or larger.
    """
    height, width = picture.shape[:2]
    scale = max(1, round(width / sky.shape[1]))
    wide = _resized(sky.astype(np.float32), (height, width)) >= 0.5
    mean = _resized(colors.mean, (height, width))
    band = dilated(wide, _BAND_PX * scale) & dilated(~wide, _BAND_PX * scale)
    away = largest_channel(np.abs(picture - mean))
    weights = (~wide | band) * np.maximum(away - _TOLERANCE, 0) ** 2
    beside, total = _box(picture * weights[..., None], _BAND_BESIDE_PX * scale), _box(weights, _BAND_BESIDE_PX * scale)
    beside /= np.maximum(total, 1e-6)[..., None]
    between = mean - beside
    position = ((picture - beside) * between).sum(axis=-1) / np.maximum((between**2).sum(axis=-1), 1e-6)
    # A pixel that is far from the colours of the sky, for what lies beside it, is something else.
    limit = np.maximum(_resized(colors.tolerance, (height, width)), 0.5 * np.linalg.norm(between, axis=-1))
    nearer = np.where(total > 1, position > 0.5, wide) & (away <= limit)
    return np.where(band, nearer, wide)


def _resized(values: NDArray[np.float32], size_hw: tuple[int, int]) -> NDArray[np.float32]:
    if values.shape[:2] == size_hw:
        return values
    pad = 1
    scale_y, scale_x = size_hw[0] / values.shape[0], size_hw[1] / values.shape[1]
    padded = pad_panorama(values, pad)
    columns = ((np.arange(size_hw[1]) + 0.5) / scale_x - 0.5 + pad).astype(np.float32)
    rows = ((np.arange(size_hw[0]) + 0.5) / scale_y - 0.5 + pad).astype(np.float32)
    at_x, at_y = np.meshgrid(columns, rows)
    return np.asarray(cv2.remap(padded, at_x, at_y, cv2.INTER_LINEAR), np.float32)


def _box(values: NDArray[np.float32], radius: int) -> NDArray[np.float32]:
    side = 2 * radius + 1
    return filtered(values.astype(np.float32), radius, lambda padded: cv2.blur(padded, (side, side)))


MAX_SOURCES = 4
"""More sources than this add little."""

_MIN_WIDTH = 64
# Errors in grey levels: of the sky at infinity, and by how much those at finite range may be less.
_MAX_ERROR, _FLAT_RATIO, _FLAT_MARGIN = 4.0, 1.15, 0.5
# Without a preference for infinity: the most that may lie on one plane, and that other views may confirm.
_MAX_PLANE_SHARE, _MAX_CONSISTENT = 0.7, 0.18
_PLANE_TRIALS, _PLANE_TOLERANCE, _MIN_BORDER_POINTS = 200, 0.06, 30
_SOLID_MARGIN = 3.0
# Larger parts of the colours of the sky must agree at infinity too.
_MAX_PART_SHARE = 0.005
# Larger ones count as small if they differ by at most this number of grey levels on average.
_MAX_EXACT_SHARE, _EXACT_LEVELS = 0.03, 5.0
_CLOUD_RADIUS_PX, _CLOUD_SHARE, _ROUGH_ERRORS = 3, 0.7, 3
_ROUNDS = 3
# A window: the smallest and the largest pane, how far what is behind it is, and how many pixels beside must show it.
_PANE_SHARES, _FAR_PARALLAX = (2e-4, 0.01), 0.125
_BESIDE_PX, _MIN_BESIDE, _MIN_FAR_SHARE = 4, 8, 0.04
# It is far compared with the room, too, and the pane is among the brightest of the picture, and no redder than half.
_MAX_FAR_RATIO, _BRIGHTER_SHARE, _BLUER_SHARE, _MIN_LIGHT = 0.4, 0.9, 0.5, 0.5
# At infinity, one source agrees; at the range of the frame, another one sees what is behind the window.
_MAX_BESIDE_ERROR, _MIN_SEEN_BEHIND, _MOST_MOVED = 4.0, 30.0, 0.9


@dataclass(frozen=True, eq=False)
class _View:
    """What is known of the reference at the comparison's resolution; arrays (H, W) or (H, W, 3)."""

    picture: Picture
    valid: Mask
    ranges: NDArray[np.float32]
    consistent: Mask
    comparisons: tuple[Comparison, ...]


@checks_settings
def sky_pixels(
    range_map: RangeMap,
    picture: Picture,
    sources: Sequence[Picture],
    *,
    source_from_reference: Sequence[Rigid3],
    valid: Mask,
    source_valid: Sequence[Mask],
    rng: np.random.Generator,
    min_share: Annotated[
        float, Setting("smallest share of the sphere of an area by which a sky is recognised", gt=0, le=1)
    ] = 0.01,
) -> Mask:
    """Return the pixels, (H, W), that show the sky.

    Seeds are large smooth areas whose colours agree with the sources if the area is infinitely far away, up to a factor
    per channel. Walls and ceilings do not: their shading and their extent move. If the colours agree as well at the
    measured ranges (an overcast sky, an overexposed room), the sky is what other views hardly confirm, and whose border
    does not lie on one plane. The colours of the seeds, as a function of direction, then find the sky in smaller areas:
    behind branches, in windows. Edges follow the picture.

    Args:
        range_map: of the reference, after the check by other views.
        picture: the reference, (H, W, 3) uint8.
        sources: of which the first `MAX_SOURCES` are used.
        source_from_reference: pose of each.
        valid: (H, W), False is ignored.
        rng: draws border points for planes.

    Raises:
        UsageError: if the sizes do not fit together, or there is no source.
    """
    if picture.shape[:2] != range_map.range.shape or valid.shape != range_map.range.shape:
        raise UsageError(f"the picture is {picture.shape[:2]}, its ranges are {range_map.range.shape}")
    if not sources or not len(sources) == len(source_from_reference) == len(source_valid):
        raise UsageError("the sky needs one or more sources, each with its pose and mask")
    if picture.shape[1] < _MIN_WIDTH:
        return np.zeros_like(valid)
    used = list(zip(sources, source_valid, source_from_reference, strict=True))[:MAX_SOURCES]
    view = _view(range_map, picture, valid, sources=used)
    seeds, walls = _seeds(view, min_share=min_share, rng=rng)
    if not seeds.any():
        return np.zeros_like(valid)
    sky, colors = _grown(view, seeds, rng, walls=walls)
    found = np.asarray(sharpened_sky(sky, colors, picture) & valid, np.bool_)
    if not walls.any():
        return found
    parallax_px = np.max([source.parallax_px for source in view.comparisons], axis=0)
    surface = confirmed_parts(nearest_resized(found, sky.shape), view.consistent & (parallax_px > 1))
    return np.asarray(found & ~nearest_resized(surface, valid.shape), np.bool_)


def _view(range_map: RangeMap, picture: Picture, valid: Mask, *, sources: list[tuple[Picture, Mask, Rigid3]]) -> _View:
    """Return the reference and its comparisons with the sources, at `WIDTH` columns or fewer."""
    small, small_valid = reduced_to_width(picture, valid)
    ranges = nearest_resized(range_map.range, small_valid.shape)
    consistent = nearest_resized(range_map.confidence, small_valid.shape) >= CONSISTENT_CONFIDENCE[0]
    small_sources = [(*reduced_to_width(source, mask), pose) for source, mask, pose in sources]
    comparisons = tuple(
        compare_with_source(small, ranges, source, source_valid=mask, source_from_reference=pose)
        for source, mask, pose in small_sources
    )
    return _View(small, small_valid, ranges, consistent, comparisons)


def confirmed_parts(sky: Mask, confirmed: Mask) -> Mask:
    """Return the parts of a supposed sky, (H, W), that are a surface, because most of their ranges are confirmed.

    The sky itself has single ranges by chance, and along its edges those of what is in front of it.

    `sky`: (H, W) the supposed sky. `confirmed`: (H, W) the pixels whose ranges other views confirm under a parallax.
    """
    labels, weights = area_labels(sky), pixel_weights(sky.shape)
    sizes, known = (np.bincount(labels[part], weights[part], labels.size) for part in (sky, sky & confirmed))
    core = _share_around(sky & confirmed) > 0.5
    return sky & ((2 * known > sizes)[labels] | dilated(core, _CLOUD_RADIUS_PX))


def _share_around(mask: Mask) -> NDArray[np.float64]:
    """Return the share of the pixels around each pixel, (H, W), that a mask has."""
    return box_sum(mask.astype(np.float64), _CLOUD_RADIUS_PX) / box_sum(np.ones(mask.shape), _CLOUD_RADIUS_PX)


def _seeds(view: _View, *, min_share: float, rng: np.random.Generator) -> tuple[Mask, Mask]:
    """Return the large areas that are sky: smooth ones, and clouds; otherwise, panes, and what cannot be sky with them.

    If the sky is only seen through windows, other large smooth areas are walls and ceilings.
    """
    # In a smooth area, the pixels of a window of 3×3 differ by fewer grey levels.
    possible = view.valid & ((contrast_around(view.picture, 1) < 10) | _clouds(view))
    labels, weights = area_labels(possible), pixel_weights(possible.shape)
    sizes = np.bincount(labels[possible], weights[possible], labels.size)
    found, large = np.zeros_like(possible), np.flatnonzero(sizes >= min_share * weights.sum())
    for label in large:
        # Smaller flat areas by which no sky is recognised are blinds and lamps.
        if _is_sky(view, area := labels == label, rng, min_flat_share=0.05):
            found |= area
    if found.any():
        return found, np.zeros_like(found)
    return _panes(view, labels, sizes), dilated(np.isin(labels, large), 1)


def _panes(view: _View, labels: NDArray[np.intp], sizes: NDArray[Any]) -> Mask:
    """Return the smooth areas that lie behind far surfaces: the sky above a skyline that is seen through a window.

    A pane with the sky looks like a plain panel in the frame of the window. But beside a far surface, such as a roof,
    the sources see that surface or the sky as far away as it is, and not where a panel in the frame would be.
    """
    at_infinity, at_range = source_errors(view.picture, view.consistent, view.comparisons)
    parallax = np.max([source.parallax_px for source in view.comparisons], axis=0) * (2 * np.pi / labels.shape[1])
    known = view.consistent & ~is_bare(view.picture)
    usual = float(np.median(parallax[known])) if known.any() else 0.0
    far = known & (parallax > 0) & (parallax < min(_FAR_PARALLAX, _MAX_FAR_RATIO * usual))
    levels = view.picture.astype(np.float64)
    brightness, blueness = largest_channel(view.picture), (levels[..., 2] + 4) / (levels[..., 0] + 4)
    is_bright = brightness >= _quantile(brightness, _BRIGHTER_SHARE)
    light = np.asarray(is_bright & (blueness >= _quantile(blueness, _BLUER_SHARE)))
    best, worst = np.fmin.reduce(at_infinity), np.nan_to_num(np.fmax.reduce(at_range))
    near_far = dilated(far, _BESIDE_PX)
    found: Mask = np.zeros(far.shape, np.bool_)
    least, most = (share * pixel_weights(far.shape).sum() for share in _PANE_SHARES)
    for label in np.unique(labels[near_far & (labels >= 0)]):
        area = labels == label
        beside = area & near_far & np.isfinite(best)
        if not least <= sizes[label] <= most or beside.sum() < _MIN_BESIDE or light[area].mean() < _MIN_LIGHT:
            continue
        around = dilated(area, _BESIDE_PX) & ~dilated(area, 1)
        is_open = (far & around).sum() >= _MIN_FAR_SHARE * max(int((known & around).sum()), 1)
        moved = np.quantile(worst[beside], _MOST_MOVED) >= _MIN_SEEN_BEHIND
        if is_open and moved and np.median(best[beside]) <= _MAX_BESIDE_ERROR:
            found |= area
    return found


def _quantile(values: NDArray[Any], share: float) -> float:
    """Return a quantile over the sphere of values (H, W)."""
    order = np.argsort(values, axis=None, kind="stable")
    below = np.cumsum(pixel_weights(values.shape).ravel()[order])
    return float(values.ravel()[order[np.searchsorted(below, share * below[-1])]])


def _clouds(view: _View) -> Mask:
    """Return where most pixels agree at infinity, and not at their range."""
    at_infinity, at_range = pixel_errors(view.picture, view.consistent, view.comparisons, area_at_infinity=False)
    far = (at_infinity <= _ROUGH_ERRORS * _MAX_ERROR) & (at_range > at_infinity + _SOLID_MARGIN)
    if far.any():  # these pixels know the exposure of the sky better than the ground does
        at_infinity, at_range = pixel_errors(view.picture, far, view.comparisons, area_at_infinity=True)
        far = (at_infinity <= _MAX_ERROR) & (at_range > at_infinity + _SOLID_MARGIN)
    return _share_around(far) >= _CLOUD_SHARE


def _is_sky(view: _View, area: Mask, rng: np.random.Generator, *, min_flat_share: float = 0.0) -> bool:
    """Return whether the colours of an area agree at infinity, and nothing speaks for a finite range."""
    inner = area & ~dilated(~area, 2)
    if inner.sum() < 0.3 * area.sum():  # too little of it lies away from its border
        inner = area
    at_infinity, at_range = errors_of_area(view.picture, inner, view.comparisons)
    if not at_infinity <= min(_MAX_ERROR, _FLAT_RATIO * at_range + _FLAT_MARGIN):
        return False
    if np.isfinite(at_range):
        if at_range >= 1.3 * at_infinity + 0.1:
            return True
    elif at_infinity <= 0.12 * view.picture[inner].std(axis=0).max():
        return True
    border = dilated(area, 3) & ~area & view.consistent & ~is_bare(view.picture)
    return bool(
        share_of_sphere(area) >= min_flat_share
        and view.consistent[inner].mean() <= _MAX_CONSISTENT
        and _plane_share(view.ranges, border, inner, rng=rng) <= _MAX_PLANE_SHARE
    )


def _plane_share(ranges: NDArray[np.float32], border: Mask, area: Mask, *, rng: np.random.Generator) -> float:
    """Return the largest share of the border points that lie on one plane which all rays of the area meet.

    It is 1 if there are too few points to say.
    """
    rays = ray_grid((ranges.shape[0], ranges.shape[1]))
    bearings, weights, inside = rays[border], pixel_weights(border.shape)[border], rays[area]
    if len(bearings) < _MIN_BORDER_POINTS:
        return 1.0
    distances = ranges[border].astype(np.float64)
    points = bearings * distances[:, None]
    inside = inside[:: max(1, len(inside) // 500)]
    best = 0.0
    for _ in range(_PLANE_TRIALS):
        chosen = points[rng.choice(len(points), 3, replace=False, p=weights / weights.sum())]
        normal = np.cross(chosen[1] - chosen[0], chosen[2] - chosen[0])
        offset = float(normal @ chosen[0])
        if abs(offset) < 1e-9 or ((inside @ normal) * offset > 0).mean() < 0.95:
            continue
        with np.errstate(divide="ignore"):
            near = np.abs(offset / (bearings @ normal) / distances - 1) < _PLANE_TOLERANCE
        best = max(best, float(weights[near].sum() / weights.sum()))
    return best


def _grown(view: _View, seeds: Mask, rng: np.random.Generator, *, walls: Mask) -> tuple[Mask, SkyColors]:
    """Return the sky with the smaller areas of its colours outside of `walls`, and its colours.

    A part of the colours of the sky needs no further evidence if it is small: in a window or between branches, the
    sources see the window's frame or the branches at infinity, and at their range the part moves with them.
    """
    at_infinity, at_range = pixel_errors(view.picture, seeds, view.comparisons, area_at_infinity=True)
    solid = view.consistent & ~is_bare(view.picture) & (at_range + _SOLID_MARGIN < at_infinity)
    agrees = (at_infinity <= _MAX_ERROR) & ~solid & view.valid & ~walls
    sky, most = seeds, _MAX_PART_SHARE * pixel_weights(seeds.shape).sum()
    for _ in range(_ROUNDS):
        colors = sky_colors(view.picture, sky)
        # Farther from known sky, the colours of the sky are not known.
        reached = view.valid & ~walls & dilated(sky, min(40, len(sky) // 2 - 1))
        alike = reached & colors.match(view.picture) & (~solid | dilated(sky, 1))
        labels = area_labels(alike & ~sky)
        inside, weights = labels >= 0, pixel_weights(sky.shape)
        sizes = np.bincount(labels[inside], weights[inside], labels.size)
        agreeing = np.bincount(labels[inside & agrees], weights[inside & agrees], labels.size)
        away = largest_channel(np.abs(view.picture - colors.mean))
        exact = np.bincount(labels[inside], (weights * away)[inside], labels.size) <= _EXACT_LEVELS * sizes
        taken = (sizes <= most) | (exact & (sizes <= _MAX_EXACT_SHARE / _MAX_PART_SHARE * most))
        for label in np.flatnonzero(~taken & (agreeing >= 0.3 * sizes)):
            taken[label] = _is_sky(view, labels == label, rng)
        sky = sky | (inside & taken[labels])
        sky = _with_enclosed_parts(_crept(sky, view.picture, agrees), agrees | alike)
    return sky, sky_colors(view.picture, sky)


def _crept(sky: Mask, picture: Picture, agrees: Mask) -> Mask:
    """Return the sky with neighbouring pixels that agree at infinity and whose colours continue it, as at a horizon."""
    for _ in range(4):
        count = box_sum(sky.astype(np.float64), 2)
        local = box_sum(picture.astype(np.float64) * sky[..., None], 2) / np.maximum(count, 1)[..., None]
        further = agrees & ~sky & (count > 0) & (largest_channel(np.abs(picture - local)) <= 16)
        if not further.any():
            break
        sky = sky | further
    return sky


def _with_enclosed_parts(sky: Mask, possible: Mask) -> Mask:
    """Return the sky with the parts, such as the edges of clouds, whose border is mostly sky."""
    labels = area_labels(possible & ~sky)
    return sky | ((labels >= 0) & (border_shares(labels, sky) >= 0.7)[labels])
