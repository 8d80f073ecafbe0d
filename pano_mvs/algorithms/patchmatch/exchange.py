"""Exchange ranges between views: an unconfirmed pixel takes a nearer range that other views found and that matches.

A surface that a sweep loses in one view (near, thin, occluded in most sources) is often found in another one, which
has a better position. The ranges of the sources are projected into the reference. If such a range is nearer than that
of an unconfirmed pixel, one of the two is wrong, since the nearer surface would hide the other. As in ACMM (Q. Xu and
W. Tao, "Multi-scale geometric consistency guided multi-view stereo", CVPR 2019), the number of views that agree and the
match of the images in the best sources decide. A farther range contradicts nothing: the pixel may show something that
the sources missed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.data_term import MaxHoleDeg, require_confidence
from pano_mvs.algorithms.filters.fill import large_holes
from pano_mvs.algorithms.filters.uncertainty import with_ranges
from pano_mvs.algorithms.patchmatch.window_matches import Offers, WindowMatcher, rays_of
from pano_mvs.algorithms.ranges.agreement import agreeing_sources, compare_with_sources, seen_ranges
from pano_mvs.core.arrays import FloatImage, Mask, Picture
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import Rigid3, sines_of_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import CONSISTENT_CONFIDENCE, WEAK_CONFIDENCE

_MOST_AGREEING = 3
"""Of the sources that agree, more than this many say no more."""


@dataclass(frozen=True, eq=False)
class SourceView:
    """A source with what is known of it.

    `picture`: (H, W, 3) uint8 RGB. `range_map`: its ranges, (H, W). `from_reference`: its pose: x_in_source = R
    x_in_reference + t. `mask`: (H, W), False where it is ignored, or None.
    """

    picture: Picture
    range_map: RangeMap
    from_reference: Rigid3
    mask: Mask | None = None


@checks_settings
def exchange_ranges(
    range_map: RangeMap,
    reference: Picture,
    sources: Sequence[SourceView],
    *,
    max_relative_error: Annotated[float, Setting("maximum relative difference of ranges that agree", gt=0)] = 0.02,
    max_reprojection_px: Annotated[float, Setting("maximum forward-backward reprojection error", gt=0)] = 1.0,
    max_reprojection_deg: Annotated[
        float, Setting("the same as an angle, which replaces a smaller max_reprojection_px", ge=0)
    ] = 0.35,
    min_agreeing: Annotated[
        int, Setting("sources, or all if there are fewer, that must agree on a range to take it over", ge=1)
    ] = 3,
    min_support: Annotated[float, Setting("support by sources from which on a pixel keeps its range", ge=0)] = 0.7,
    agreement: Annotated[
        float, Setting("correlation that one more agreeing source is worth, up to three", ge=0)
    ] = 0.05,
) -> tuple[RangeMap, float]:
    """Replace unconfirmed ranges by nearer ones of other views, where these match better.

    The valid pixels of each source are projected into the reference; the nearest that meets a pixel counts. A pixel
    that its sources do not confirm (`checked_with_agreement`: their support is less than `min_support`) takes such a
    range r if r is nearer by more than `max_relative_error`, at least `min_agreeing` sources agree on r, and r has a
    higher score than the pixel's own range. The score is the mean of the two best correlations, of windows on the
    surface with the source's normal, plus `agreement` for each of up to three sources that agree. The best of several
    ranges wins.

    Args:
        range_map: (H, W) of the reference, full sphere. Pixels without a range stay so.
        reference: (H, W, 3) uint8 RGB.
        sources: one or more.
        min_agreeing: smallest number of sources that agree on a range, including the one that it comes from; all of
            them if there are fewer sources, but one source alone is not enough.

    Returns:
        The range map, with confidences unchanged, and the share of its valid pixels that were replaced.

    Raises:
        UsageError: if there are no sources, or shapes do not match.
    """
    _check(range_map, reference, sources)
    reprojection = max(max_reprojection_px * 2 * np.pi / reference.shape[1], np.radians(max_reprojection_deg))
    views = [source.range_map for source in sources], [source.from_reference for source in sources]
    limits = {"max_relative_error": max_relative_error, "max_angle": reprojection}
    seen = range_map.confidence >= WEAK_CONFIDENCE[0]
    own = compare_with_sources(np.where(seen, range_map.range, np.float32(np.nan)), *views, **limits)
    unsure = seen & ((own.agreeing < 1) | (own.support < min_support))
    own_agreeing = np.minimum(own.agreeing, _MOST_AGREEING).astype(np.uint8).ravel()
    del own  # large
    least = min(min_agreeing, max(len(sources), 2))
    farthest = np.where(unsure, range_map.range * (1 - max_relative_error), np.float32(0)).astype(np.float32)
    known = [seen_ranges(view, min_confidence=WEAK_CONFIDENCE[0]) for view in views[0]]
    match = WindowMatcher(
        reference,
        [source.picture for source in sources],
        from_reference=[source.from_reference for source in sources],
        masks=[source.mask for source in sources],
    )
    offered, scored = [], []
    for source in sources:
        offers = offers_of(source, farthest)
        points = rays_of(offers.pixels, farthest.shape) * offers.ranges.astype(np.float64)[:, None]
        agreeing = agreeing_sources(points, known, views[1], **limits, most=max(least, _MOST_AGREEING))
        offers, agreeing = offers.chosen(agreeing >= least), agreeing[agreeing >= least]
        offered.append(offers)
        scored.append(match.correlation(offers) + agreement * np.minimum(agreeing, _MOST_AGREEING))
    offers, scores = Offers.joined(offered), np.concatenate(scored)
    wanted = np.unique(offers.pixels)
    own_scores = np.zeros(seen.size)
    own_scores[wanted] = match.correlation(Offers.of(range_map, wanted))
    own_scores[wanted] += agreement * own_agreeing[wanted]
    better = np.flatnonzero(scores > own_scores[offers.pixels])
    # The last of a pixel counts: the best one, and of equals that of the first source.
    better = better[::-1][np.argsort(scores[better[::-1]], kind="stable")]
    share = len(np.unique(offers.pixels[better])) / max(int(seen.sum()), 1)
    return _replaced(range_map, offers.chosen(better)), share


def offers_of(source: SourceView, farthest: FloatImage) -> Offers:
    """Return the ranges of a source that are nearer than given ones, (H, W), of the reference."""
    ranges, positions = project_range_map(
        source.range_map, source.from_reference, (farthest.shape[0], farthest.shape[1])
    )
    with np.errstate(invalid="ignore"):
        pixels = np.flatnonzero((ranges < farthest).ravel())
    normals = source.range_map.normals_in_cam
    if normals is not None:
        turn = source.from_reference.rotation
        normals = (normals.reshape(-1, 3)[positions.ravel()[pixels]].astype(np.float64) @ turn).astype(np.float16)
    return Offers(pixels, ranges.ravel()[pixels], normals)


def _replaced(range_map: RangeMap, offers: Offers) -> RangeMap:
    """Return a range map with offered ranges; of several for one pixel, the last counts."""
    ranges, normals = range_map.range.copy(), range_map.normals_in_cam
    ranges.reshape(-1)[offers.pixels] = offers.ranges
    if normals is not None:
        normals = normals.copy()
        normals.reshape(-1, 3)[offers.pixels] = np.nan if offers.normals is None else offers.normals
    return RangeMap(ranges, range_map.confidence, normals, sky=range_map.sky)


def project_range_map(
    range_map: RangeMap, from_reference: Rigid3, size_hw: tuple[int, int]
) -> tuple[FloatImage, NDArray[np.int64]]:
    """Return the ranges of a source as the reference sees them, and the positions of its pixels, (H, W) each.

    Every pixel of the source that was seen lands in one pixel of the reference; of those that land in the same one, the
    nearest counts. Where none lands, the range is NaN and the position −1.

    `range_map`: of the source. `from_reference`: pose of the source: x_in_source = R x_in_reference + t. `size_hw`: of
    the reference.
    """
    from pano_mvs.algorithms.patchmatch.kernels_exchange import land_points

    ranges = seen_ranges(range_map, min_confidence=WEAK_CONFIDENCE[0])
    back = from_reference.inverse()
    view = np.ascontiguousarray(back.rotation), np.ascontiguousarray(back.translation)
    nearest, positions = np.full(size_hw, np.nan), np.full(size_hw, -1, np.int64)
    land_points(ranges, sines_of_grid((ranges.shape[0], ranges.shape[1])), view, nearest, positions)
    return nearest.astype(np.float32), positions


def _check(range_map: RangeMap, reference: Picture, sources: Sequence[SourceView]) -> None:
    if not sources:
        raise UsageError("exchange of ranges needs at least one source")
    if reference.shape != (*range_map.range.shape, 3):
        raise UsageError(
            f"the reference must have the size of its range map, (*{range_map.range.shape}, 3), got {reference.shape}"
        )
    for idx, source in enumerate(sources):
        shape = source.range_map.range.shape
        if source.picture.shape != (*shape, 3) or (source.mask is not None and source.mask.shape != shape):
            raise UsageError(f"source {idx}: image, mask and range map differ in size; give all of them in one size")


@checks_settings
def respect_free_space(
    range_map: RangeMap,
    pose: Rigid3,
    sources: Sequence[RangeMap],
    *,
    source_poses: Sequence[Rigid3],
    max_relative_error: Annotated[
        float, Setting("relative difference of ranges from which on they contradict each other", gt=0, le=0.5)
    ] = 0.05,
    max_hole_deg: MaxHoleDeg = 20.0,
) -> tuple[RangeMap, float, float]:
    """Replace unconfirmed ranges behind confirmed points of other views, and remove those that other views see through.

    Only confirmed pixels of the sources (confidence 128 or more) count as evidence, and only pixels that were seen but
    are not confirmed are changed. First, the confirmed points of the sources are projected into the reference. Where
    the nearest of them is nearer than a pixel's range by more than `max_relative_error`, the pixel takes its range.
    Then each source is asked for the ranges that remain (`compare_with_sources`): a pixel becomes invalid if more
    sources see through its point than agree with it. A later filter fills it from its surroundings.

    Args:
        range_map: (H, W) after `check_consistency`, the full sphere.
        pose: its cam_from_world.
        sources: range maps after the same check, in any order: the result does not depend on it.
        source_poses: cam_from_world of each.

    Returns:
        The range map, the share of valid pixels with a nearer range, and the share that became invalid. Replaced ranges
        are weak (confidence 64–127): that a point is visible from elsewhere does not confirm that it is visible here.

    Raises:
        UsageError: if sources and poses differ in number, or a setting is out of bounds.
    """
    if len(sources) != len(source_poses):
        raise UsageError(f"{len(sources)} source range maps but {len(source_poses)} poses: give one pose per source")
    confirmed = [require_confidence(source, min_confidence=CONSISTENT_CONFIDENCE[0]) for source in sources]
    moved = [other @ pose.inverse() for other in source_poses]
    weak = (range_map.confidence >= WEAK_CONFIDENCE[0]) & (range_map.confidence <= WEAK_CONFIDENCE[1])
    nearest = _nearest_points(confirmed, moved, range_map.range.shape)
    with np.errstate(invalid="ignore"):
        hidden = weak & (nearest < range_map.range * (1 - max_relative_error))
    ranges = np.where(hidden, nearest, range_map.range)
    # A source agrees with a pixel if its own point, seen from the reference, lies within this angle.
    comparison = compare_with_sources(
        np.where(weak, ranges, np.float32(np.nan)),
        confirmed,
        moved,
        # A source contradicts from twice this error on.
        max_relative_error=max_relative_error / 2,
        max_angle=np.radians(0.7),
    )
    seen_through = weak & np.asarray(comparison.contradicting > comparison.agreeing)
    seen_through &= ~large_holes(range_map.valid & ~seen_through, max_hole_deg)
    ranges[seen_through] = np.nan
    confidence = np.where(hidden, np.uint8(WEAK_CONFIDENCE[1]), range_map.confidence)
    confidence[seen_through] = 0
    valid = max(int(range_map.valid.sum()), 1)
    shares = float((hidden & ~seen_through).sum() / valid), float(seen_through.sum() / valid)
    return with_ranges(range_map, ranges, confidence), *shares


def _nearest_points(
    sources: Sequence[RangeMap], source_from_reference: Sequence[Rigid3], size_hw: tuple[int, int]
) -> FloatImage:
    """Return the nearest range at which a pixel of a source lands in each pixel, (H, W); inf where none lands."""
    nearest = np.full(size_hw, np.inf, np.float32)
    for source, moved in zip(sources, source_from_reference, strict=True):
        landed, _ = project_range_map(replace(source, normals_in_cam=None), moved, size_hw)
        nearest = np.fmin(nearest, landed)
    return nearest
