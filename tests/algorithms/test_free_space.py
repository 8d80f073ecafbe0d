"""Unconfirmed ranges are corrected where they contradict confirmed ones of other views, and nowhere else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.patchmatch.exchange import respect_free_space
from pano_mvs.core.errors import UsageError
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import capture_poses, default_room
from tests.algorithms.range_scenes import SEEN, TRUSTED, as_map, room_range

SIZE = (64, 128)
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
