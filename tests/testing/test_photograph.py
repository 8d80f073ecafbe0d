"""Rendered photographs agree with the colours of the place, through the camera model."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.poses.photograph_camera import PhotographCamera
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.testing.room import colors_along, default_room, range_along
from tests.synthetic.photograph import render_photograph

SIZE_HW, FOCAL_PX = (90, 120), 200.0
POSE = Rigid3.from_center(rotation_from_rotvec(np.array([0.1, 0.6, -0.2])), np.array([0.2, 0.1, 0.1]))


@pytest.mark.parametrize("radial", [0.0, -0.3])
def test_points_have_their_colors_where_the_camera_sees_them(radial: float) -> None:
    room, camera = default_room(), PhotographCamera(POSE, FOCAL_PX, radial)
    photograph = render_photograph(room, POSE, SIZE_HW, focal_px=FOCAL_PX, radial=radial, supersample=1).astype(int)
    rays = np.concatenate([np.random.default_rng(1).uniform(-0.2, 0.2, (400, 2)), np.ones((400, 1))], axis=1)
    rays = rays / np.linalg.norm(rays, axis=1, keepdims=True) @ POSE.rotation
    points = POSE.center + range_along(room, POSE.center, rays)[:, None] * rays
    true = 255 * colors_along(room, POSE.center, rays, pixel_rad=1 / FOCAL_PX)
    x, y = np.floor(camera.project(points, SIZE_HW)[0]).astype(int).T
    assert np.median(np.abs(photograph[y, x] - true).max(axis=1)) < 8
    assert np.median(np.abs(photograph[y, x - 10] - true).max(axis=1)) > 15
