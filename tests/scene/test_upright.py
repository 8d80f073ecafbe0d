"""The rotations from the world to axes with z up and y up."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.scene import Poses
from pano_mvs.scene.upright import (
    WORLD_UP,
    mean_up_direction,
    states_y_down,
    world_up,
    y_up_from_world,
    z_up_from_world,
)

LEVELLED = "origin at the first registered camera; y down along gravity, by the cameras; z as before"


def poses_with(rotations: list[np.ndarray], *, frame: str = "the first registered camera") -> Poses:
    cameras = {f"{idx}.jpg": Rigid3(rotation, np.zeros(3)) for idx, rotation in enumerate(rotations)}
    return Poses.without_points(cameras, frame=frame, scale="", metric=False)


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
    assert world_up(poses_with(sideways, frame=LEVELLED)).tolist() == [0, -1, 0]
    assert states_y_down(LEVELLED)
    assert not states_y_down("the first registered camera")


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
