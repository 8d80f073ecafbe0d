"""Small pictures of the synthetic room, rendered once for all tests that ask the images about their poses."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3
from pano_mvs.testing.room import capture_poses, default_room, render

SIZE_HW = (128, 256)
WHOLE = np.ones(SIZE_HW, np.bool_)


@cache
def room_capture() -> tuple[tuple[Rigid3, ...], tuple[NDArray[np.uint8], ...]]:
    """Return five cameras about 0.6 apart and their panoramas."""
    poses = tuple(capture_poses(5, seed=1, spread=0.7))
    return poses, tuple(render(default_room(), pose, SIZE_HW)[0] for pose in poses)


def moved(pose: Rigid3, by: tuple[float, float, float]) -> Rigid3:
    """Return a camera whose centre is elsewhere."""
    return Rigid3.from_center(pose.rotation, pose.center + np.array(by))
