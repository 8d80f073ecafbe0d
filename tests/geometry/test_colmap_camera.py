"""Our camera is exactly COLMAP's EQUIRECTANGULAR."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.geometry import Rigid3, pixel_from_ray, quat_wxyz_from_rotation, ray_from_pixel
from tests.geometry.strategies import RIGIDS, UNITS

HEIGHT, WIDTH = 512, 1024
# Without params a call to img_from_cam takes the process down.
CAMERA = pycolmap.Camera(model="EQUIRECTANGULAR", width=WIDTH, height=HEIGHT, params=[WIDTH, HEIGHT])

PLACES = {
    "centre": (512, 256),
    "first pixel": (0.5, 0.5),
    "left edge": (0, 256),
    "right edge": (1024, 256),
    "beside the seam": (1023.999, 17.25),
    "zenith": (512, 0),
    "nadir": (512, 512),
    "beside the zenith": (3.5, 0.01),
    "beside the nadir": (900, 511.99),
    "anywhere": (123.4, 387.6),
}


@pytest.mark.parametrize("place", PLACES)
def test_rays_are_those_of_colmap(place: str) -> None:
    pixel = np.array(PLACES[place], np.float64)
    assert ray_from_pixel(pixel, (HEIGHT, WIDTH)) == pytest.approx(CAMERA.cam_ray_from_img(pixel), abs=1e-15)


@given(st.floats(0, WIDTH), st.floats(0, HEIGHT))
@settings(max_examples=200)
def test_rays_are_those_of_colmap_anywhere(x: float, y: float) -> None:
    ray = CAMERA.cam_ray_from_img(np.array([x, y]))
    assert ray_from_pixel((x, y), (HEIGHT, WIDTH)) == pytest.approx(ray, abs=1e-15)


@given(UNITS, st.floats(0.1, 100))
@settings(max_examples=200)
def test_pixels_are_those_of_colmap_anywhere(ray: NDArray[np.float64], length: float) -> None:
    expected = CAMERA.img_from_cam((ray * length)[None])[0]
    got = pixel_from_ray(ray * length, (HEIGHT, WIDTH))
    across_the_seam = abs(got[0] - expected[0]) == WIDTH
    assert across_the_seam or got[0] == pytest.approx(expected[0], abs=1e-9)
    assert got[1] == pytest.approx(expected[1], abs=1e-9)


@given(RIGIDS, UNITS)
def test_transforms_and_quaternions_are_those_of_colmap(pose: Rigid3, point: NDArray[np.float64]) -> None:
    w, x, y, z = quat_wxyz_from_rotation(pose.rotation)
    theirs = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), pose.translation)
    assert theirs * point == pytest.approx(pose.apply(point), abs=1e-9)
    assert theirs.inverse().translation == pytest.approx(pose.center, abs=1e-9)
    assert isinstance(pose, Rigid3)
