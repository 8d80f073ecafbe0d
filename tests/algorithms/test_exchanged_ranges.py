"""Ranges of other views: only what is right is taken over, and only what contradicts confirmed ranges is corrected."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.patchmatch.exchange import (
    SourceView,
    exchange_ranges,
    offers_of,
    project_range_map,
    respect_free_space,
)
from pano_mvs.algorithms.patchmatch.kernels_exchange import correlate_pixels, land_nearest
from pano_mvs.algorithms.patchmatch.refine import reference_arrays, source_arrays
from pano_mvs.algorithms.patchmatch.window_matches import surface_planes
from pano_mvs.algorithms.sweep.windows import column_offsets, column_stretch
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_from_pixel, ray_grid, sample_panorama
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room, render
from tests.algorithms.range_scenes import SEEN, TRUSTED, as_map, room_range
from tests.known import known
from tests.oracles import range_filters as oracle

SIZE = (64, 128)
LUMA = np.array([0.2126, 0.7152, 0.0722])
Scene = tuple[NDArray[np.uint8], NDArray[np.float32], list[SourceView]]


def seen(ranges: NDArray[np.float32], normals: NDArray[np.float16] | None = None) -> RangeMap:
    return RangeMap(ranges, np.full(ranges.shape, 100, np.uint8), normals)


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A picture of the room, its true ranges, and three sources with theirs."""
    poses = capture_poses(4, seed=2, spread=0.4)
    views = [render(default_room(), pose, SIZE, supersample=1) for pose in poses]
    sources = [
        SourceView(picture, seen(ranges), pose @ poses[0].inverse())
        for (picture, ranges), pose in zip(views[1:], poses[1:], strict=True)
    ]
    return *views[0], sources


def exchanged(scene: Scene, range_map: RangeMap, **settings: Any) -> tuple[RangeMap, float]:
    # Pixels are wide here, and truth is sampled at their centres.
    return exchange_ranges(range_map, scene[0], scene[2], **{"max_relative_error": 0.05} | settings)


def on_a_surface(truth: NDArray[np.float32]) -> NDArray[np.bool_]:
    """The pixels of whose surroundings all have about the same range."""
    shifts = [np.roll(truth, (v, u), (0, 1)) for v in range(-2, 3) for u in range(-4, 5)]
    smooth: NDArray[np.bool_] = np.ptp(np.log(shifts), axis=0) < 0.2
    smooth[:12] = smooth[-12:] = False
    return smooth


