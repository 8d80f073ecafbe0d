"""What happens to pictures and masks before they are compared.

A cropped panorama gives what the whole one gives, wherever both see.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.features.sphorb import extract_sphorb
from pano_mvs.algorithms.features.tangent import extract_orb, extract_sift
from pano_mvs.algorithms.sweep.exposure import KnownPixels, match_exposure, shrink
from pano_mvs.algorithms.sweep.preparation import pixels_with_valid_window, prepare_picture
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.sweep import sweep_range
from pano_mvs.algorithms.sweep.windows import column_offsets, column_stretch
from pano_mvs.geometry import Rigid3, pad_panorama, pixel_from_ray, ray_grid
from pano_mvs.scene import Features, FilePart, Panorama
from pano_mvs.scene.image_file import write_png
from pano_mvs.scene.masking import Crop
from pano_mvs.testing.room import capture_poses, default_room, render

Pair = tuple[NDArray[np.uint8], NDArray[np.uint8], Rigid3, NDArray[np.float32]]


@pytest.fixture(scope="module")
def pair() -> Pair:
    poses = capture_poses(2, seed=8)
    (first, ranges), (second, _) = (render(default_room(2), pose, (64, 128)) for pose in poses)
    return first, second, poses[1] @ poses[0].inverse(), ranges


@pytest.mark.parametrize(("gain", "offset"), [(1.0, 0.0), (1.12, 6.0), (0.8, -4.0)])
def test_the_exposure_is_found_although_a_third_of_the_ranges_is_wrong(pair: Pair, gain: float, offset: float) -> None:
    first, second, pose, ranges = pair
    reference = np.clip(np.rint(gain * first + offset), 0, 255).astype(np.uint8)
    wrong = np.random.default_rng(0).random(ranges.shape) < 1 / 3
    found = match_exposure(second, pose, KnownPixels.of(reference, np.where(wrong, 0.5, ranges).astype(np.float32)))
    np.testing.assert_allclose(found.gain, gain, atol=0.05)
    middle = found.gain * 110 + found.offset
    np.testing.assert_allclose(middle, gain * 110 + offset, atol=2.5)


def test_the_same_exposure_is_found_to_be_the_same(pair: Pair) -> None:
    """What a lookup between pixels takes of a source's contrast was once taken for a gain of 1.03."""
    first, second, pose, ranges = pair
    rng = np.random.default_rng(0)
    noisy = np.clip(np.rint(second + rng.normal(0, 2, second.shape)), 0, 255).astype(np.uint8)
    np.testing.assert_array_equal(match_exposure(noisy, pose, KnownPixels.of(first, ranges)).apply(noisy), noisy)


def test_an_exposure_that_cannot_be_known_is_left_alone(pair: Pair) -> None:
    first, second, pose, ranges = pair
    nowhere = np.full_like(ranges, np.nan)
    assert match_exposure(second, pose, KnownPixels.of(first, nowhere)).gain.tolist() == [1, 1, 1]
    plain = np.full_like(first, 90)
    assert match_exposure(plain, pose, KnownPixels.of(plain, ranges)).offset.tolist() == [0, 0, 0]
    unrelated = np.random.default_rng(1).integers(0, 256, first.shape, dtype=np.uint8)
    np.testing.assert_array_equal(
        match_exposure(unrelated, pose, KnownPixels.of(first, ranges)).apply(unrelated), unrelated
    )


def test_a_masked_source_does_not_spoil_the_exposure(pair: Pair) -> None:
    first, second, pose, ranges = pair
    spoilt, mask = second.copy(), np.ones(second.shape[:2], np.bool_)
    mask[20:] = False
    spoilt[20:] = 255 - spoilt[20:]
    found = match_exposure(spoilt, pose, KnownPixels.of(first, ranges), source_mask=mask)
    np.testing.assert_allclose(found.gain, 1, atol=0.08)


