"""The axes of exported clouds and meshes."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from pano_mvs.api import Params, Poses
from pano_mvs.scene.pose_groups import split_groups
from pano_mvs.scene.upright import world_up, z_up_from_world


class FrameParams(Params):
    """The frame of the coordinates in a file."""

    frame: Literal["upright", "world"] = Field(
        default="upright",
        description="upright: turned so that z points up; world: as the poses and COLMAP models, usually y down",
    )


def files_from_world(params: FrameParams, poses: Poses | None, *, groups: int) -> list[NDArray[np.float64] | None]:
    """Return the rotation (3, 3) into the axes of the file of each group; None for the world's own axes.

    Without poses, −y of the world is up.
    """
    if params.frame == "world":
        return [None] * groups
    if poses is None:
        return [z_up_from_world()] * groups
    known = [z_up_from_world(world_up(group)) for group in split_groups(poses)]
    return [known[number] if number < len(known) else z_up_from_world() for number in range(groups)]
