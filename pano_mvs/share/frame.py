"""The frame of the page: y up, the first camera looking along -z, the origin amid the cameras (as WebGL has it)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pano_mvs.geometry import Rigid3
from pano_mvs.scene.up_direction import WORLD_UP, mean_up_direction


def page_from_world(cameras: Sequence[Rigid3], *, is_level: bool = False) -> Rigid3:
    """Return the transform into the frame of the page.

    Args:
        cameras: the poses, cam_from_world. Up is the cameras' common up direction, or -y of the world if they were
            turned at random.
        is_level: whether y of the world points down along gravity, so that -y is up whatever the cameras say.
    """
    common = mean_up_direction([camera.rotation for camera in cameras]) if cameras and not is_level else None
    up = np.array(WORLD_UP) if common is None else common
    ahead = cameras[0].rotation[2] if cameras else np.array([0.0, 0.0, 1.0])
    right = np.cross(ahead, up)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross(np.eye(3)[int(np.argmin(np.abs(up)))], up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, up, np.cross(right, up)])
    centers = np.array([camera.center for camera in cameras]).reshape(-1, 3)
    origin = np.median(centers, axis=0) if len(centers) else np.zeros(3)
    return Rigid3(rotation, -rotation @ origin)
