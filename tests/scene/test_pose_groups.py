"""Groups of cameras: split, join, and one function for each."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from pano_mvs.core.errors import ContractError, RunStoppedError, UsageError
from pano_mvs.geometry import angle_between
from pano_mvs.scene import Poses
from pano_mvs.scene.pose_groups import join_groups, per_group, require_two_cameras, split_groups, with_cameras
from tests.scene.pose_groups import drawn_group
from tests.scene.test_kinds import assert_same

_LARGE = drawn_group(("b.jpg", "d.jpg", "e.jpg"), seed=1)
_SMALL = drawn_group(("a.jpg", "c.jpg"), seed=2)
_ORDER = ("a.jpg", "b.jpg", "c.jpg", "d.jpg", "e.jpg", "f.jpg")


def _joined() -> Poses:
    return join_groups([_SMALL, _LARGE], order=_ORDER, rejected={"f.jpg": "blurred", "a.jpg": "not any more"})


def test_joined_cameras_are_in_the_order_of_the_capture_and_the_largest_group_is_first() -> None:
    joined = _joined()
    joined.check()
    assert joined.names == _ORDER[:5]
    assert joined.groups.tolist() == [1, 0, 1, 0, 0]
    assert [world.frame for world in joined.worlds] == ["frame 1", "frame 2"]
    assert [world.metric for world in joined.worlds] == [True, False]
    assert joined.rejected == {"f.jpg": "blurred"}
    assert joined.doubts == {"c.jpg": "doubt 2", "e.jpg": "doubt 1"}
    assert {name: row["share"] for name, row in joined.evidence.items()} == {"a.jpg": 2.0, "b.jpg": 1.0}


def test_of_two_groups_of_one_size_the_one_with_the_earliest_image_is_first() -> None:
    other = drawn_group(("b.jpg", "e.jpg"), seed=3)
    assert join_groups([other, _SMALL], order=_ORDER).frame == _SMALL.frame


def test_every_observation_still_points_at_its_point() -> None:
    joined = _joined()
    rays = joined.points_in_world[joined.track_point_idx] - joined.centers[joined.track_image_idx]
    seen = np.einsum("nij,nj->ni", joined.rotations[joined.track_image_idx], rays)
    assert angle_between(seen, joined.track_bearings).max() < 1e-6


def test_split_gives_back_what_was_joined() -> None:
    large, small = split_groups(_joined())
    assert_same(large, _LARGE)
    assert_same(small, _SMALL)


def test_groups_survive_the_form_in_which_they_are_stored() -> None:
    joined = _joined()
    assert_same(Poses.from_parts(joined.to_parts()), joined)
    meta = joined.to_parts()["meta"]
    assert isinstance(meta, dict)
    as_read = meta | {"other_worlds": [list(world) for world in joined.other_worlds]}
    assert_same(Poses.from_parts({**joined.to_parts(), "meta": as_read}), joined)


def test_what_only_one_group_knows_is_unknown_of_the_other() -> None:
    joined = join_groups([_LARGE, replace(_SMALL, center_stds=None)], order=_ORDER)
    assert joined.center_stds is not None
    assert _LARGE.center_stds is not None
    assert np.isnan(joined.center_stds[[0, 2]]).all()
    np.testing.assert_array_equal(joined.center_stds[[1, 3, 4]], _LARGE.center_stds)
    assert joined.confirmed_shares is None


def test_one_group_is_passed_on_as_it_is() -> None:
    assert split_groups(_LARGE) == [_LARGE]
    assert per_group(_LARGE, lambda poses: poses) is _LARGE
    assert_same(join_groups([_LARGE]), _LARGE)
    assert join_groups([_LARGE], order=_ORDER).track_bearings is _LARGE.track_bearings
    backwards = join_groups([_LARGE], order=tuple(reversed(_ORDER)))
    assert backwards.names == tuple(reversed(_LARGE.names))
    np.testing.assert_array_equal(backwards.rotations, _LARGE.rotations[::-1])


def test_per_group_treats_each_group_alone_and_joins_what_comes_out() -> None:
    seen = []

    def moved(group: Poses) -> Poses:
        seen.append(group.names)
        return replace(group, frame=f"moved {group.frame}", rejected={"x.jpg": group.frame})

    treated = per_group(_joined(), moved)
    assert seen == [_LARGE.names, _SMALL.names]
    assert [world.frame for world in treated.worlds] == ["moved frame 1", "moved frame 2"]
    assert treated.rejected == {"f.jpg": "blurred", "x.jpg": "frame 2"}


def test_a_camera_that_is_left_alone_is_rejected_and_an_empty_group_is_forgotten() -> None:
    alone = drawn_group(("c.jpg",), seed=4)
    empty = Poses.without_points({}, frame="", scale="", metric=False, rejected={"a.jpg": "too few points"})
    joined = join_groups([_LARGE, alone, empty], order=_ORDER)
    assert joined.names == _LARGE.names
    assert joined.group_idx is None
    assert joined.rejected.keys() == {"a.jpg", "c.jpg"}
    joined.check()


def test_groups_that_cannot_be_joined_are_refused() -> None:
    with pytest.raises(UsageError, match="no group"):
        join_groups([])
    with pytest.raises(UsageError, match="split it first"):
        join_groups([_joined()])
    with pytest.raises(UsageError, match="in two groups"):
        join_groups([_LARGE, _LARGE])
    with pytest.raises(UsageError, match=r"does not have 'a\.jpg'"):
        join_groups([_SMALL], order=("b.jpg",))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"group_idx": np.array([0, 1, 0, 1, 1], np.int32)}, "largest"),
        ({"group_idx": np.array([2, 0, 2, 0, 0], np.int32)}, "worlds"),
        ({"group_idx": np.array([-1, 0, -1, 0, 0], np.int32)}, "negative"),
        ({"group_idx": None}, "no groups"),
        ({"group_idx": np.array([1, 0, 0, 0, 1], np.int32)}, "seen from two groups"),
    ],
)
def test_groups_that_do_not_fit_break_the_contract(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ContractError, match=message):
        replace(_joined(), **changes).check()


def test_points_that_a_single_camera_is_left_of_go_with_the_others() -> None:
    large = replace(
        _LARGE,
        track_point_idx=_LARGE.track_point_idx[10:],
        track_image_idx=_LARGE.track_image_idx[10:],
        track_bearings=_LARGE.track_bearings[10:],
        track_sigmas_rad=None,
    )
    kept = with_cameras(large, np.array([True, True, False]))
    kept.check()
    assert kept.names == _LARGE.names[:2]
    np.testing.assert_array_equal(kept.points_in_world, _LARGE.points_in_world[10:])
    assert len(kept.track_point_idx) == 2 * 20
    assert with_cameras(large, np.ones(3, np.bool_)) is large


def test_one_camera_is_no_model() -> None:
    require_two_cameras(_SMALL)
    alone = with_cameras(replace(_SMALL, rejected={"c.jpg": "blurred"}), np.array([True, False]))
    with pytest.raises(RunStoppedError, match=r"no two panoramas .* no model\. Walk\. c\.jpg: blurred$"):
        require_two_cameras(alone, remedy="Walk")