def test_shrinking_averages_whole_blocks() -> None:
    picture = np.random.default_rng(2).integers(0, 256, (48, 96, 3), dtype=np.uint8)
    assert shrink(picture, 16).shape == (16, 32, 3)
    assert shrink(picture, 16)[0, 0].tolist() == np.rint(picture[:3, :3].mean(axis=(0, 1))).tolist()
    assert shrink(picture, 47) is not None
    np.testing.assert_array_equal(shrink(picture, 100), picture)


def test_a_pixel_votes_if_its_whole_window_is_valid_over_seam_and_pole() -> None:
    mask = np.ones((32, 64), np.bool_)
    mask[16, 0] = mask[0, 5] = False
    votes = pixels_with_valid_window(mask, 2)
    assert not votes[14:19, [62, 63, 0, 1, 2]].any()
    assert votes[16, [61, 3]].all()
    assert not votes[:2, 5 + 32].any()  # beyond the pole, half a turn further on
    assert pixels_with_valid_window(~mask, 1).sum() == 0


def test_a_valid_window_holds_no_masked_pixel() -> None:
    rng = np.random.default_rng(3)
    mask = rng.random((32, 64)) > 0.01
    votes = pixels_with_valid_window(mask, 2)
    offsets = column_offsets((32, 64), 2, spherical=True)
    padded = pad_panorama(mask, 16)
    for row, column in np.argwhere(votes):
        for rows in range(-2, 3):
            assert padded[row + 16 + rows, column + 16 + offsets[row]].all()


def test_census_compares_grey_and_differences_compare_colours(pair: Pair) -> None:
    first = pair[0]
    grey = prepare_picture(first, SweepSettings())
    assert grey.shape == (64, 128, 1)
    assert np.abs(grey[..., 0] - first @ np.array([0.2126, 0.7152, 0.0722])).max() < 1.5
    np.testing.assert_array_equal(prepare_picture(first, SweepSettings(cost="sad")), first)


def test_the_prefilter_knows_no_seam(pair: Pair) -> None:
    settings = SweepSettings(cost="sad", prefilter_diameter=5)
    filtered = prepare_picture(pair[0], settings)
    assert (filtered != pair[0]).any()
    np.testing.assert_array_equal(
        prepare_picture(np.roll(pair[0], 40, axis=1), settings), np.roll(filtered, 40, axis=1)
    )


def test_windows_keep_their_angle_until_the_cap() -> None:
    stretch = column_stretch(180, spherical=True)
    assert stretch[90] == pytest.approx(1, abs=1e-3)
    assert stretch[29] == pytest.approx(2, rel=0.02)  # 60° up
    assert stretch.max() == 8
    assert (column_stretch(180, spherical=False) == 1).all()
    offsets = column_offsets((16, 32), 7, spherical=True)
    assert offsets.shape == (16, 15)
    assert np.abs(offsets).max() <= 8
    np.testing.assert_array_equal(offsets, -offsets[:, ::-1])


SIZE_HW = (128, 256)
CROPS = {"without poles": (0, 16, 256, 96), "narrow": (32, 20, 180, 88), "off the middle": (5, 40, 251, 77)}
MARGIN_PX = 16

Views = list[tuple[NDArray[np.uint8], NDArray[np.float32], Rigid3]]


@pytest.fixture(scope="module")
def views() -> Views:
    """Three pictures that look the same way, their true ranges, and their poses."""
    centers = np.array([(0.0, 0.0, 0.0), (0.3, 0.05, 0.0), (-0.1, -0.05, 0.35)])
    poses = [Rigid3.from_center(np.eye(3), center) for center in centers]
    return [(*render(default_room(), pose, SIZE_HW, supersample=1), pose) for pose in poses]


def panorama(folder: Path, picture: NDArray[np.uint8], crop: tuple[int, int, int, int] | None) -> Panorama:
    left, top, width, height = crop or (0, 0, SIZE_HW[1], SIZE_HW[0])
    path = folder / f"{len(list(folder.iterdir()))}.png"
    write_png(path, np.ascontiguousarray(picture[top : top + height, left : left + width]))
    return Panorama(FilePart(path), SIZE_HW, SIZE_HW, crop)


