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
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.consistency import agreeing_sources, compare_with_sources
from pano_mvs.algorithms.patchmatch.refine import SOURCE_REACH, reference_arrays, source_arrays
from pano_mvs.algorithms.sweep.windows import column_offsets, column_stretch
from pano_mvs.core.bands import for_bands
from pano_mvs.core.errors import UsageError
from pano_mvs.core.settings import Setting, checks_settings
from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import WEAK_CONFIDENCE

Picture = NDArray[np.uint8]
Mask = NDArray[np.bool_]
FloatImage = NDArray[np.float32]

# Samples along each side of a window, two pixels apart; their weights and the noise as in `refine_range`.
_WINDOW, _SIGMA_COLOR, _NOISE = 5, 25.0, 0.4
# The sources that match best decide; of those that agree, more than this many say no more.
_BEST, _MOST_AGREEING = 2, 3
# Surfaces that are seen at a more grazing angle than this cosine are matched as if they faced the camera.
_GRAZING = 0.1


@dataclass(frozen=True, eq=False)
class SourceView:
    """A source with what is known of it.

    Attributes:
        picture: (H, W, 3) uint8 RGB.
        range_map: its ranges, (H, W).
        from_reference: its pose: x_in_source = R x_in_reference + t.
        mask: (H, W), False where it is ignored, or None.
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
        max_relative_error: largest relative difference of ranges that agree; another range is nearer by more.
        max_reprojection_px: largest reprojection error of ranges that agree, in pixels of the reference.
        min_agreeing: smallest number of sources that agree on a range, including the one that it comes from; all of
            them if there are fewer sources, but one source alone is not enough.
        min_support: support from which on a pixel is confirmed and keeps its range.
        agreement: correlation that each source that agrees is worth.

    Returns:
        The range map, with confidences unchanged, and the share of its valid pixels that were replaced.

    Raises:
        UsageError: if there are no sources, or shapes do not match.
    """
    _check(range_map, reference, sources)
    px_per_rad = reference.shape[1] / (2 * np.pi)
    reprojection = max_reprojection_px / px_per_rad

    views = [source.range_map for source in sources], [source.from_reference for source in sources]
    limits = {"max_relative_error": max_relative_error, "max_angle": reprojection}
    seen = range_map.confidence >= WEAK_CONFIDENCE[0]
    own = compare_with_sources(np.where(seen, range_map.range, np.float32(np.nan)), *views, **limits)
    unsure = seen & ((own.agreeing < 1) | (own.support < min_support))
    best = _Best.of(range_map, own.agreeing, agreement)
    match = _Matcher(reference, sources)
    least = min(min_agreeing, max(len(sources), 2))
    offers = []
    for source in sources:
        ranges, normals = projected(source, (reference.shape[0], reference.shape[1]))
        with np.errstate(invalid="ignore"):
            other = unsure & (ranges < range_map.range * (1 - max_relative_error))
        agreeing = agreeing_sources(np.where(other, ranges, np.float32(np.nan)), *views, **limits)
        offers.append((ranges, normals, agreeing, other & (agreeing >= least)))
    wanted = np.any([offer[-1] for offer in offers], axis=0)
    best.score[wanted] += match.correlation(range_map.range, range_map.normals_in_cam, wanted)[wanted]
    for ranges, normals, agreeing, other in offers:
        scores = match.correlation(ranges, normals, other) + agreement * np.minimum(agreeing, _MOST_AGREEING)
        best.take(other & (scores > best.score), scores, ranges, normals=normals)
    share = float(best.taken.sum() / max(seen.sum(), 1))
    return RangeMap(best.ranges, range_map.confidence, best.normals, sky=range_map.sky), share


def projected(source: SourceView, size_hw: tuple[int, int]) -> tuple[FloatImage, NDArray[np.float16] | None]:
    """Return the ranges and normals of a source as the reference sees them, (H, W) and (H, W, 3); NaN where none lands.

    Every pixel of the source lands in one pixel of the reference; of those that land in the same one, the nearest
    counts.
    """
    from pano_mvs.algorithms.patchmatch.kernels_exchange import nearest_of_cells  # compiles on import

    height, width = size_hw
    ranges = source.range_map.range
    seen = source.range_map.confidence >= WEAK_CONFIDENCE[0]
    back = source.from_reference.inverse()
    points = back.apply(ray_grid((ranges.shape[0], ranges.shape[1]))[seen] * ranges[seen].astype(np.float64)[:, None])
    distance = np.linalg.norm(points, axis=-1)
    pixels = pixel_from_ray(points, size_hw)
    cell = np.minimum(pixels[:, 1].astype(np.intp), height - 1) * width + pixels[:, 0].astype(np.intp) % width
    nearest = nearest_of_cells(cell, distance, height * width)
    cells = np.flatnonzero(nearest >= 0)
    chosen = nearest[cells]
    landed = np.full(height * width, np.nan, np.float32)
    landed[cells] = distance[chosen]
    if source.range_map.normals_in_cam is None:
        return landed.reshape(size_hw), None
    normals = np.full((height * width, 3), np.nan, np.float16)
    normals[cells] = source.range_map.normals_in_cam[seen][chosen].astype(np.float64) @ back.rotation.T
    return landed.reshape(size_hw), normals.reshape(height, width, 3)


