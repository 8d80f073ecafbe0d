from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep import limits
from pano_mvs.algorithms.sweep.hypotheses import range_limits
from pano_mvs.algorithms.sweep.limits import limits_by_sweeping
from pano_mvs.algorithms.sweep.sweep import sweep_range
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, roll_panorama
from pano_mvs.scene import RangeMap
from pano_mvs.testing.paint import Texture
from pano_mvs.testing.room import capture_poses, default_room, render
from pano_mvs.testing.scenes import desk
from tests.synthetic.places import plain_table

Capture = tuple[list[NDArray[np.uint8]], list[Rigid3], list[NDArray[np.float32]]]

SIZE_HW = (96, 192)


@pytest.fixture(scope="module")
def capture() -> Capture:
    poses = capture_poses(4, spread=0.4)
    views = [render(default_room(), pose, SIZE_HW) for pose in poses]
    return [image for image, _ in views], poses, [truth for _, truth in views]


def no_masks(count: int) -> list[NDArray[np.bool_]]:
    return [np.ones(SIZE_HW, np.bool_)] * count


def mean_baseline(poses: Sequence[Rigid3]) -> float:
    return float(np.mean([np.linalg.norm(pose.center - poses[0].center) for pose in poses[1:]]))


def test_limits_hold_what_there_is_without_wasting_planes(capture: Capture) -> None:
    pictures, poses, truth = capture
    near, far = limits_by_sweeping(pictures, poses, masks=no_masks(4))
    nearest, farthest = np.nanquantile(truth[0], [0.01, 0.99])
    assert min(nearest / 3, 0.4 * mean_baseline(poses)) < near < nearest
    assert farthest < far < 3 * farthest


@pytest.mark.parametrize("top", ["strong", "weak"])
def test_the_near_limit_reaches_a_desk_within_the_baseline(top: Texture) -> None:
    scene = desk(seed=3, views=4, reach=1.6, top=top)
    views = [scene.view(idx, SIZE_HW, supersample=1) for idx in range(4)]
    near, _ = limits_by_sweeping([image for image, _ in views], scene.poses, masks=no_masks(4))
    nearest = np.nanmin(views[0][1])
    assert nearest < 0.4 * mean_baseline(scene.poses)
    assert 0.4 * nearest < near < nearest


def test_something_near_is_possible_where_nothing_near_agrees(capture: Capture) -> None:
    """A surface without texture, which no small sweep finds, may still be as near as half a baseline."""
    pictures, poses, _ = capture
    assert limits_by_sweeping(pictures, poses, masks=no_masks(4))[0] <= 0.5 * mean_baseline(poses)


@pytest.fixture(scope="module")
def table() -> Capture:
    """Pictures of a table without much texture, the last one first."""
    scene = plain_table(seed=0, views=4, height=0.35)
    views = [scene.view(idx, SIZE_HW, supersample=1) for idx in (3, 0, 1, 2)]
    return [image for image, _ in views], [scene.poses[idx] for idx in (3, 0, 1, 2)], [truth for _, truth in views]


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


def test_limits_follow_the_unit_of_length(capture: Capture) -> None:
    pictures, poses, _ = capture
    longer = [Rigid3(pose.rotation, 4 * pose.translation) for pose in poses]
    near, far = limits_by_sweeping(pictures, poses, masks=no_masks(4))
    assert limits_by_sweeping(pictures, longer, masks=no_masks(4)) == pytest.approx((4 * near, 4 * far))


def test_rolling_all_pictures_changes_nothing(capture: Capture) -> None:
    pictures, poses, _ = capture
    rolled = [roll_panorama(picture, 48) for picture in pictures]
    turned = [
        Rigid3(new_from_old @ pose.rotation, new_from_old @ pose.translation)
        for (_, new_from_old), pose in zip(rolled, poses, strict=True)
    ]
    expected = limits_by_sweeping(pictures, poses, masks=no_masks(4))
    assert limits_by_sweeping([picture for picture, _ in rolled], turned, masks=no_masks(4)) == expected


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