def swept(panoramas: list[Panorama], poses: list[Rigid3], settings: SweepSettings) -> NDArray[np.float32]:
    return sweep_range(
        panoramas[0].load(),
        [source.load() for source in panoramas[1:]],
        [pose @ poses[0].inverse() for pose in poses[1:]],
        near=0.5,
        far=8,
        settings=settings,
        reference_mask=panoramas[0].load_mask(),
        source_masks=[source.load_mask() for source in panoramas[1:]],
    ).range


def inside(pixels: NDArray[np.float64], crop: tuple[int, int, int, int]) -> NDArray[np.bool_]:
    left, top, width, height = crop
    rows = (pixels[..., 1] >= top + MARGIN_PX) & (pixels[..., 1] <= top + height - MARGIN_PX)
    columns = (pixels[..., 0] >= left + MARGIN_PX) & (pixels[..., 0] <= left + width - MARGIN_PX)
    return np.asarray(rows & (columns | (width == SIZE_HW[1])))


@pytest.mark.parametrize("cost", ["sad", *(pytest.param(cost, marks=pytest.mark.slow) for cost in ("census", "zncc"))])
@pytest.mark.parametrize("crop", CROPS.values(), ids=list(CROPS))
@pytest.mark.parametrize("cropped_sources", [False, True], ids=["reference", "all"])
def test_ranges_are_those_of_the_whole_panorama(
    tmp_path: Path, views: Views, cost: str, crop: Crop, cropped_sources: bool
) -> None:
    settings = SweepSettings(planes=32, cost=cost, aggregation="box")
    pictures, truths, poses = zip(*views, strict=True)
    whole = swept([panorama(tmp_path, picture, None) for picture in pictures], list(poses), settings)
    parts = [panorama(tmp_path, p, crop if not idx or cropped_sources else None) for idx, p in enumerate(pictures)]
    part = swept(parts, list(poses), settings)
    rays = ray_grid(SIZE_HW)
    seen = inside(pixel_from_ray(rays, SIZE_HW), crop)
    assert np.isnan(part[~parts[0].load_mask()]).all()
    if cropped_sources:
        for pose in poses[1:]:
            points = (pose @ poses[0].inverse()).apply(rays * truths[0][..., None])
            seen &= inside(pixel_from_ray(points, SIZE_HW), crop)
    assert seen.mean() > 0.1
    with np.errstate(invalid="ignore"):
        same = (np.abs(part / whole - 1) < 1e-3) | (np.isnan(part) & np.isnan(whole))
    assert same[seen].mean() >= 0.99, same[seen].mean()


@pytest.mark.parametrize(("extract", "clear_px"), [(extract_sift, 2), (extract_orb, 12), (extract_sphorb, 15)])
def test_key_points_are_those_of_the_whole_panorama(
    tmp_path: Path, views: Views, extract: Callable[..., Any], clear_px: int
) -> None:
    """None is on the edge of the crop, and nearly all small ones that lie well inside are found again."""
    picture, (left, top, width, height) = views[0][0], CROPS["narrow"]
    part, whole = (panorama(tmp_path, picture, crop) for crop in (CROPS["narrow"], None))
    found, wanted = (extract(shown.load(), shown.load_mask(), max_keypoints=4000) for shown in (part, whole))
    assert clear_of(found, (left, top, width, height)).min() > clear_px
    small = wanted.sizes_rad < np.quantile(wanted.sizes_rad, 0.6)
    inner = small & (clear_of(wanted, (left, top, width, height)) > 32)
    nearest = (wanted.bearings[inner] @ found.bearings.T).max(axis=1)
    assert inner.sum() > 20
    assert (nearest > np.cos(0.1 * np.pi / SIZE_HW[0])).mean() > 0.9


def clear_of(found: Features, crop: tuple[int, int, int, int]) -> NDArray[np.float64]:
    """Return how many pixels within a crop each key point lies, (N,); negative outside."""
    pixels, (left, top, width, height) = pixel_from_ray(found.bearings, SIZE_HW), crop
    sides = np.minimum(pixels - (left, top), (left + width, top + height) - pixels)
    return np.asarray(sides.min(axis=1), np.float64)
