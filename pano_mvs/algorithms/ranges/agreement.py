"""What views see where the points of another view land, and how well they agree with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pano_mvs.core.arrays import FloatArray
from pano_mvs.core.bands import for_bands
from pano_mvs.geometry import Rigid3, pixel_from_ray, sines_of_grid
from pano_mvs.scene import RangeMap
from pano_mvs.scene.range_map import WEAK_CONFIDENCE

MAX_SURFACE_STEP = 0.05
"""Four neighbouring pixels with a larger relative difference are two surfaces: ranges are not interpolated there."""

MAX_REPROJECTION_PX = 1.0
"""The usual limit of the reprojection error of ranges that agree, in pixels at the equator."""


def pixels_containing(rays: FloatArray, size_hw: tuple[int, ...]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return row and column, (...,) each, of the pixels of a panorama in which rays (..., 3) of any length arrive."""
    height, width = size_hw
    whole = np.floor(pixel_from_ray(rays, (height, width))).astype(np.intp)
    return np.minimum(whole[..., 1], height - 1), whole[..., 0] % width


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Agreement of all sources with each pixel, (H, W) each."""

    agreeing: NDArray[np.uint16]  # number of sources that agree
    contradicting: NDArray[np.uint16]  # number of sources that see through it
    hiding: NDArray[np.uint16]  # number of sources that see something nearer
    support: NDArray[np.float64]  # sum of the supports of the agreeing sources
    motion: NDArray[np.float64]  # sum of their supports times their squared motions, in rad²
    squared_error: NDArray[np.float64]  # sum of their supports times their squared reprojection errors, in rad²


def compare_with_sources(
    ranges: NDArray[np.float32],
    sources: Sequence[RangeMap],
    source_from_reference: Sequence[Rigid3],
    *,
    max_relative_error: float,
    max_angle: float,
) -> Comparison:
    """Return the agreement of the sources with ranges of the reference, as in `checked_with_agreement`.

    `ranges`: (H, W) float32, NaN is left out. `sources`: range maps; filled pixels are left out.
    `source_from_reference`: pose of each. `max_relative_error`: largest relative difference of ranges that agree.
    `max_angle`: largest angle between pixel and reprojection, in radians.
    """
    import numba  # slow to import

    from pano_mvs.algorithms.ranges.kernels_agreement import compare_rows  # compiles on import

    shape = ranges.shape
    agreeing, contradicting, hiding = (np.zeros(shape, np.uint16) for _ in range(3))
    comparison = Comparison(agreeing, contradicting, hiding, *(np.zeros(shape) for _ in range(3)))
    counts = comparison.agreeing, comparison.contradicting, comparison.hiding
    sums = comparison.support, comparison.motion, comparison.squared_error
    # Copied, since the kernel is compiled once more for arrays that are read-only.
    ranges, grid = np.array(ranges, np.float32), sines_of_grid((shape[0], shape[1]))
    limits = max_relative_error, max_angle, MAX_SURFACE_STEP
    for source, moved in zip(sources, source_from_reference, strict=True):  # one after the other, to save memory
        view, known = _arrays_of(moved), seen_ranges(source, min_confidence=WEAK_CONFIDENCE[0])

        def compare(
            first: int,
            rows: int,
            *,
            view: tuple[FloatArray, FloatArray] = view,
            known: NDArray[np.float32] = known,
        ) -> None:
            compare_rows((first, first + rows), ranges, grid, view, known, limits, counts, sums)

        for_bands(compare, shape[0], threads=numba.get_num_threads())
    return comparison


def agreeing_sources(
    points: FloatArray,
    sources: Sequence[NDArray[np.float32]],
    source_from_reference: Sequence[Rigid3],
    *,
    max_relative_error: float,
    max_angle: float,
    most: int = 255,
) -> NDArray[np.uint8]:
    """Return the number of sources that agree with each point, (N,), as in `compare_with_sources`.

    `points`: (N, 3) in the reference frame. `sources`: ranges (H, W) that were seen, NaN is left out; see
    `seen_ranges`. `source_from_reference`: pose of each. `max_relative_error`: largest relative difference of ranges
    that agree. `max_angle`: largest angle between pixel and reprojection, in radians. `most`: as many sources are
    enough; more are not counted.
    """
    from pano_mvs.algorithms.ranges.kernels_agreement import count_agreeing  # compiles on import

    agreeing = np.zeros(len(points), np.uint8)
    limits = max_relative_error, max_angle, MAX_SURFACE_STEP
    for ranges, moved in zip(sources, source_from_reference, strict=True):
        count_agreeing(points, _arrays_of(moved), ranges, limits, most, agreeing)
    return agreeing


def _arrays_of(pose: Rigid3) -> tuple[FloatArray, FloatArray]:
    return np.ascontiguousarray(pose.rotation), np.ascontiguousarray(pose.translation)


def seen_ranges(range_map: RangeMap, *, min_confidence: int) -> NDArray[np.float32]:
    """Return the ranges, (H, W) float32, NaN where the confidence is lower than `min_confidence`."""
    ranges: NDArray[np.float32] = np.where(range_map.confidence >= min_confidence, range_map.range, np.float32(np.nan))
    return np.ascontiguousarray(ranges)
