"""The mean of the cameras' up directions."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.geometry.transforms import rotation_from_rotvec
from pano_mvs.scene.upright import WORLD_UP, mean_up_direction


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