@dataclass(eq=False)
class _Best:
    """The best range of each pixel so far, (H, W) each, and its normal, (H, W, 3)."""

    score: NDArray[np.float64]
    ranges: FloatImage
    normals: NDArray[np.float16] | None
    taken: Mask

    @staticmethod
    def of(range_map: RangeMap, agreeing: NDArray[np.int64], agreement: float) -> _Best:
        """Return a pixel's own range, without the correlation in its score."""
        normals = None if range_map.normals_in_cam is None else range_map.normals_in_cam.copy()
        score = float(agreement) * np.minimum(agreeing, _MOST_AGREEING)
        return _Best(score, range_map.range.copy(), normals, np.zeros(score.shape, np.bool_))

    def take(
        self, where: Mask, scores: NDArray[np.float64], ranges: FloatImage, *, normals: NDArray[np.float16] | None
    ) -> None:
        """Take over ranges."""
        self.taken |= where
        self.score[where] = scores[where]
        self.ranges[where] = ranges[where]
        if self.normals is not None:
            self.normals[where] = np.nan if normals is None else normals[where]


class _Matcher:
    """Correlations of windows of the reference, on surfaces, with the sources."""

    def __init__(self, reference: Picture, sources: Sequence[SourceView]) -> None:
        height, width = reference.shape[:2]
        self.rays = ray_grid((height, width))
        offsets = column_offsets((height, width), 2 * (_WINDOW // 2), spherical=True)[:, ::2].copy()
        self.reference = reference_arrays(reference, offsets, column_stretch(height, spherical=True))
        self.sources = source_arrays(
            [source.picture for source in sources],
            [source.from_reference for source in sources],
            [source.mask for source in sources],
            reach=SOURCE_REACH * (_WINDOW // 2) / height,
        )
        self.count = len(sources)

    def correlation(self, ranges: FloatImage, normals: NDArray[np.float16] | None, wanted: Mask) -> FloatImage:
        """Return the mean of the two best correlations, at least 0, (H, W); 0 where it is not wanted."""
        import numba  # slow to import

        from pano_mvs.algorithms.patchmatch.kernels_exchange import correlate_rows  # compiles on import

        height, width = ranges.shape
        planes = surface_planes(ranges, normals, self.rays, wanted=wanted)
        found = np.full((self.count, height, width), -2, np.float32)
        numbers = np.float32(1 / _SIGMA_COLOR), np.float32(_NOISE**2)

        def match(first: int, rows: int) -> None:
            correlate_rows(first, rows, planes, wanted, self.reference, self.sources, numbers, found)

        for_bands(match, height, threads=numba.get_num_threads())
        best = min(_BEST, self.count)
        some = np.partition(found[:, wanted], self.count - best, axis=0)[-best:]
        correlations = np.zeros((height, width), np.float32)
        correlations[wanted] = np.maximum(some, 0).mean(axis=0)
        return correlations


def surface_planes(
    ranges: FloatImage, normals: NDArray[np.float16] | None, rays: NDArray[np.float64], *, wanted: Mask
) -> FloatImage:
    """Return the planes p with p · X = 1, (3, H, W), through the points of a range map; 0 where not wanted.

    A plane faces the camera where the normal is unknown or the surface is seen at a grazing angle.
    """
    planes = np.zeros((3, *ranges.shape), np.float32)
    ray = rays[wanted]
    normal = np.full_like(ray, np.nan) if normals is None else normals[wanted].astype(np.float64)
    cosine = np.sum(normal * ray, axis=-1)
    steep = np.abs(cosine) >= _GRAZING  # False for NaN
    normal, cosine = np.where(steep[:, None], normal, ray), np.where(steep, cosine, 1.0)
    planes[:, wanted] = (normal / (cosine * ranges[wanted])[:, None]).T
    return planes


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
