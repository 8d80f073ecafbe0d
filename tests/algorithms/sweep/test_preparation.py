"""What happens to pictures and masks before they are compared."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.exposure import KnownPixels, match_exposure, shrink
from pano_mvs.algorithms.sweep.preparation import pixels_with_valid_window, prepare_picture
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.windows import column_offsets, column_stretch
from pano_mvs.geometry import Rigid3, pad_panorama
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
