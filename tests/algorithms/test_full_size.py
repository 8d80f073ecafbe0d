"""Ranges at full size: strips change nothing, and details of a larger picture make ranges more exact."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.patchmatch.full_size import (
    enlarged_strips,
    joined_strips,
    refine_in_strips,
    sources_in_grey,
    widths_between,
)
from pano_mvs.algorithms.patchmatch.refine import WindowSettings, refine_part, source_arrays, swept_limits
from pano_mvs.algorithms.scales import EnlargedRangeMap, enlarged_range_map
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room, render
from tests.known import known

SMALL, SIZE = (96, 192), (192, 384)
WINDOWS: dict[str, Any] = {"window": 5, "prior_px": 0.6, "prior_slope": 0.1, "noise": 0.4, "sigma_color": 25.0}
PLAIN = slice(60, 84)
Views = tuple[list[NDArray[np.uint8]], list[NDArray[np.float32]], list[Rigid3], list[NDArray[np.bool_]]]


@pytest.fixture(scope="module")
def views() -> Views:
    """Pictures, true ranges and relative poses of three cameras.

    Some rows of the reference show only noise, by which detail is judged. The second source is masked at its nadir.
    """
    poses = capture_poses(3, seed=1, spread=0.4)
    pictures, truth = zip(*(render(default_room(), pose, SIZE, supersample=1) for pose in poses), strict=True)
    pictures[0][PLAIN] = np.random.default_rng(5).integers(120, 123, pictures[0][PLAIN].shape)
    masks = [np.ones(SIZE, np.bool_), np.ones(SIZE, np.bool_)]
    masks[1][150:] = False
    return list(pictures), list(truth), [pose @ poses[0].inverse() for pose in poses[1:]], masks


@pytest.fixture(scope="module")
def coarse(views: Views) -> RangeMap:
    """True ranges at half the size, off by a few percent, with holes, filled pixels, uncertainties and sky."""
    rng = np.random.default_rng(0)
    ranges = views[1][0][::2, ::2] * rng.uniform(0.98, 1.02, SMALL).astype(np.float32)
    confidence = np.full(SMALL, 200, np.uint8)
    confidence[40:44, 50:60] = 30
    ranges[10:14, 20:30], confidence[10:14, 20:30] = np.nan, 0
    return RangeMap(ranges, confidence, uncertainty=np.full(SMALL, 0.01, np.float16), sky=np.isnan(ranges))


def in_grey(views: Views) -> Any:
    return sources_in_grey(
        zip(views[0][1:], views[3], strict=True),
        sizes_hw=[SIZE, SIZE],
        source_from_reference=views[2],
        settings=WindowSettings(**WINDOWS),
    )


def at_full_size(views: Views, coarse: RangeMap, **settings: Any) -> RangeMap:
    settings = {"rounds": 2, "view_weights": True, **WINDOWS, **settings}
    found = refine_in_strips(coarse, views[0][0], in_grey(views), source_from_reference=views[2], **settings)
    return joined_strips(found)


@pytest.mark.slow
@pytest.mark.parametrize("strip_rows", [64, 100])
def test_strips_change_nothing(views: Views, coarse: RangeMap, strip_rows: int) -> None:
    whole, stripped = (at_full_size(views, coarse, strip_rows=rows) for rows in (SIZE[0], strip_rows))
    assert np.nanmedian(np.abs(whole.range / joined_strips(enlarged_strips(coarse, SIZE)).range - 1)) > 1e-3
    for name in ("range", "confidence", "uncertainty", "sky"):
        np.testing.assert_array_equal(getattr(stripped, name), getattr(whole, name))


def test_ranges_come_closer_to_the_truth_where_they_were_seen(views: Views, coarse: RangeMap) -> None:
    before, after = joined_strips(enlarged_strips(coarse, SIZE)), at_full_size(views, coarse)
    after.check()
    seen = before.confidence >= 64
    assert seen.sum() > 0.9 * seen.size
    np.testing.assert_array_equal(after.range[PLAIN][10:-10], before.range[PLAIN][10:-10])
    seen[PLAIN] = False
    errors = [np.median(np.abs(found.range / views[1][0] - 1)[seen]) for found in (before, after)]
    assert errors[1] < 0.5 * errors[0]
    filled = before.confidence < 64
    np.testing.assert_array_equal(after.range[filled], before.range[filled])
    np.testing.assert_array_equal(after.confidence, coarse.confidence.repeat(2, axis=0).repeat(2, axis=1))
    assert np.array_equal(known(after.sky), ~after.valid)


def test_sources_in_grey_refine_as_packed_ones(views: Views, coarse: RangeMap) -> None:
    """They have half the resolution of grey levels, 1/128."""
    settings = WindowSettings(**WINDOWS)
    start = enlarged_range_map(coarse, SIZE)
    packed = source_arrays(views[0][1:], views[2], views[3], reach=settings.reach / SIZE[0])
    first, second = (
        refine_part(
            start,
            views[0][0],
            sources,
            numbers=settings.numbers(SIZE[1], views[2]),
            window=5,
            rounds=2,
            view_weights=True,
            limits=swept_limits(start),
        ).range
        for sources in (packed, in_grey(views))
    )
    np.testing.assert_array_equal(np.isfinite(first), np.isfinite(second))
    differences = np.abs(first / second - 1)[np.isfinite(first)]
    assert np.quantile(differences, 0.95) < 1e-3


def test_enlarging_by_a_whole_number_equals_enlarging_at_once(coarse: RangeMap) -> None:
    at_once, by_rows = enlarged_range_map(coarse, SIZE), EnlargedRangeMap(coarse, SIZE).rows(slice(0, SIZE[0]))
    np.testing.assert_allclose(by_rows.range, at_once.range, rtol=1e-5)
    np.testing.assert_array_equal(by_rows.confidence, at_once.confidence)


def test_planes_stay_planes_at_any_larger_size() -> None:
    """Over the seam and the poles, too: 1/range of a sphere is constant."""
    flat = RangeMap(np.full((16, 32), 3, np.float32), np.full((16, 32), 200, np.uint8))
    np.testing.assert_allclose(EnlargedRangeMap(flat, (22, 44)).rows(slice(0, 22)).range, 3, rtol=1e-6)
    ramp = RangeMap(np.tile(1 / np.linspace(0.5, 0.55, 16, dtype=np.float32)[:, None], (1, 32)), flat.confidence)
    rows = EnlargedRangeMap(ramp, (24, 48)).rows(slice(4, 20)).range[:, 0]
    places = (np.arange(4, 20) + 0.5) * 16 / 24 - 0.5
    np.testing.assert_allclose(1 / rows, 0.5 + 0.05 * places / 15, rtol=1e-6)


@pytest.mark.parametrize(
    ("width", "full", "expected"),
    [(4096, 16384, [8192, 16384]), (4096, 5376, [5376]), (4096, 11000, [11000]), (4096, 4096, []), (4096, 2048, [])],
)
def test_widths_double_up_to_the_full_one(width: int, full: int, expected: list[int]) -> None:
    assert widths_between(width, full) == expected


def test_a_smaller_reference_is_refused(views: Views, coarse: RangeMap) -> None:
    with pytest.raises(UsageError, match="must be larger than its range map"):
        next(
            refine_in_strips(
                coarse,
                views[0][0][:96, :192],
                in_grey(views),
                source_from_reference=views[2],
                rounds=2,
                view_weights=True,
                **WINDOWS,
            )
        )
