"""The rotations from the world to axes with z up and y up."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import Poses, WorldAxes
from pano_mvs.scene.pose_groups import join_groups, split_groups
from pano_mvs.scene.upright import (
    WORLD_UP,
    mean_up_direction,
    world_up,
    y_up_from_world,
    z_up_from_world,
)


def poses_with(
    rotations: list[np.ndarray], *, frame: str = "the first registered camera", axes: WorldAxes = WorldAxes.UNKNOWN
) -> Poses:
    cameras = {f"{idx}.jpg": Rigid3(rotation, np.zeros(3)) for idx, rotation in enumerate(rotations)}
    return Poses.without_points(cameras, frame=frame, scale="", metric=False, axes=axes)


def cam_from_world_with_up(up: list[float]) -> np.ndarray:
    """An upright camera in a world whose up direction is `up`."""
    down = -np.array(up) / np.linalg.norm(up)
    right = np.cross(down, np.eye(3)[int(np.argmin(np.abs(down)))])
    right /= np.linalg.norm(right)
    return np.stack([right, down, np.cross(right, down)])


def test_a_world_with_y_down_only_exchanges_axes() -> None:
    point = np.array([1.0, 2.0, 3.0])
    assert (z_up_from_world() @ point).tolist() == [1, 3, -2]
    assert (y_up_from_world() @ point).tolist() == [1, -2, -3]


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("sign", [-1, 1])
def test_every_axis_of_the_world_turns_up_exactly(axis: int, sign: int) -> None:
    up = sign * np.eye(3)[axis]
    for rotation, wanted in ((z_up_from_world(up), [0, 0, 1]), (y_up_from_world(up), [0, 1, 0])):
        assert (rotation @ up).tolist() == wanted
        assert set(np.abs(rotation).ravel()) == {0.0, 1.0}
        assert np.linalg.det(rotation) == pytest.approx(1)


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda up: np.linalg.norm(up) > 0.1))
def test_any_up_direction_turns_up_by_a_rotation(up: tuple[float, float, float]) -> None:
    unit = np.array(up) / np.linalg.norm(up)
    z_up, y_up = z_up_from_world(unit), y_up_from_world(unit)
    assert z_up @ unit == pytest.approx([0, 0, 1])
    assert y_up @ unit == pytest.approx([0, 1, 0])
    assert z_up @ z_up.T == pytest.approx(np.eye(3))
    assert np.linalg.det(y_up) == pytest.approx(1)
    # As Blender imports a file with y up.
    assert y_up == pytest.approx(np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ z_up)


@pytest.mark.parametrize("up", [[0, -1, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0]])
def test_a_world_of_a_file_may_have_any_axis_up(up: list[float]) -> None:
    tilted = rotation_from_rotvec([0.1, 0.0, 0.05]) @ cam_from_world_with_up(up)
    assert world_up(poses_with([tilted])).tolist() == up


def test_the_mean_of_the_cameras_counts_far_from_all_axes() -> None:
    up = np.array([0, -1, 1]) / np.sqrt(2)
    assert world_up(poses_with([cam_from_world_with_up(up.tolist())])) == pytest.approx(up)


def test_a_levelled_world_does_not_ask_the_cameras() -> None:
    sideways = [cam_from_world_with_up([1, 0, 0])]
    assert world_up(poses_with(sideways, axes=WorldAxes.LEVEL)).tolist() == [0, -1, 0]


def test_words_do_not_level_a_world() -> None:
    """A frame "camera axes: x right, y down" of a plugin or of a file was taken for a world levelled by gravity."""
    sideways = [cam_from_world_with_up([1, 0, 0])]
    for frame in ("camera axes: x right, y down, z forward", "the world of y down.json"):
        assert world_up(poses_with(sideways, frame=frame)).tolist() == [1, 0, 0]


def test_what_is_known_of_a_world_is_stored() -> None:
    pair = [np.eye(3), np.eye(3)]
    placed = replace(poses_with(pair, axes=WorldAxes.NORTH), origin_lla=(47.5, 8.25, 410.0))
    other = poses_with(pair, axes=WorldAxes.LEVEL)
    other = replace(other, names=("2.jpg", "3.jpg"))
    parts = dict(join_groups([placed, other]).to_parts())
    again = Poses.from_parts(parts | {"meta": json.loads(json.dumps(parts["meta"]))})
    assert [(world.axes, world.origin_lla) for world in again.worlds] == [
        (WorldAxes.NORTH, (47.5, 8.25, 410.0)),
        (WorldAxes.LEVEL, None),
    ]
    assert [group.axes for group in split_groups(again)] == [WorldAxes.NORTH, WorldAxes.LEVEL]


def test_without_agreement_y_points_down() -> None:
    opposite = [cam_from_world_with_up([0, 0, 1]), cam_from_world_with_up([0, 0, -1])]
    assert world_up(poses_with(opposite)).tolist() == [0, -1, 0]
    assert world_up(poses_with([])).tolist() == [0, -1, 0]


def tilted(deg: float) -> np.ndarray:
    """A camera that is tilted about its z axis."""
    return rotation_from_rotvec(np.array([0.0, 0.0, np.deg2rad(deg)]))


def test_upright_cameras_give_minus_y() -> None:
    assert mean_up_direction(np.eye(3)[None]) == pytest.approx(np.array(WORLD_UP))


def test_opposite_tilts_cancel_and_the_world_may_be_turned() -> None:
    world_from_level = rotation_from_rotvec(np.array([0.3, -1.1, 0.7]))
    rotations = [tilted(deg) @ world_from_level.T for deg in (-20, 20, -5, 5)]
    up = mean_up_direction(rotations)
    assert up is not None
    assert up == pytest.approx(world_from_level @ WORLD_UP)


@pytest.mark.parametrize(("apart_deg", "agree"), [(0, True), (118, True), (122, False), (180, False)])
def test_cameras_that_point_everywhere_have_no_common_up_direction(apart_deg: float, *, agree: bool) -> None:
    assert (mean_up_direction([tilted(0), tilted(apart_deg)]) is not None) == agree


def test_without_cameras_there_is_none() -> None:
    assert mean_up_direction(np.zeros((0, 3, 3))) is None
    assert mean_up_direction([]) is None
