"""Multi-view consistency: true ranges agree, wrong ones do not, and the compiled judge equals the plain one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from pano_mvs.algorithms.filters.consistency import _step_around, check_consistency
from pano_mvs.algorithms.ranges.agreement import agreeing_sources, compare_with_sources, seen_ranges
from pano_mvs.algorithms.ranges.kernels_agreement import compare_rows, count_agreeing
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, ray_grid, roll_panorama, sines_of_grid
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room
from tests.algorithms.range_scenes import as_map, random_map, rolled, room_range
from tests.oracles import range_filters as oracle

SIZE = (128, 256)
POSES = capture_poses(4, seed=1, spread=0.4)
# At this size true ranges, too, are seen at less parallax than is asked for by default.
LIMITS: dict[str, Any] = {"max_relative_error": 0.02, "max_reprojection_px": 1.0, "min_motion_px": 0.01}


@pytest.fixture(scope="module")
def true_maps() -> list[RangeMap]:
    room = default_room()
    return [as_map(room_range(room, pose, SIZE)) for pose in POSES]


def checked(maps: Sequence[RangeMap], **settings: Any) -> RangeMap:
    return check_consistency(maps[0], POSES[0], maps[1:], source_poses=POSES[1:], **LIMITS | settings)


@pytest.mark.kernel("ranges.kernels_agreement")
@pytest.mark.parametrize("size", [(12, 24), (13, 20)])
def test_compiled_verdicts_equal_the_plain_ones(size: tuple[int, int]) -> None:
    """On maps without any order, seen from all over: every branch, the seam and the poles."""
    rng = np.random.default_rng(0)
    pose = capture_poses(2, seed=3, tilt_deg=60)[1]
    reference, source = random_map(rng, size), random_map(rng, (16, 32))
    smooth = as_map(2 + 0.02 * rng.random((16, 32)))
    for ranges in (source.range, smooth.range):
        limits = (0.2, 3 * 2 * np.pi / size[1], 0.3)
        view = pose.rotation, pose.translation
        counts = np.zeros(size, np.int64), np.zeros(size, np.int64), np.zeros(size, np.uint16)
        sums = np.zeros(size), np.zeros(size), np.zeros(size)
        for rows in ((0, 5), (5, size[0])):
            compare_rows(rows, reference.range, sines_of_grid(size), view, ranges, limits, counts, sums)
        expected, supports, motions = oracle.judge(reference.range, pose, ranges, 0.2, 3, 0.3)
        assert len(np.unique(expected)) == 4
        for verdict, count in enumerate(counts, start=1):
            np.testing.assert_array_equal(count, expected == verdict)
        squared_errors = supports * limits[1] ** 2 * (1 - np.sqrt(supports))
        for found, plain in zip(sums, (supports, supports * motions, squared_errors), strict=True):
            np.testing.assert_allclose(found, plain, rtol=1e-3, atol=1e-6)
        agreeing = np.zeros(size, np.uint8)
        rays = ray_grid(size).reshape(-1, 3)
        points = rays * reference.range.reshape(-1, 1)
        count_agreeing(points, view, ranges, limits, 1, agreeing.ravel())
        np.testing.assert_array_equal(agreeing, expected == 1)


def test_sources_that_agree_are_counted_alone_or_with_all_figures(true_maps: list[RangeMap]) -> None:
    moved = [pose @ POSES[0].inverse() for pose in POSES[1:]]
    limits: dict[str, Any] = {"max_relative_error": 0.02, "max_angle": 0.03}
    points = (ray_grid(SIZE) * true_maps[0].range[..., None]).reshape(-1, 3)
    known = [seen_ranges(true, min_confidence=64) for true in true_maps[1:]]
    found = agreeing_sources(points, known, moved, **limits)
    expected = compare_with_sources(true_maps[0].range, true_maps[1:], moved, **limits).agreeing.ravel()
    assert found.max() == len(moved)
    np.testing.assert_array_equal(found, expected)
    enough = agreeing_sources(points, known, moved, **limits, most=2)
    np.testing.assert_array_equal(enough, np.minimum(expected, 2))


def test_true_ranges_confirm_each_other(true_maps: list[RangeMap]) -> None:
    result = checked(true_maps, remove_inconsistent=True)
    result.check()
    assert (result.confidence >= 128).mean() > 0.96
    assert result.valid.mean() > 0.995


def test_wrong_ranges_are_not_confirmed_and_go_when_seen_through(true_maps: list[RangeMap]) -> None:
    rng = np.random.default_rng(1)
    wrong = rng.random(SIZE) < 0.2
    factor = np.where(wrong, rng.choice([0.6, 0.7, 1.4, 1.7], SIZE), 1)
    maps = [as_map(true_maps[0].range * factor), *true_maps[1:]]
    result = checked(maps)
    assert (result.confidence[wrong] >= 128).mean() < 0.03
    assert (result.confidence[~wrong] >= 128).mean() > 0.96
    assert result.valid.all()
    removed = ~checked(maps, remove_inconsistent=True).valid
    near = wrong & (factor < 1)
    assert removed[near].mean() > 0.9
    assert removed[~wrong].mean() < 0.005
    # A range too large lies behind what the others see: they cannot tell it from something hidden.
    assert removed[factor > 1].mean() < 0.1


def test_confidence_grows_with_the_number_of_views_and_falls_with_the_error(true_maps: list[RangeMap]) -> None:
    few, many = checked(true_maps[:2] + [as_map(np.full(SIZE, np.nan))] * 2), checked(true_maps)
    both = few.confidence >= 128
    assert np.median(many.confidence[both]) > np.median(few.confidence[both])
    off = checked([as_map(true_maps[0].range * 1.01), *true_maps[1:]])
    both = (off.confidence >= 128) & (many.confidence >= 128)
    assert np.median(off.confidence[both]) < np.median(many.confidence[both])


def test_along_the_baseline_nothing_is_consistent_however_well_it_agrees(true_maps: list[RangeMap]) -> None:
    """Forward and backward meet at the epipoles whatever the range is."""
    result = check_consistency(true_maps[0], POSES[0], true_maps[1:2], source_poses=POSES[1:2], min_motion_px=0.1)
    rays = ray_grid(SIZE)
    baseline = (POSES[1] @ POSES[0].inverse()).center
    sine = np.linalg.norm(np.cross(rays, baseline / np.linalg.norm(baseline)), axis=-1)
    assert (result.confidence[sine < 0.1] < 128).all()
    assert (result.confidence[sine > 0.9] >= 128).mean() > 0.6
    even = checked(true_maps[:2] + [as_map(np.full(SIZE, np.nan))] * 2)
    both = even.confidence >= 128
    assert np.median(even.confidence[both & (sine > 0.9)]) > np.median(even.confidence[both & (sine < 0.3)]) + 10


def test_agreement_by_a_hair_is_not_enough(true_maps: list[RangeMap]) -> None:
    """A range that misses the sources by nearly what is allowed has little support, one that misses by little much."""
    shares = {}
    for factor in (1.0, 1.012):
        for support in (0.0, 0.9):
            maps = [as_map(true_maps[0].range * factor), *true_maps[1:]]
            result = checked(maps, max_reprojection_px=0.15, max_reprojection_deg=0, min_support=support)
            shares[factor, support] = (result.confidence >= 128).mean()
    assert min(shares[1.0, 0.0], shares[1.0, 0.9], shares[1.012, 0.0]) > 0.98
    assert shares[1.012, 0.9] < 0.8


@pytest.mark.parametrize(("angle_deg", "is_kept"), [(0.0, False), (0.28125, True)])
def test_more_pixels_confirm_no_less_if_the_limit_is_an_angle(angle_deg: float, is_kept: bool) -> None:
    """Ranges that were off by the same at any resolution were confirmed less the more pixels there were."""
    shares = []
    for size in [(64, 128), (128, 256)]:
        rng, rays = np.random.default_rng(5), ray_grid(size)
        waves = [np.sin(rays @ rng.normal(0, 4, 3)) for _ in POSES]
        ranges = [room_range(default_room(), pose, size) for pose in POSES]
        maps = [as_map(one * (1 + 0.01 * wave)) for one, wave in zip(ranges, waves, strict=True)]
        limits = {"max_relative_error": 0.05, "max_reprojection_px": 0.1, "max_reprojection_deg": angle_deg}
        shares.append((checked(maps, **limits).confidence >= 128).mean())
    assert (shares[1] > shares[0] - 0.02) == is_kept


def test_beside_a_step_sides_are_doubtful_and_normals_are_kept(true_maps: list[RangeMap]) -> None:
    edge = np.where(np.arange(SIZE[1]) < 100, 2.0, 4.0) * np.ones(SIZE)
    step = _step_around(as_map(edge).range)
    np.testing.assert_allclose(step[:, 98:102], np.log(2), rtol=1e-6)
    np.testing.assert_allclose(step[2:-2, [97, 102, 30]], 0, atol=1e-6)
    np.testing.assert_allclose(step[2:-2, [254, 255, 0, 1]], np.log(2), rtol=1e-6)  # over the seam
    hole = as_map(np.where(np.arange(SIZE[1]) < 100, np.nan, edge))
    assert np.isfinite(_step_around(hole.range)).all()
    normals = np.broadcast_to(np.array([0, 0, -1], np.float16), (*SIZE, 3)).copy()
    with_normals = RangeMap(true_maps[0].range, true_maps[0].confidence, normals)
    np.testing.assert_array_equal(checked([with_normals, *true_maps[1:]]).normals_in_cam, normals)


def test_min_views_is_the_number_that_must_confirm(true_maps: list[RangeMap]) -> None:
    shares = [(checked(true_maps, min_views=views).confidence >= 128).mean() for views in (1, 2, 3, 4)]
    assert shares == sorted(shares, reverse=True)
    assert shares[2] > 0.5
    assert shares[3] == 0


def test_the_order_of_the_sources_does_not_matter(true_maps: list[RangeMap]) -> None:
    order = [2, 0, 1]
    turned = check_consistency(
        true_maps[0], POSES[0], [true_maps[1:][i] for i in order], source_poses=[POSES[1:][i] for i in order], **LIMITS
    )
    np.testing.assert_array_equal(turned.confidence, checked(true_maps).confidence)


@pytest.mark.parametrize("columns", [1, 100, 255])
def test_rolling_the_reference_rolls_the_result(true_maps: list[RangeMap], columns: int) -> None:
    _, new_from_old = roll_panorama(true_maps[0].range, columns)
    pose = Rigid3(new_from_old, np.zeros(3)) @ POSES[0]
    result = check_consistency(rolled(true_maps[0], columns), pose, true_maps[1:], source_poses=POSES[1:], **LIMITS)
    expected = rolled(checked(true_maps), columns).confidence
    # Rays of a rolled picture differ by rounding, which tips pixels that lie between two surfaces.
    assert (np.abs(result.confidence.astype(int) - expected) > 1).mean() < 1e-3


def test_filled_pixels_neither_vote_nor_are_promoted(true_maps: list[RangeMap]) -> None:
    filled = [RangeMap(m.range, np.full(SIZE, 40, np.uint8)) for m in true_maps]
    assert (checked([true_maps[0], *filled[1:]]).confidence < 128).all()
    np.testing.assert_array_equal(checked([filled[0], *true_maps[1:]]).confidence, 40)
    assert np.isnan(seen_ranges(filled[0], min_confidence=64)).all()


def test_what_was_consistent_before_is_weak_when_nobody_confirms_it(true_maps: list[RangeMap]) -> None:
    alone = check_consistency(RangeMap(true_maps[0].range, np.full(SIZE, 250, np.uint8)), POSES[0], [], source_poses=[])
    np.testing.assert_array_equal(alone.confidence, 127)


def test_any_number_of_threads_gives_the_same_bytes(true_maps: list[RangeMap]) -> None:
    numba = pytest.importorskip("numba")
    before = numba.get_num_threads()
    results = []
    for threads in {1, before}:
        numba.set_num_threads(threads)
        results.append(checked(true_maps).confidence.tobytes())
    numba.set_num_threads(before)
    assert len(set(results)) == 1


def test_impossible_calls_are_named(true_maps: list[RangeMap]) -> None:
    with pytest.raises(UsageError, match="one pose per source"):
        check_consistency(true_maps[0], POSES[0], true_maps[1:], source_poses=POSES[2:])
    with pytest.raises(UsageError, match="min_views must be at least 1"):
        checked(true_maps, min_views=0)
