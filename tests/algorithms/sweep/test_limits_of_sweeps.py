"""Depth hypotheses, their limits, and pixels without a match: the sky, and what ran to a limit by chance."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep import limits
from pano_mvs.algorithms.sweep.hypotheses import Spacing, range_at, range_limits, virtual_ranges
from pano_mvs.algorithms.sweep.limits import limits_by_sweeping
from pano_mvs.algorithms.sweep.preparation import is_bare
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, roll_panorama
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import Texture, capture_poses, default_room, render
from tests.synthetic.places import plain_table
from tests.synthetic.scenes import courtyard, desk

SPACINGS = ("parallax", "inverse", "log", "uniform")


@given(
    near=st.floats(1e-3, 1e3), ratio=st.floats(1.01, 1e4), planes=st.integers(3, 300), spacing=st.sampled_from(SPACINGS)
)
def test_virtual_ranges_ascend_from_near_to_far(near: float, ratio: float, planes: int, spacing: Spacing) -> None:
    ranges = virtual_ranges(near, near * ratio, planes=planes, spacing=spacing, baseline=2.0)
    assert ranges.shape == (planes,)
    assert ranges[0] == pytest.approx(near)
    assert ranges[-1] == pytest.approx(near * ratio)
    assert (np.diff(ranges) > 0).all()


@pytest.mark.parametrize(("spacing", "even"), [("inverse", np.reciprocal), ("log", np.log), ("uniform", np.array)])
def test_virtual_ranges_are_even_in_what_the_spacing_names(spacing: Spacing, even: Callable[..., Any]) -> None:
    steps = np.diff(even(virtual_ranges(0.3, 9.0, planes=50, spacing=spacing)))
    np.testing.assert_allclose(steps, steps[0])


def test_parallax_is_even_in_inverse_range_far_away_and_in_log_range_nearby() -> None:
    near, far, baseline = 0.05, 50.0, 1.0
    ranges = virtual_ranges(near, far, planes=200, spacing="parallax", baseline=baseline)
    distant, close = ranges > 10 * baseline, ranges < baseline / 10
    assert distant.sum() > 3
    assert close.sum() > 10
    np.testing.assert_allclose(np.diff(1 / ranges[distant]), np.diff(1 / ranges)[-1], rtol=0.01)
    np.testing.assert_allclose(np.diff(np.log(ranges[close])), np.diff(np.log(ranges))[0], rtol=0.01)


def test_without_a_baseline_parallax_is_even_in_inverse_range() -> None:
    expected = virtual_ranges(0.3, 9.0, planes=50, spacing="inverse")
    np.testing.assert_array_equal(virtual_ranges(0.3, 9.0, planes=50, spacing="parallax"), expected)
    small = virtual_ranges(0.3, 9.0, planes=50, spacing="parallax", baseline=1e-4)
    np.testing.assert_allclose(small, expected, rtol=1e-6)


@pytest.mark.parametrize("limits", [(0.0, 1.0), (2.0, 1.0), (1.0, np.inf), (np.nan, 1.0)])
def test_limits_that_are_none_are_refused(limits: tuple[float, float]) -> None:
    with pytest.raises(UsageError, match="0 < near < far"):
        range_at([0.0], *limits, planes=8, spacing="inverse")


def test_the_baselines_and_the_resolution_decide() -> None:
    near, far = range_limits([0.0, 0.2, 1.0], width=1024)
    assert near == pytest.approx(0.3)
    parallax_px = np.arctan(1.0 / far) / (2 * np.pi / 1024)
    assert parallax_px == pytest.approx(0.5, rel=1e-3)
    assert range_limits([0.4, 2.0], width=1024) == pytest.approx((2 * near, 2 * far))


@pytest.mark.parametrize("baselines", [[], [0.0], [np.nan]])
def test_a_capture_from_one_place_is_refused(baselines: Sequence[float]) -> None:
    with pytest.raises(UsageError, match="all baselines are zero"):
        range_limits(baselines, width=1024)


Capture = tuple[list[NDArray[np.uint8]], list[Rigid3], list[NDArray[np.float32]]]

SIZE_HW = (96, 192)


@pytest.fixture(scope="module")
def capture() -> Capture:
    poses = capture_poses(4, spread=0.4)
    views = [render(default_room(), pose, SIZE_HW, supersample=1) for pose in poses]
    return [image for image, _ in views], poses, [truth for _, truth in views]


def no_masks(count: int) -> list[NDArray[np.bool_]]:
    return [np.ones(SIZE_HW, np.bool_)] * count


def mean_baseline(poses: Sequence[Rigid3]) -> float:
    return float(np.mean([np.linalg.norm(pose.center - poses[0].center) for pose in poses[1:]]))


@pytest.fixture(scope="module")
def capture_limits(capture: Capture) -> tuple[float, float]:
    pictures, poses, _ = capture
    return limits_by_sweeping(pictures, poses, masks=no_masks(4))


def test_limits_hold_what_there_is_without_wasting_planes(
    capture: Capture, capture_limits: tuple[float, float]
) -> None:
    _, poses, truth = capture
    near, far = capture_limits
    nearest, farthest = np.nanquantile(truth[0], [0.01, 0.99])
    assert min(nearest / 3, 0.4 * mean_baseline(poses)) < near < nearest
    assert farthest < far < 3 * farthest


@pytest.mark.slow
@pytest.mark.parametrize("top", ["strong", "weak"])
def test_the_near_limit_reaches_a_desk_within_the_baseline(top: Texture) -> None:
    scene = desk(seed=3, views=4, reach=1.6, top=top)
    views = [scene.view(idx, SIZE_HW, supersample=1) for idx in range(4)]
    near, _ = limits_by_sweeping([image for image, _ in views], scene.poses, masks=no_masks(4))
    nearest = np.nanmin(views[0][1])
    assert nearest < 0.4 * mean_baseline(scene.poses)
    assert 0.4 * nearest < near < nearest


def test_something_near_is_possible_where_nothing_near_agrees(
    capture: Capture, capture_limits: tuple[float, float]
) -> None:
    """A surface without texture, which no small sweep finds, may still be as near as half a baseline."""
    assert capture_limits[0] <= 0.5 * mean_baseline(capture[1])


@pytest.fixture(scope="module")
def table() -> Capture:
    """Pictures of a table without much texture, the last one first."""
    scene = plain_table(seed=0, views=4, height=0.35)
    views = [scene.view(idx, SIZE_HW, supersample=1) for idx in (3, 0, 1, 2)]
    return [image for image, _ in views], [scene.poses[idx] for idx in (3, 0, 1, 2)], [truth for _, truth in views]


@pytest.mark.slow
def test_the_near_limit_reaches_a_plain_table_nearer_than_all_textured_surfaces(
    table: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    pictures, poses, truth = table
    nearest = np.nanmin(truth[0])
    near, far = limits_by_sweeping(pictures, poses, masks=no_masks(4))
    assert 0.6 * nearest < near < nearest
    monkeypatch.setattr(limits, "_MIN_ENDED_SHARE", 1.0)
    textured, same_far = limits_by_sweeping(pictures, poses, masks=no_masks(4))
    assert textured > 1.2 * nearest
    assert same_far == far


@pytest.mark.slow
def test_the_near_limit_stays_where_lower_ones_do_not_help(table: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    """Plain pixels that end in the nearest planes of every sweep are there by chance."""
    pictures, poses, _ = table
    wide, tried = limits._NEAREST_BASELINES * 2 * mean_baseline(poses), []

    def ended(*args: Any, near: float, **settings: Any) -> RangeMap:
        found = sweep_range(*args, near=near, **settings)
        if near < wide:
            return found
        tried.append(near)
        return replace(found, range=np.full_like(found.range, near))

    monkeypatch.setattr(limits, "sweep_range", ended)
    near, _ = limits_by_sweeping(pictures, poses, masks=no_masks(4))
    assert near == tried[0]
    assert tried[-1] == pytest.approx(near / 4)


def test_limits_follow_the_unit_of_length(capture: Capture, capture_limits: tuple[float, float]) -> None:
    pictures, poses, _ = capture
    longer = [Rigid3(pose.rotation, 4 * pose.translation) for pose in poses]
    near, far = capture_limits
    assert limits_by_sweeping(pictures, longer, masks=no_masks(4)) == pytest.approx((4 * near, 4 * far))


def test_rolling_all_pictures_changes_nothing(capture: Capture, capture_limits: tuple[float, float]) -> None:
    pictures, poses, _ = capture
    rolled = [roll_panorama(picture, 48) for picture in pictures]
    turned = [
        Rigid3(new_from_old @ pose.rotation, new_from_old @ pose.translation)
        for (_, new_from_old), pose in zip(rolled, poses, strict=True)
    ]
    found = limits_by_sweeping([picture for picture, _ in rolled], turned, masks=no_masks(4))
    assert found == capture_limits


def test_pictures_that_agree_on_nothing_get_the_limits_of_the_cameras(capture: Capture) -> None:
    _, poses, _ = capture
    rng = np.random.default_rng(0)
    noise = [rng.integers(0, 255, (*SIZE_HW, 3), dtype=np.uint8) for _ in poses]
    dark = [np.zeros(SIZE_HW, np.bool_)] * 4
    baselines = [float(np.linalg.norm(pose.center - poses[0].center)) for pose in poses]
    assert limits_by_sweeping(noise, poses, masks=dark) == range_limits(baselines, width=SIZE_HW[1])


def test_a_reference_without_sources_is_refused(capture: Capture) -> None:
    pictures, poses, _ = capture
    with pytest.raises(UsageError, match="at least one source"):
        limits_by_sweeping(pictures[:1], poses[:1], masks=no_masks(1))


YARD_HW = 96, 192


@pytest.fixture(scope="module")
def outdoors() -> tuple[list[NDArray[np.uint8]], tuple[Rigid3, ...], NDArray[np.float32]]:
    scene = courtyard(seed=3, views=3)
    views = [scene.view(idx, YARD_HW, supersample=1) for idx in range(3)]
    return [picture for picture, _ in views], scene.poses, views[0][1]


def swept_between(
    pictures: Sequence[NDArray[np.uint8]], poses: Sequence[Rigid3], limits: tuple[float, float], **settings: Any
) -> RangeMap:
    relative = [pose @ poses[0].inverse() for pose in poses[1:]]
    return sweep_range(
        pictures[0],
        pictures[1:],
        relative,
        near=limits[0],
        far=limits[1],
        settings=SweepSettings(planes=64).replace(**settings),
    )


@pytest.mark.slow
def test_limits_outdoors_reach_as_far_as_the_pictures_can_tell(
    outdoors: tuple[list[NDArray[np.uint8]], list[Rigid3], NDArray[np.float32]],
) -> None:
    pictures, poses, truth = outdoors
    near, far = limits_by_sweeping(pictures, poses, masks=[np.ones(YARD_HW, np.bool_)] * 3)
    assert 0.1 * np.nanmin(truth) < near < np.nanquantile(truth, 0.02)
    assert far > np.nanmax(truth)


@pytest.mark.slow
def test_the_sky_is_invalid_and_the_court_is_not(
    outdoors: tuple[list[NDArray[np.uint8]], list[Rigid3], NDArray[np.float32]],
) -> None:
    pictures, poses, truth = outdoors
    limits = limits_by_sweeping(pictures, poses, masks=[np.ones(YARD_HW, np.bool_)] * 3)
    found, kept = swept_between(pictures, poses, limits), swept_between(pictures, poses, limits, no_match="keep")
    found.check()
    sky = np.isnan(truth)
    assert sky.mean() > 0.15
    assert np.isnan(found.range[sky]).mean() > 0.8
    assert np.isfinite(kept.range).all()
    right = ~sky & (np.abs(kept.range / truth - 1) < 0.1)
    assert right.sum() > 0.7 * (~sky).sum()
    assert np.isfinite(found.range[right]).mean() > 0.995


def test_no_wall_is_lost_indoors() -> None:
    poses = capture_poses(3, seed=2)
    views = [render(default_room(2, "weak"), pose, YARD_HW, supersample=1) for pose in poses]
    pictures = [picture for picture, _ in views]
    found = swept_between(pictures, poses, (0.5, 8.0))
    assert found.valid.mean() > 0.999


def test_bare_pixels_at_a_limit_are_invalid_and_textured_ones_are_not() -> None:
    """All planes cost the same on what is bare: the first of equals wins, by nothing but its place."""
    plain, pictures = np.full((32, 64, 3), 90, np.uint8), np.full((2, 32, 64, 3), 90, np.uint8)
    pictures[0, :, :20] = np.random.default_rng(0).integers(0, 256, (32, 20, 3))
    bare = is_bare(pictures[0])
    assert bare[3:-3, 24:60].all()
    assert not bare[:, 1:19].any()
    found = swept_between([pictures[0], plain], capture_poses(2, seed=1), (0.5, 8.0), aggregation="box")
    assert (found.valid == ~bare).all()


def test_a_plane_that_can_be_told_from_infinity_keeps_what_has_texture(
    outdoors: tuple[list[NDArray[np.uint8]], list[Rigid3], NDArray[np.float32]],
) -> None:
    pictures, poses, truth = outdoors
    near = swept_between(pictures, poses, (1.0, 20.0))
    beyond = truth > 30
    assert np.isfinite(near.range[beyond & ~is_bare(pictures[0])]).mean() > 0.95