@pytest.mark.kernel("patchmatch.kernels_exchange")
def test_the_nearest_point_of_a_pixel_counts_and_the_first_of_equals() -> None:
    rng = np.random.default_rng(4)
    cells, distances = rng.integers(0, 40, 300), rng.integers(1, 6, 300).astype(np.float64)
    order = np.lexsort((distances, cells))
    expected = np.full(50, -1)
    occupied, firsts = np.unique(cells[order], return_index=True)
    expected[occupied] = order[firsts]
    nearest, pixels = np.full((5, 10), np.nan), np.full((5, 10), -1)
    places = np.stack([cells % 10 + 0.5, cells // 10 + 0.5, distances])
    ranges = np.ones(300, np.float32)
    land_nearest(places[:, :200], ranges[:200], 0, nearest, pixels)
    land_nearest(places[:, 200:], ranges[200:], 200, nearest, pixels)
    np.testing.assert_array_equal(pixels.ravel(), expected)
    np.testing.assert_array_equal(nearest.ravel()[occupied], distances[expected[occupied]])


@pytest.mark.kernel("patchmatch.kernels_exchange", "patchmatch.kernels_match", "patchmatch.kernels_refine")
def test_compiled_correlations_equal_the_definition(scene: Scene) -> None:
    picture, truth, sources = scene
    offsets, stretches = column_offsets(SIZE, 4, spherical=True)[:, ::2].copy(), column_stretch(SIZE[0], spherical=True)
    wanted = np.zeros(SIZE, np.bool_)
    wanted[::9, 5::31] = True
    rows, columns = np.nonzero(wanted)
    planes = np.zeros((3, *SIZE), np.float32)
    planes[:, wanted] = surface_planes(truth[wanted], None, ray_grid(SIZE)[wanted])
    found = np.zeros((1, *SIZE), np.float32)
    arrays = (
        reference_arrays(picture, offsets, stretches),
        source_arrays([sources[0].picture], [sources[0].from_reference], None, reach=0.0),
    )
    values_of = np.empty((1, len(rows)), np.float32)
    starts = np.searchsorted(rows, np.arange(SIZE[0] + 1))
    numbers = np.float32(1 / 25), np.float32(0.16)
    correlate_pixels((0, SIZE[0]), starts, columns, planes[:, wanted], *arrays, numbers, values_of)
    found[:, wanted] = values_of
    pose, grey = sources[0].from_reference, (sources[0].picture @ LUMA)[..., None]
    for row, column in np.argwhere(wanted):
        places, values, weights = oracle.window(
            picture @ LUMA, row, column, (-4, -2, 0, 2, 4), offsets[row], sigma_color=25
        )
        rays = ray_from_pixel(places, SIZE)
        directions = rays @ pose.rotation.T + (rays @ planes[:, row, column].astype(float))[:, None] * pose.translation
        other = sample_panorama(grey, pixel_from_ray(directions, SIZE))[:, 0]
        a, b = values - weights @ values, other - weights @ other
        expected = weights @ (a * b) / np.sqrt((weights @ a**2 + 0.16) * (weights @ b**2 + 0.16))
        assert found[0, row, column] == pytest.approx(expected, abs=5e-3)
    assert np.ptp(found[0, wanted]) > 0.2


def test_true_ranges_of_a_source_land_on_true_ranges(scene: Scene) -> None:
    _, truth, sources = scene
    landed, positions = project_range_map(sources[0].range_map, sources[0].from_reference, SIZE)
    assert offers_of(sources[0], np.full(SIZE, 9, np.float32)).normals is None
    np.testing.assert_array_equal(positions >= 0, np.isfinite(landed))
    ratio = (landed / truth)[np.isfinite(landed) & on_a_surface(truth)]
    assert len(ratio) > 1500
    assert np.mean(np.abs(ratio - 1) < 0.05) > 0.9


def test_the_nearest_of_those_that_land_in_a_pixel_counts() -> None:
    """A large source, of alternating ranges, at the place of a small reference: every second pixel is a spot."""
    ranges = np.where(np.add.outer(np.arange(32), np.arange(64)) % 2, 3.0, 2.0).astype(np.float32)
    source = SourceView(np.zeros((32, 64, 3), np.uint8), seen(ranges), Rigid3.identity())
    np.testing.assert_allclose(project_range_map(source.range_map, source.from_reference, (16, 32))[0], 2.0, rtol=1e-6)
    faint = replace(source, range_map=RangeMap(ranges, np.where(ranges < 2.5, 63, 64).astype(np.uint8)))
    np.testing.assert_allclose(project_range_map(faint.range_map, faint.from_reference, (16, 32))[0], 3.0, rtol=1e-6)


def test_normals_turn_with_the_camera() -> None:
    turn = Rigid3(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.zeros(3))
    normals = -ray_grid((16, 32)).astype(np.float16)
    source = SourceView(np.zeros((16, 32, 3), np.uint8), seen(np.full((16, 32), 2, np.float32), normals), turn)
    offers = offers_of(source, np.full((16, 32), 9, np.float32))
    np.testing.assert_array_equal(offers.pixels, np.arange(16 * 32))
    np.testing.assert_allclose(known(offers.normals).reshape(16, 32, 3), -ray_grid((16, 32)), atol=2e-3)


def test_planes_go_through_their_points_with_their_normals() -> None:
    size = (16, 32)
    rays, ranges = ray_grid(size), np.linspace(1, 4, 512, dtype=np.float32).reshape(size)
    normals = np.broadcast_to(np.array([0, -1, 0], np.float16), (*size, 3)).copy()
    normals[0] = np.nan
    planes = surface_planes(ranges.ravel(), normals.reshape(-1, 3), rays.reshape(-1, 3)).astype(np.float64)
    planes = planes.reshape(3, *size)
    np.testing.assert_allclose(np.einsum("ahw,hwa->hw", planes, rays * ranges[..., None]), 1, rtol=1e-5)
    direction = planes / np.linalg.norm(planes, axis=0)
    np.testing.assert_allclose(np.abs(direction[1, 1:6]), 1, rtol=1e-5)
    for row in (0, 7, 8):  # unknown, and grazing
        np.testing.assert_allclose(direction[:, row].T, rays[row], atol=1e-5)


def test_what_is_too_far_comes_back_from_the_sources(scene: Scene) -> None:
    _, truth, _ = scene
    lost = np.zeros(SIZE, np.bool_)
    lost[24:44, 10:40] = True
    wrong = np.where(lost, truth * 1.6, truth).astype(np.float32)
    found, share = exchanged(scene, seen(wrong))
    judged = lost & on_a_surface(truth)
    good = np.abs(found.range / truth - 1) < 0.06
    assert judged.sum() > 100
    assert good[judged].mean() > 0.6
    assert share > 0.4 * lost.mean()
    np.testing.assert_array_equal(found.confidence, 100)
    assert np.all(found.range <= wrong)


def test_what_is_nearer_than_the_sources_say_stays(scene: Scene) -> None:
    """The sources may have missed it."""
    _, truth, _ = scene
    near = (0.5 * truth).astype(np.float32)
    found, share = exchanged(scene, seen(near))
    changed = found.range != near
    assert share == changed.mean()
    assert changed[on_a_surface(truth)].mean() < 0.01


def test_the_more_sources_must_agree_the_less_is_taken_over(scene: Scene) -> None:
    wrong = seen((1.3 * scene[1]).astype(np.float32))
    shares = [exchanged(scene, wrong, min_agreeing=least)[1] for least in (1, 2, 3, 4)]
    assert shares[0] > shares[1] > shares[2] > 0
    assert shares[3] == shares[2]  # there are three
    alone = exchange_ranges(wrong, scene[0], scene[2][:1], max_relative_error=0.05)
    assert alone[1] == 0
    np.testing.assert_array_equal(alone[0].range, wrong.range)


def shell_around_reference(source: SourceView, radius: float) -> SourceView:
    """The source, with the ranges of a false sphere around the reference."""
    rays, center = ray_grid(SIZE), source.from_reference.translation
    along = rays @ center
    ranges = along + np.sqrt(along**2 - center @ center + radius**2)
    return replace(source, range_map=seen(ranges.astype(np.float32)))


def test_what_all_sources_agree_on_must_match_better(scene: Scene) -> None:
    picture, truth, sources = scene
    false = [shell_around_reference(source, 0.8) for source in sources]
    assert np.quantile(truth, 0.01) > 0.9
    changed = exchange_ranges(seen(truth), picture, false)[0].range != truth
    # Beside edges and on plain surfaces, windows cannot tell.
    assert changed[on_a_surface(truth)].mean() < 0.1
    assert exchange_ranges(seen(truth), picture, false, agreement=10)[1] > 0.5


def test_confirmed_pixels_stay_whatever_other_sources_agree_on(scene: Scene) -> None:
    picture, truth, sources = scene
    views = [sources[0], *(shell_around_reference(source, 0.8) for source in sources[1:])]
    settings: dict[str, Any] = {"min_agreeing": 2, "agreement": 10, "max_relative_error": 0.05}
    judged = on_a_surface(truth) & np.isfinite(
        project_range_map(sources[0].range_map, sources[0].from_reference, SIZE)[0]
    )
    kept, lost = (
        (exchange_ranges(seen(truth), picture, views, min_support=least, **settings)[0].range == truth)[judged].mean()
        for least in (0.3, 2.0)
    )
    assert kept > 0.8
    assert lost < 0.3


def test_nothing_is_taken_over_where_sources_agree_with_the_pixel(scene: Scene) -> None:
    """With so large an error all agree, but for what nearer surfaces hide."""
    wrong = seen((1.3 * scene[1]).astype(np.float32))
    assert exchanged(scene, wrong, max_reprojection_px=40, max_relative_error=0.5, min_support=0.5)[1] < 0.01
    assert exchanged(scene, wrong)[1] > 0.1


def test_normals_come_along(scene: Scene) -> None:
    truth = scene[1]
    wrong = (1.4 * truth).astype(np.float32)
    up = np.broadcast_to(np.array([0, -1, 0], np.float16), (*SIZE, 3)).copy()
    found, _ = exchanged(scene, seen(wrong, up))
    changed = found.range != wrong
    assert changed.mean() > 0.2
    assert np.isnan(known(found.normals_in_cam)[changed]).all()  # those of the sources are unknown
    np.testing.assert_array_equal(known(found.normals_in_cam)[~changed], up[~changed])
    found.check()


def test_pixels_without_a_range_stay_so(scene: Scene) -> None:
    wrong = seen((1.4 * scene[1]).astype(np.float32))
    wrong.range[20:30], wrong.confidence[20:30] = np.nan, 0
    found, _ = exchanged(scene, wrong)
    assert np.isnan(found.range[20:30]).all()
    found.check()


def test_inputs_that_do_not_fit_are_refused(scene: Scene) -> None:
    picture, truth, sources = scene
    with pytest.raises(UsageError, match="at least one source"):
        exchange_ranges(seen(truth), picture, [])
    with pytest.raises(UsageError, match="must have the size of its range map"):
        exchange_ranges(seen(truth), picture[:, :64], sources)
    with pytest.raises(UsageError, match="source 1: image, mask and range map differ in size"):
        exchange_ranges(seen(truth), picture, [sources[0], replace(sources[1], picture=picture[:, :64])])
    with pytest.raises(UsageError, match="min_agreeing"):
        exchange_ranges(seen(truth), picture, sources, min_agreeing=0)


@pytest.mark.parametrize(("width", "degrees"), [(512, 360 / 512), (2048, 0.35)])
def test_the_larger_of_the_two_limits_of_the_reprojection_counts(
    monkeypatch: pytest.MonkeyPatch, width: int, degrees: float
) -> None:
    """A pixel is a smaller angle in a large panorama, but poses and stitching are no more accurate there."""

    def compared(*_: object, max_angle: float, **__: object) -> None:
        raise RuntimeError(f"compared within {np.degrees(max_angle):.4f}°")

    monkeypatch.setattr("pano_mvs.algorithms.patchmatch.exchange.compare_with_sources", compared)
    size = (width // 2, width)
    plain = RangeMap(np.ones(size, np.float32), np.full(size, 100, np.uint8))
    picture = np.zeros((*size, 3), np.uint8)
    source = SourceView(picture, plain, Rigid3(np.eye(3), np.ones(3)))
    with pytest.raises(RuntimeError, match=f"compared within {degrees:.4f}°"):
        exchange_ranges(plain, picture, [source])


POSES = capture_poses(4, seed=1, spread=0.4)
FILLED = 40


@pytest.fixture(scope="module")
def truth() -> list[NDArray[np.float32]]:
    room = default_room()
    return [room_range(room, pose, SIZE) for pose in POSES]


@pytest.fixture(scope="module")
def sources(truth: list[NDArray[np.float32]]) -> list[RangeMap]:
    return [as_map(ranges, TRUSTED) for ranges in truth[1:]]


def corrected(range_map: RangeMap, sources: list[RangeMap], **settings: Any) -> tuple[RangeMap, float, float]:
    return respect_free_space(range_map, POSES[0], sources, source_poses=POSES[1:], **settings)


def scattered(share: float) -> NDArray[np.bool_]:
    wanted: NDArray[np.bool_] = np.random.default_rng(2).random(SIZE) < share
    return wanted


def test_ranges_that_others_see_through_are_removed(truth: list[NDArray[np.float32]], sources: list[RangeMap]) -> None:
    wrong = scattered(0.2)
    result, hidden, removed = corrected(as_map(np.where(wrong, 0.6, 1) * truth[0]), sources)
    result.check()
    assert (~result.valid)[wrong].mean() > 0.9
    assert result.valid[~wrong].mean() > 0.97
    assert removed == pytest.approx((~result.valid).mean())
    assert hidden < 0.03


def test_ranges_behind_a_confirmed_point_take_its_range(
    truth: list[NDArray[np.float32]], sources: list[RangeMap]
) -> None:
    wrong = scattered(0.2)
    result, hidden, _ = corrected(as_map(np.where(wrong, 1.7, 1) * truth[0]), sources)
    error = np.abs(result.range / truth[0] - 1)
    assert np.nanmean(error[wrong] < 0.05) > 0.8
    moved = wrong & (error < 0.5)
    assert hidden == pytest.approx(moved.mean(), abs=0.03)
    assert (result.confidence[moved] == 127).all()


def test_only_unconfirmed_pixels_that_were_seen_are_changed(
    truth: list[NDArray[np.float32]], sources: list[RangeMap]
) -> None:
    wrong = np.where(scattered(0.5), 0.6, 1.7).astype(np.float32) * truth[0]
    for confidence in (TRUSTED, FILLED):
        result, hidden, removed = corrected(as_map(wrong, confidence), sources)
        np.testing.assert_array_equal(result.range, wrong)
        np.testing.assert_array_equal(result.confidence, confidence)
        assert hidden == removed == 0


def test_unconfirmed_pixels_of_sources_are_no_evidence(truth: list[NDArray[np.float32]]) -> None:
    wrong = np.where(scattered(0.5), 0.6, 1.7).astype(np.float32) * truth[0]
    result, *shares = corrected(as_map(wrong), [as_map(ranges, SEEN) for ranges in truth[1:]])
    np.testing.assert_array_equal(result.range, wrong)
    assert shares == [0, 0]


def test_a_source_that_agrees_outweighs_one_that_sees_through(truth: list[NDArray[np.float32]]) -> None:
    """With as many sources on either side, the pixel keeps its range."""
    agrees, sees_through = as_map(truth[1], TRUSTED), as_map(2 * truth[2], TRUSTED)
    kept, alone = (
        respect_free_space(as_map(truth[0]), POSES[0], views, source_poses=poses, max_hole_deg=0)[0].valid
        for views, poses in (([agrees, sees_through], POSES[1:3]), ([sees_through], POSES[2:3]))
    )
    assert kept.mean() > 0.9
    assert alone.mean() < 0.5


def test_no_pixel_is_removed_where_no_filter_fills_the_hole(
    truth: list[NDArray[np.float32]], sources: list[RangeMap]
) -> None:
    rows = np.arange(SIZE[0]) < SIZE[0] // 4
    near = as_map(np.where(rows[:, None], 0.6, 1) * truth[0])
    assert corrected(near, sources)[0].valid[rows].mean() > 0.9
    assert corrected(near, sources, max_hole_deg=0)[0].valid[rows].mean() < 0.1


def test_the_order_of_the_sources_does_not_matter(truth: list[NDArray[np.float32]], sources: list[RangeMap]) -> None:
    wrong = as_map(np.where(scattered(0.5), 0.6, 1.7) * truth[0])
    result = corrected(wrong, sources)[0]
    other = respect_free_space(wrong, POSES[0], sources[::-1], source_poses=POSES[:0:-1])[0]
    np.testing.assert_array_equal(result.range, other.range)


def test_sources_and_poses_must_match(truth: list[NDArray[np.float32]], sources: list[RangeMap]) -> None:
    with pytest.raises(UsageError, match="3 source range maps but 2 poses"):
        respect_free_space(as_map(truth[0]), POSES[0], sources, source_poses=POSES[1:3])


def test_without_sources_nothing_changes(truth: list[NDArray[np.float32]]) -> None:
    result, *shares = respect_free_space(as_map(truth[0]), POSES[0], [], source_poses=[])
    np.testing.assert_array_equal(result.range, truth[0])
    assert shares == [0, 0]
