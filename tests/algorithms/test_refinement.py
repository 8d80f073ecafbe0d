"""Slanted planes: the compiled passes equal the plain ones, and what a sweep bends and quantises comes out straight."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.supported import has_texture
from pano_mvs.algorithms.patchmatch import kernels_match, kernels_refine
from pano_mvs.algorithms.patchmatch.refine import (
    ViewWeights,
    _range_map_from_planes,
    plain_and_changed,
    reference_arrays,
    refine_plain_surfaces,
    refine_range,
    source_arrays,
    swept_limits,
)
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.algorithms.sweep.windows import column_offsets, column_stretch
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pad_panorama, pixel_from_ray, ray_from_pixel, ray_grid, roll_panorama
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room, render
from pano_mvs.testing.room import noise as solid_noise
from tests.algorithms.range_scenes import SEEN, TRUSTED, as_map
from tests.known import known
from tests.oracles import range_filters as oracle

Views = tuple[list[NDArray[np.uint8]], list[NDArray[np.float32]], list[Rigid3]]

SIZE = (160, 320)
FLOOR_Y = 1.3
LUMA = np.array([0.2126, 0.7152, 0.0722])
SETTINGS = (0.2, 40.0, 900.0, 10.0, 0.05)


@pytest.fixture(scope="module")
def views() -> Views:
    """Pictures, true ranges and poses of three cameras in the room."""
    poses = capture_poses(3, seed=1, spread=0.4)
    pictures, truth = zip(*(render(default_room(), pose, SIZE, supersample=1) for pose in poses), strict=True)
    return list(pictures), list(truth), poses


@pytest.fixture(scope="module")
def swept(views: Views) -> RangeMap:
    pictures, _, poses = views
    relative = [pose @ poses[0].inverse() for pose in poses[1:]]
    return sweep_range(pictures[0], pictures[1:], relative, near=0.6, far=6, settings=SweepSettings(planes=48))


def refined(
    views: tuple[Sequence[NDArray[np.uint8]], Sequence[NDArray[np.float32]], Sequence[Rigid3]],
    range_map: RangeMap,
    **settings: Any,
) -> RangeMap:
    pictures, _, poses = views
    relative = [pose @ poses[0].inverse() for pose in poses[1:]]
    return refine_range(range_map, pictures[0], pictures[1:], source_from_reference=relative, **settings)


@pytest.fixture(scope="module")
def result(views: Views, swept: RangeMap) -> RangeMap:
    return refined(views, swept)


def floor_of(truth: NDArray[np.float32], pose: Rigid3) -> NDArray[np.bool_]:
    """The pixels of view that lie well on the floor, and below the camera not right on the nadir."""

    points = pose.inverse().apply(ray_grid(SIZE) * truth[..., None])
    on = np.abs(points[..., 1] - FLOOR_Y) < 1e-3
    inner = on.copy()
    for shift in range(-4, 5):
        inner &= np.roll(on, shift, 1) & np.roll(on, shift, 0)
    return inner


def little_picture(rng: np.random.Generator, size: tuple[int, int]) -> NDArray[np.uint8]:
    """A picture of smooth colours that goes on over seam and poles."""

    rays = ray_grid(size).reshape(-1, 3)
    channels = [solid_noise(rays, cells=((0.35, 60.0),), seed=int(rng.integers(1000))) for _ in range(3)]
    return np.clip(128 + np.stack(channels, -1), 0, 255).astype(np.uint8).reshape(*size, 3)


@pytest.mark.kernel("patchmatch.kernels_match")
def test_packed_patches_hold_four_grey_levels_over_the_seam_and_the_poles() -> None:
    picture = np.random.default_rng(7).integers(0, 256, (6, 12, 3)).astype(np.uint8)
    grey = pad_panorama(np.rint(256 * (picture @ LUMA)).astype(np.uint64), 1)
    packed = kernels_match.pack_grey(picture)
    assert packed.shape == (7, 13)
    for shift, part in ((0, grey[:-1, :-1]), (16, grey[1:, :-1]), (32, grey[:-1, 1:]), (48, grey[1:, 1:])):
        np.testing.assert_array_equal(packed >> np.uint64(shift) & np.uint64(65535), part)


@pytest.mark.kernel("patchmatch.kernels_match")
def test_padded_pictures_hold_the_same_patches_and_votes() -> None:
    rng = np.random.default_rng(8)
    picture, votes = rng.integers(0, 256, (6, 12, 3)).astype(np.uint8), rng.random((6, 12)) < 0.7
    padded = np.empty((8, 14), np.uint16)
    kernels_match.pad_grey(picture, votes, padded)
    places = [(row, column) for row in range(7) for column in range(13)]
    index, patches = np.array([14 * row + column for row, column in places], np.int32), np.empty(91, np.uint64)
    kernels_match.gather_grey(padded.ravel(), 0, 14, index, patches)
    packed, around = kernels_match.pack_grey(picture), pad_panorama(votes, 1)
    for (row, column), place, patch in zip(places, index, patches, strict=True):
        four = [(int(which[row, column]) >> shift) & 65535 for which in (packed,) for shift in (0, 16, 32, 48)]
        mine = [(int(patch) >> shift) & 65535 for shift in (0, 16, 32, 48)]
        np.testing.assert_allclose(mine, four, atol=1)
        agreed = bool(around[row : row + 2, column : column + 2].all())
        assert kernels_match.may_count(padded.ravel(), int(place), 14) == agreed


@pytest.mark.kernel("patchmatch.kernels_refine")
def test_compiled_planes_equal_least_squares() -> None:
    rng = np.random.default_rng(0)
    size, radius, max_step = (12, 24), 2, 0.05
    inverse = (0.5 * (1 + 0.03 * rng.normal(size=size))).astype(np.float32)
    inverse[rng.random(size) < 0.1] *= 2
    inverse[rng.random(size) < 0.1] = np.nan
    offsets, stretches = column_offsets(size, radius, spherical=True), column_stretch(size[0], spherical=True)
    planes = np.full((3, *size), 9, np.float32)
    kernels_refine.fit_planes(inverse, 0, 5, offsets, stretches, max_step, planes, (0, 12))
    kernels_refine.fit_planes(inverse, 5, 7, offsets, stretches, max_step, planes, (0, 12))
    for row, column in np.ndindex(size):
        expected = np.zeros(3)
        if np.isfinite(inverse[row, column]):
            expected = oracle.plane_at(
                inverse.astype(float), row, column, offsets[row], float(stretches[row]), max_step
            )
        np.testing.assert_allclose(planes[:, row, column], expected, rtol=2e-4, atol=2e-5)


@pytest.mark.slow
@pytest.mark.kernel("patchmatch.kernels_refine", "patchmatch.kernels_match")
@pytest.mark.parametrize("weighted", [False, True])
def test_compiled_steps_equal_normal_equations(weighted: bool) -> None:
    """With sources of other sizes, a mask, planes of all slants, over the seam and over the poles."""
    rng = np.random.default_rng(1)
    size = (16, 32)
    reference = little_picture(rng, size)
    poses = [capture_poses(2, seed=seed, tilt_deg=50)[1] for seed in (3, 4)]
    sources = [little_picture(rng, (18, 36)), little_picture(rng, size)]
    mask = np.ones(size, np.bool_)
    mask[:, :16] = False
    offsets, stretches = column_offsets(size, 4, spherical=True)[:, ::2].copy(), column_stretch(size[0], spherical=True)
    inverse = rng.uniform(0.3, 0.6, size).astype(np.float32)
    planes = np.empty((3, *size), np.float32)
    near_offsets = column_offsets(size, 3, spherical=True)
    kernels_refine.fit_planes(inverse, 0, 16, near_offsets, stretches, 0.2, planes, (0, 16))
    found = np.empty(size, np.float32)
    numbers = (np.float32(1 / 25), np.float32(SETTINGS[0]), *SETTINGS[1:4], np.float32(SETTINGS[4]))
    arrays = (reference_arrays(reference, offsets, stretches), source_arrays(sources, poses, [None, mask], reach=0.0))
    shares = rng.uniform(0.1, 1, (2, *size)).astype(np.float32)
    kernels_refine.refine_rows(0, 16, planes, *arrays, numbers, weighted, found, correlations := shares.copy(), (0, 16))
    grey = [np.rint(256 * (picture @ LUMA)) / 256 for picture in sources]
    rows, off = (-4, -2, 0, 2, 4), []
    for row, column in np.ndindex(size):
        places, values, weights = oracle.window(
            (reference @ LUMA).astype(np.float32), row, column, rows, offsets[row], sigma_color=25
        )
        plane = planes[:, row, column].astype(float)
        votes = oracle_votes(plane, row, column, size, poses[1], mask)
        steps = np.array([(u / stretches[row], v) for v in rows for u in offsets[row]])
        expected = oracle.likely_inverse(
            plane,
            (size, places, values, weights),
            [(grey[0], poses[0], True), (grey[1], poses[1], votes)],
            steps,
            SETTINGS,
            shares[:, row, column].tolist() if weighted else None,
        )
        assert (correlations[1, row, column] == -2) == (not votes)
        off.append(abs(found[row, column] - expected) / SETTINGS[4])
    # Slopes between pixels jump: where a sample lies on a pixel's centre both sides are right.
    assert np.quantile(off, 0.98) < 2e-3
    assert np.ptp(found / inverse) > 0.05
    assert -1.001 < correlations[0].min() < correlations[0].max() < 1.001


def oracle_votes(
    plane: NDArray[np.float64], row: int, column: int, size: tuple[int, int], pose: Rigid3, mask: NDArray[np.bool_]
) -> bool:
    """Whether all four pixels around the place where a source sees the pixel may vote."""

    ray = ray_from_pixel([column + 0.5, row + 0.5], size)
    x, y = pixel_from_ray(pose.rotation @ ray + pose.translation * (plane @ ray), size)
    left, top = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
    return bool(pad_panorama(mask, 1)[top : top + 2, left : left + 2].all())


def test_a_slanted_floor_comes_out_straight_with_its_normal(views: Views, swept: RangeMap, result: RangeMap) -> None:
    _, truth, poses = views
    floor = floor_of(truth[0], poses[0]) & swept.valid
    assert floor.mean() > 0.1
    before, after = (np.abs(m.range - truth[0])[floor] / truth[0][floor] for m in (swept, result))
    assert np.median(after) < 0.4 * np.median(before)
    assert np.mean(after > 0.02) <= np.mean(before > 0.02) + 0.01
    up = poses[0].rotation @ [0, -1, 0]
    angle = np.degrees(np.arccos(np.clip(known(result.normals_in_cam)[floor].astype(float) @ up, -1, 1)))
    assert np.median(angle) < 3
    result.check()


def test_everything_else_gets_better_too(views: Views, swept: RangeMap, result: RangeMap) -> None:
    _, truth, _ = views
    before, after = (np.abs(m.range - truth[0]) / truth[0] for m in (swept, result))
    assert np.median(after) < 0.5 * np.median(before)
    # Pixels are wide here: beside edges, windows reach over them, and some pixels are lost.
    assert np.mean(after < 0.05) > np.mean(before < 0.05) - 0.02
    np.testing.assert_array_equal(result.confidence, swept.confidence)


def test_true_ranges_stay(views: Views) -> None:
    _, truth, _ = views
    true_map = RangeMap(truth[0], np.full(SIZE, 100, np.uint8))
    after = refined(views, true_map)
    assert np.median(np.abs(after.range - truth[0]) / truth[0]) < 4e-3


def test_exposure_changes_little(views: Views, swept: RangeMap, result: RangeMap) -> None:
    pictures, truth, poses = views
    darker = [pictures[0], *(np.rint(0.8 * p + 10).astype(np.uint8) for p in pictures[1:])]
    other = refined((darker, truth, poses), swept)
    assert np.median(np.abs(other.range / result.range - 1)) < 5e-4


@pytest.mark.parametrize("columns", [1, 77, 160])
def test_rolling_all_pictures_rolls_the_result(views: Views, swept: RangeMap, result: RangeMap, columns: int) -> None:
    pictures, truth, poses = views
    rolled = [roll_panorama(picture, columns) for picture in pictures]
    turned = [Rigid3(new_from_old, np.zeros(3)) @ pose for (_, new_from_old), pose in zip(rolled, poses, strict=True)]
    before = RangeMap(np.roll(swept.range, columns, 1), np.roll(swept.confidence, columns, 1))
    after = refined(([picture for picture, _ in rolled], truth, turned), before)
    difference = np.abs(after.range / np.roll(result.range, columns, 1) - 1)
    assert np.nanquantile(difference, 0.999) < 1e-3


def test_any_number_of_threads_gives_the_same_bytes(views: Views, swept: RangeMap, result: RangeMap) -> None:
    numba = pytest.importorskip("numba")
    before = numba.get_num_threads()
    numba.set_num_threads(1)
    try:
        other = refined(views, swept)
    finally:
        numba.set_num_threads(before)
    assert other.range.tobytes() == result.range.tobytes()
    assert known(other.normals_in_cam).tobytes() == known(result.normals_in_cam).tobytes()


def test_filled_and_invalid_pixels_stay_as_they_are(views: Views, swept: RangeMap, result: RangeMap) -> None:
    ranges, confidence = swept.range.copy(), swept.confidence.copy()
    ranges[40:60, 300:] = np.nan
    confidence[40:60, 300:] = 0
    ranges[100:120, :30], confidence[100:120, :30] = 1.0, 30
    after = refined(views, RangeMap(ranges, confidence))
    after.check()
    assert np.isnan(after.range[40:60, 300:]).all()
    np.testing.assert_array_equal(after.range[100:120, :30], 1.0)
    assert np.isnan(known(after.normals_in_cam)[100:120, :30]).all()
    # Nothing that lies out of the reach of windows has changed.
    np.testing.assert_array_equal(after.range[70:90, 100:200], result.range[70:90, 100:200])


def test_masked_sources_have_no_vote(views: Views, swept: RangeMap) -> None:
    """A source that shows something else does no harm behind its mask, and does without."""
    pictures, truth, poses = views
    spoilt = pictures[1].copy()
    spoilt[:, :160] = np.random.default_rng(0).integers(0, 256, (SIZE[0], 160, 3))
    mask = np.ones(SIZE, np.bool_)
    mask[:, :160] = False
    other = pictures[0], spoilt, pictures[2]
    hidden = refined((other, truth, poses), swept, source_masks=[mask, None])
    plain = refined((pictures, truth, poses), swept, source_masks=[mask, None])
    assert np.mean(np.abs(hidden.range / plain.range - 1) > 1e-4) < 0.02
    one = refined((pictures, truth, poses), swept)
    assert np.mean(np.abs(one.range / plain.range - 1) > 1e-4) > 0.1


def test_no_rounds_only_lay_planes_and_no_source_in_sight_changes_little(views: Views, swept: RangeMap) -> None:
    planes = refined(views, swept, rounds=0)
    blind = refined(views, swept, rounds=1, source_masks=[np.zeros(SIZE, np.bool_)] * 2)
    assert np.nanmedian(np.abs(planes.range / blind.range - 1)) < 2e-3


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"source_masks": [None]}, "one pose"),
        ({"source_masks": [None, np.ones((3, 4), np.bool_)]}, "source 1: its mask"),
    ],
)
def test_impossible_settings_are_named(views: Views, swept: RangeMap, change: dict[str, Any], said: str) -> None:
    with pytest.raises(UsageError, match=said):
        refined(views, swept, **change)


def test_impossible_pictures_are_named(views: Views, swept: RangeMap) -> None:
    pictures, _, poses = views
    with pytest.raises(UsageError, match="one pose"):
        refine_range(swept, pictures[0], pictures[1:], source_from_reference=poses[1:2])
    with pytest.raises(UsageError, match="size of its range map"):
        refine_range(swept, pictures[0][:80], pictures[1:], source_from_reference=poses[1:])
    with pytest.raises(UsageError, match=r"source 0: refinement needs \(H, W, 3\) uint8"):
        refine_range(swept, pictures[0], [pictures[1][..., 0]], source_from_reference=poses[1:2])
    with pytest.raises(UsageError, match="same place"):
        refine_range(swept, pictures[0], pictures[1:2], source_from_reference=[Rigid3.identity()])


def test_planes_that_meet_their_rays_far_beyond_what_was_swept_are_not_believed() -> None:
    """A plane nearly along its ray once sent pixels ten times as far as the sweep had looked."""
    rays = ray_grid((16, 32))
    swept = RangeMap(np.full((16, 32), 2, np.float32), np.full((16, 32), 100, np.uint8))
    planes = np.moveaxis(rays / 2.2, -1, 0).astype(np.float32)
    planes[:, 3, 4] /= 20
    planes[:, 5, 6] *= 20
    limits, rays = swept_limits(swept), ray_grid((16, 32))
    found = _range_map_from_planes(planes, swept, np.ones((16, 32), np.bool_), limits=limits, rays=rays)
    assert found.range[3, 4] == found.range[5, 6] == 2
    assert np.isnan(known(found.normals_in_cam)[[3, 5], [4, 6]].astype(float)).all()
    assert np.sum(np.isclose(found.range, 2.2)) == 16 * 32 - 2


TINY = (12, 24)


def test_weights_are_the_matches_around_over_the_best_one() -> None:
    rng = np.random.default_rng(0)
    rounds = rng.uniform(-1, 1, (2, 3, *TINY)).astype(np.float32)
    rounds[:, 2, :, :9] = -2  # does not count there
    weights = ViewWeights(3, TINY)
    for correlations in rounds:
        weights.views[:] = correlations
        weights.update()
    match = np.where(rounds > -1.5, np.exp(-((1 - rounds) ** 2) / (2 * 0.3**2)), 0).mean(axis=0)
    padded = np.stack([pad_panorama(one, 2) for one in match])
    around = np.lib.stride_tricks.sliding_window_view(padded, (5, 5), axis=(1, 2)).mean(axis=(-1, -2))
    np.testing.assert_allclose(weights.views, (around / around.max(axis=0)) ** 2, rtol=1e-4, atol=1e-6)
    assert weights.known
    assert np.all(weights.views.max(axis=0) == 1)
    assert not weights.views[2, 3:-3, 3:6].any()  # away from the poles, where columns from across count


def test_where_no_source_counts_none_has_weight() -> None:
    weights = ViewWeights(2, TINY)
    weights.views[:] = -2
    weights.update()
    assert not weights.views.any()


def test_a_source_that_shows_something_else_does_less_harm() -> None:
    """Two of three sources are turned by four pixels: the better half still contains one of them."""
    size = (96, 192)
    poses = capture_poses(4, seed=2, spread=0.3)
    pictures, truth = zip(*(render(default_room(), pose, size, supersample=1) for pose in poses), strict=True)
    spoilt = [pictures[1], *(np.roll(picture, 4, axis=1) for picture in pictures[2:])]
    off = np.float32(1) + np.random.default_rng(0).normal(0, 0.01, size).astype(np.float32)
    start = RangeMap(truth[0] * off, np.full(size, 100, np.uint8))

    def median_error(*, view_weights: bool) -> float:
        found = refine_range(
            start,
            pictures[0],
            spoilt,
            source_from_reference=[pose @ poses[0].inverse() for pose in poses[1:]],
            view_weights=view_weights,
        )
        return float(np.median(np.abs(found.range / truth[0] - 1)))

    assert median_error(view_weights=True) < 0.9 * median_error(view_weights=False)


SMALL = (64, 128)
FaintViews = tuple[list[NDArray[np.uint8]], NDArray[np.float32], list[Rigid3]]


@pytest.fixture(scope="module")
def faint_views() -> FaintViews:
    """Faint pictures of the room, its true ranges in the first view, and the poses of the others."""
    poses = capture_poses(3, seed=2, spread=0.4)
    rendered = [render(default_room(), pose, SMALL, supersample=1) for pose in poses]
    faint = [np.rint(100 + 0.06 * picture.astype(float)).astype(np.uint8) for picture, _ in rendered]
    return faint, rendered[0][1], [pose @ poses[0].inverse() for pose in poses[1:]]


def again(
    faint_views: FaintViews, range_map: RangeMap, filtered: RangeMap, *, reference: NDArray[np.uint8] | None = None
) -> tuple[RangeMap, float]:
    pictures, _, poses = faint_views
    masks = [np.ones(SMALL, np.bool_) for _ in poses]
    settings: dict[str, Any] = {"source_from_reference": poses, "source_masks": masks, "halvings": 0, "rounds": 2}
    first = pictures[0] if reference is None else reference
    return refine_plain_surfaces(range_map, filtered, first, sources=pictures[1:], **settings)


def test_plain_surfaces_start_from_the_filtered_ranges(faint_views: FaintViews) -> None:
    truth = faint_views[1]
    swept, filtered = as_map(1.3 * truth), as_map(1.03 * truth, TRUSTED)
    found, share = again(faint_views, swept, filtered)
    found.check()
    assert share == 1
    assert np.median(np.abs(found.range / truth - 1)) < 0.02
    assert (found.confidence == SEEN).all()
    assert found.normals_in_cam is not None


def test_pixels_with_texture_keep_their_ranges(faint_views: FaintViews) -> None:
    truth = faint_views[1]
    reference = faint_views[0][0].copy()
    reference[:, 40:50:2] = 255
    textured = has_texture(reference)
    assert 0.05 < textured.mean() < 0.2
    found, share = again(faint_views, as_map(1.3 * truth), as_map(truth), reference=reference)
    np.testing.assert_array_equal(found.range[textured], (1.3 * truth).astype(np.float32)[textured])
    assert (found.range != 1.3 * truth)[~textured].all()
    assert share == pytest.approx(1 - textured.mean())


def test_pixels_that_filters_did_not_change_or_that_were_not_seen_stay(faint_views: FaintViews) -> None:
    truth = faint_views[1]
    changed = np.arange(SMALL[1]) < 64
    confidence = np.where(np.arange(SMALL[0]) < 32, SEEN, 40)[:, None] * np.ones(SMALL[1], int)
    swept = as_map(1.3 * truth, confidence)
    filtered = as_map(np.where(changed, truth, swept.range))
    chosen = plain_and_changed(swept, filtered, faint_views[0][0])
    np.testing.assert_array_equal(chosen, changed & (confidence == SEEN))
    found = again(faint_views, swept, filtered)[0]
    np.testing.assert_array_equal(found.range[~chosen], swept.range[~chosen])


def test_the_sky_of_the_filtered_map_loses_its_ranges(faint_views: FaintViews) -> None:
    truth = faint_views[1]
    sky = np.zeros(SMALL, np.bool_)
    sky[:8] = True
    filtered = as_map(np.where(sky, np.nan, truth))
    found = again(faint_views, as_map(1.3 * truth), RangeMap(filtered.range, filtered.confidence, sky=sky))[0]
    found.check()
    np.testing.assert_array_equal(found.valid, ~sky)
    assert found.sky is not None
    assert found.sky.sum() == sky.sum()


def test_range_maps_of_two_sizes_are_refused(faint_views: FaintViews) -> None:
    with pytest.raises(UsageError, match="must have one size"):
        again(faint_views, as_map(faint_views[1]), as_map(faint_views[1][:32]))
