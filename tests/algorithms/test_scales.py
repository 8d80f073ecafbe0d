"""The resolutions at which panoramas are matched: blur and noise lower them, and ranges survive the way."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.patchmatch.refine import refine_at_scale, refine_range
from pano_mvs.algorithms.scales import (
    coarser_levels,
    enlarged_range_map,
    ranges_of_levels,
    reduced,
    reduced_range_map,
    sharp_halvings,
    with_coarser,
    without_detail,
)
from pano_mvs.geometry import Rigid3, pad_panorama
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import default_room
from tests.algorithms.range_scenes import as_map, room_range
from tests.synthetic.scenes import weak_room

SIZE = (512, 1024)


def _picture(sigma_px: float, *, noise: float = 1.5) -> NDArray[np.uint8]:
    """Return a panorama with details of all sizes of equal contrast, over plain quarters, after a blur."""
    rng = np.random.default_rng(3)
    picture = np.zeros(SIZE)
    for size in (1, 2, 4, 8, 16, 32):
        grains = rng.normal(0, 12, (SIZE[0] // size, SIZE[1] // size))
        picture += cv2.resize(grains, SIZE[::-1], interpolation=cv2.INTER_NEAREST)
    picture[:, : SIZE[1] // 4] = 0
    if sigma_px:
        picture = cv2.GaussianBlur(pad_panorama(picture, 16), (0, 0), sigma_px)[16:-16, 16:-16]
    picture = 128 + picture[..., None] + rng.normal(0, noise, (*SIZE, 1)).repeat(3, axis=-1)
    return np.clip(np.rint(picture), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("noise", [0.0, 3.0])
@pytest.mark.parametrize(("sigma_px", "halvings"), [(0.0, 0), (0.5, 0), (1.5, 1), (2.5, 1)])
def test_blur_lowers_the_scale_whatever_the_noise(sigma_px: float, halvings: int, noise: float) -> None:
    assert sharp_halvings(_picture(sigma_px, noise=noise)) == halvings


def test_an_enlarged_panorama_is_as_sharp_as_before() -> None:
    large = cv2.resize(_picture(0.0), (2048, 1024), interpolation=cv2.INTER_CUBIC)
    assert sharp_halvings(large) == 1
    assert sharp_halvings(cv2.resize(large, (4096, 2048), interpolation=cv2.INTER_CUBIC)) == 2


def test_small_odd_and_empty_panoramas_keep_their_size() -> None:
    soft = _picture(2.5)
    assert sharp_halvings(soft[::2, ::2]) == 0
    assert sharp_halvings(soft[:511]) == 0
    assert sharp_halvings(np.zeros((*SIZE, 3), np.uint8)) == 0


def test_sources_follow_the_reference() -> None:
    pictures = [np.zeros((h, 2 * h, 3), np.uint8) for h in (64, 128, 16)]
    masks = [np.ones((h, 2 * h), np.bool_) for h in (64, 128, 16)]
    masks[0][10, 20] = False
    same, _ = reduced(pictures, masks, halvings=0)
    assert [one.shape[1] for one in same] == [128, 256, 32]
    small, small_masks = reduced(pictures, masks, halvings=1)
    assert [one.shape[1] for one in small] == [64, 64, 32]
    assert [mask.shape for mask in small_masks] == [one.shape[:2] for one in small]
    assert np.argwhere(~small_masks[0]).tolist() == [[5, 10]]


def test_ranges_survive_the_way_there_and_back() -> None:
    size = (128, 256)
    true = as_map(room_range(default_room(), Rigid3.identity(), size))
    true.range[3:9, 5:30] = np.nan
    true.confidence[3:9, 5:30] = 0
    assert enlarged_range_map(true, size) is true
    small = reduced_range_map(true, halvings=1)
    assert small.range.shape == (64, 128)
    back = enlarged_range_map(small, size)
    back.check()
    with np.errstate(invalid="ignore"):
        error = np.abs(back.range / true.range - 1)
    assert (back.valid == true.valid).mean() > 0.99
    assert np.nanmedian(error) < 1e-3
    assert np.nanquantile(error, 0.9) < 0.025
    # Every range is that of a pixel nearby or between such: no surface halfway between two others.
    around = np.lib.stride_tricks.sliding_window_view(pad_panorama(true.range, 2), (5, 5)).reshape(*size, 25)
    nearest = np.abs(back.range[..., None] / np.where(np.isnan(around), np.inf, around) - 1).min(axis=-1)
    assert np.quantile(nearest[back.valid], 0.999) < 0.03


def test_of_two_surfaces_the_block_shows_one() -> None:
    ranges = np.full((16, 32), 2.0, np.float32)
    ranges[:, 1::2] = 3.0
    small = reduced_range_map(RangeMap(ranges, np.full((16, 32), 90, np.uint8)), halvings=1)
    np.testing.assert_allclose(small.range, 3.0)
    assert (small.confidence == 90).all()


def test_refinement_begins_at_the_reduced_size_and_keeps_what_has_no_range() -> None:
    scene = weak_room(views=3, turned=False)
    views = [scene.view(idx, (128, 256), supersample=1) for idx in range(3)]
    pictures, true = [picture for picture, _ in views], views[0][1]
    poses = [pose @ scene.poses[0].inverse() for pose in scene.poses[1:]]
    masks = [np.ones((128, 256), np.bool_)] * 2
    ranges = true * np.exp(0.02 * np.random.default_rng(1).normal(size=true.shape)).astype(np.float32)
    ranges[20:24, 30:40] = np.nan
    confidence = np.where(np.isnan(ranges), 0, 100).astype(np.uint8)
    confidence[40:44, 30:40] = 5
    given = RangeMap(ranges, confidence)
    found = [
        refine_at_scale(
            given, pictures[0], pictures[1:], source_from_reference=poses, halvings=count, source_masks=masks, rounds=2
        )
        for count in (0, 1)
    ]
    plain = refine_range(given, pictures[0], pictures[1:], source_from_reference=poses, source_masks=masks, rounds=2)
    np.testing.assert_array_equal(found[0].range, plain.range)
    assert not np.array_equal(found[1].range, plain.range)
    for one in found:
        one.check()
        np.testing.assert_array_equal(one.valid, given.valid)
        np.testing.assert_array_equal(one.confidence, confidence)
        np.testing.assert_array_equal(one.range[40:44, 30:40], ranges[40:44, 30:40])
        assert np.nanmedian(np.abs(one.range / true - 1)) < 0.75 * np.nanmedian(np.abs(ranges / true - 1))


HALF_SIZE = (128, 256)


def _half_textured(*, noise: float = 2.0) -> NDArray[np.uint8]:
    """Return noise, with sharp texture in the right half."""
    rng = np.random.default_rng(5)
    grey = np.full(HALF_SIZE, 120.0)
    grey[:, HALF_SIZE[1] // 2 :] += rng.normal(0, 25, (HALF_SIZE[0], HALF_SIZE[1] // 2))
    grey += rng.normal(0, noise, HALF_SIZE)
    levels: NDArray[np.uint8] = np.clip(np.rint(grey), 0, 255).astype(np.uint8)
    return levels[..., None].repeat(3, axis=-1)


def _map(value: float, size_hw: tuple[int, int], *, confidence: int = 90) -> RangeMap:
    normals = np.zeros((*size_hw, 3), np.float16)
    normals[..., int(value) % 3] = 1
    return RangeMap(np.full(size_hw, value, np.float32), np.full(size_hw, confidence, np.uint8), normals)


@pytest.mark.parametrize(
    ("width", "levels"), [(512, 0), (1024, 0), (2046, 0), (2048, 1), (4096, 2), (5376, 2), (8192, 3), (16384, 3)]
)
def test_levels_have_1024_columns_or_more(width: int, levels: int) -> None:
    assert coarser_levels((width // 2, width)) == levels


def test_sizes_that_cannot_be_halved_have_no_coarser_level() -> None:
    assert coarser_levels((1025, 2050)) == 0
    assert coarser_levels((1026, 2052)) == 1


@pytest.mark.parametrize("noise", [1.0, 4.0])
def test_noise_is_no_detail_however_strong_it_is(noise: float) -> None:
    plain = without_detail(_half_textured(noise=noise))
    assert plain[10:118, 10:118].mean() > 0.99
    assert plain[10:118, 138:246].mean() < 0.01


def test_painted_areas_without_any_noise_do_not_hide_that_of_the_others() -> None:
    picture = _half_textured()
    picture[:, :40] = 255
    plain = without_detail(picture)
    assert plain[10:118, 60:118].mean() > 0.99
    assert plain[10:118, 138:246].mean() < 0.01


def test_only_what_was_seen_and_shows_noise_takes_the_coarser_range() -> None:
    fine, coarse, picture = _map(2.0, HALF_SIZE), _map(3.0, (64, 128), confidence=120), _half_textured()
    fine.confidence[20:24, 20:40] = 5  # filled
    fine.range[40:44, 20:40] = np.nan
    fine.confidence[40:44, 20:40] = 0
    coarse.range[30:32, 10:20] = np.nan
    found = with_coarser(fine, coarse, picture)
    found.check()
    plain = without_detail(picture)
    kept = ~plain
    kept[20:24, 20:40] = kept[40:44, 20:40] = kept[60:64, 20:40] = True
    np.testing.assert_array_equal(found.range[kept], fine.range[kept])
    np.testing.assert_array_equal(found.confidence[kept], fine.confidence[kept])
    np.testing.assert_allclose(found.range[~kept], 3.0, rtol=1e-6)
    assert (found.confidence[~kept] == 120).all()
    assert found.normals_in_cam is not None
    np.testing.assert_array_equal(found.normals_in_cam[..., 2] == 1, kept)


def test_levels_are_joined_from_the_coarsest_to_the_finest() -> None:
    pictures = [_half_textured(), cv2.resize(_half_textured(), (128, 64), interpolation=cv2.INTER_AREA)]
    pictures[0][:, 138:] = 120  # of the texture, only the half at the coarser level is left
    found = ranges_of_levels(
        2, pictures.__getitem__, lambda level: _map(1.0 + level, (HALF_SIZE[0] >> level, HALF_SIZE[1] >> level))
    )
    np.testing.assert_allclose(found.range[20:100, 20:110], 3.0, rtol=1e-6)
    np.testing.assert_allclose(found.range[20:100, 160:240], 2.0, rtol=1e-6)


def test_refined_ranges_without_detail_come_from_the_coarser_size() -> None:
    scene = weak_room(views=2, turned=False)
    views = [scene.view(idx, HALF_SIZE, supersample=1) for idx in range(2)]
    rng = np.random.default_rng(0)
    # Texture in the left half, and noise that drowns that of the other half.
    noise = np.where(np.arange(HALF_SIZE[1])[:, None] < HALF_SIZE[1] // 2, 0.5, 6.0)
    pictures = [np.clip(np.rint(one + rng.normal(0, noise, one.shape)), 0, 255).astype(np.uint8) for one, _ in views]
    true = views[0][1]
    ranges = true * np.exp(0.02 * rng.normal(size=true.shape)).astype(np.float32)
    given = RangeMap(ranges, np.full(HALF_SIZE, 100, np.uint8))
    given.confidence[40:44, 30:40] = 5
    others: dict[str, Any] = {
        "source_from_reference": [scene.poses[1] @ scene.poses[0].inverse()],
        "source_masks": [np.ones(HALF_SIZE, np.bool_)],
        "rounds": 1,
    }
    fine, both = (
        refine_at_scale(given, pictures[0], pictures[1:], halvings=0, levels=levels, **others) for levels in (0, 1)
    )
    small, masks = reduced(pictures, [np.ones(HALF_SIZE, np.bool_)], halvings=1)
    others["source_masks"] = masks
    coarse = refine_at_scale(reduced_range_map(given, halvings=1), small[0], small[1:], halvings=0, **others)
    both.check()
    plain = without_detail(pictures[0])
    plain[40:44, 30:40] = False
    assert 0.1 < plain.mean() < 0.9
    np.testing.assert_array_equal(both.confidence, given.confidence)
    np.testing.assert_array_equal(both.range[~plain], fine.range[~plain])
    np.testing.assert_array_equal(both.range[plain], enlarged_range_map(coarse, HALF_SIZE).range[plain])
