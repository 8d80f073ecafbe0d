"""Several resolutions: what shows only noise has the range of a coarser one, and nothing else changes."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.patchmatch.second_round import refine_at_scale
from pano_mvs.algorithms.scales import (
    coarser_levels,
    enlarged_range_map,
    ranges_of_levels,
    reduced,
    reduced_range_map,
    with_coarser,
    without_detail,
)
from pano_mvs.scene import RangeMap
from pano_mvs.testing.scenes import weak_room

SIZE = (128, 256)


def _picture(*, noise: float = 2.0) -> NDArray[np.uint8]:
    """Return noise, with sharp texture in the right half."""
    rng = np.random.default_rng(5)
    grey = np.full(SIZE, 120.0)
    grey[:, SIZE[1] // 2 :] += rng.normal(0, 25, (SIZE[0], SIZE[1] // 2))
    grey += rng.normal(0, noise, SIZE)
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
    plain = without_detail(_picture(noise=noise))
    assert plain[10:118, 10:118].mean() > 0.99
    assert plain[10:118, 138:246].mean() < 0.01


def test_painted_areas_without_any_noise_do_not_hide_that_of_the_others() -> None:
    picture = _picture()
    picture[:, :40] = 255
    plain = without_detail(picture)
    assert plain[10:118, 60:118].mean() > 0.99
    assert plain[10:118, 138:246].mean() < 0.01


def test_only_what_was_seen_and_shows_noise_takes_the_coarser_range() -> None:
    fine, coarse, picture = _map(2.0, SIZE), _map(3.0, (64, 128), confidence=120), _picture()
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
    pictures = [_picture(), cv2.resize(_picture(), (128, 64), interpolation=cv2.INTER_AREA)]
    pictures[0][:, 138:] = 120  # of the texture, only the half at the coarser level is left
    found = ranges_of_levels(
        2, pictures.__getitem__, lambda level: _map(1.0 + level, (SIZE[0] >> level, SIZE[1] >> level))
    )
    np.testing.assert_allclose(found.range[20:100, 20:110], 3.0, rtol=1e-6)
    np.testing.assert_allclose(found.range[20:100, 160:240], 2.0, rtol=1e-6)


def test_refined_ranges_without_detail_come_from_the_coarser_size() -> None:
    scene = weak_room(views=2, turned=False)
    views = [scene.view(idx, SIZE, supersample=1) for idx in range(2)]
    rng = np.random.default_rng(0)
    # Texture in the left half, and noise that drowns that of the other half.
    noise = np.where(np.arange(SIZE[1])[:, None] < SIZE[1] // 2, 0.5, 6.0)
    pictures = [np.clip(np.rint(one + rng.normal(0, noise, one.shape)), 0, 255).astype(np.uint8) for one, _ in views]
    true = views[0][1]
    ranges = true * np.exp(0.02 * rng.normal(size=true.shape)).astype(np.float32)
    given = RangeMap(ranges, np.full(SIZE, 100, np.uint8))
    given.confidence[40:44, 30:40] = 5
    others: dict[str, Any] = {
        "source_from_reference": [scene.poses[1] @ scene.poses[0].inverse()],
        "source_masks": [np.ones(SIZE, np.bool_)],
        "rounds": 1,
    }
    fine, both = (
        refine_at_scale(given, pictures[0], pictures[1:], halvings=0, levels=levels, **others) for levels in (0, 1)
    )
    small, masks = reduced(pictures, [np.ones(SIZE, np.bool_)], halvings=1)
    others["source_masks"] = masks
    coarse = refine_at_scale(reduced_range_map(given, halvings=1), small[0], small[1:], halvings=0, **others)
    both.check()
    plain = without_detail(pictures[0])
    plain[40:44, 30:40] = False
    assert 0.1 < plain.mean() < 0.9
    np.testing.assert_array_equal(both.confidence, given.confidence)
    np.testing.assert_array_equal(both.range[~plain], fine.range[~plain])
    np.testing.assert_array_equal(both.range[plain], enlarged_range_map(coarse, SIZE).range[plain])
