"""A pinhole view looks where its rotation says, and its pixels and rays are inverse to each other.

Our camera is exactly COLMAP's EQUIRECTANGULAR.
"""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.geometry import (
    PinholeView,
    Rigid3,
    pixel_from_ray,
    quat_wxyz_from_rotation,
    ray_from_pixel,
    rotation_from_rotvec,
)
from tests.geometry.strategies import FEW, RIGIDS, ROTATIONS, UNITS

# No square, and its axis not in the middle: a mix-up of width and height, or of x and y, shows.
AHEAD = PinholeView(np.eye(3), 50.0, np.array([30.0, 22.0]), (40, 64))


def view_of(rotation: NDArray[np.float64]) -> PinholeView:
    return PinholeView(rotation, 50.0, np.array([30.0, 22.0]), (40, 64))


def test_the_axis_is_seen_at_the_principal_point_and_a_focal_length_is_45_degrees() -> None:
    assert AHEAD.pixels_from_rays((0, 0, 3)) == pytest.approx([30, 22])
    assert AHEAD.pixels_from_rays((1, 0, 1)) == pytest.approx([80, 22])
    assert AHEAD.pixels_from_rays((0, 1, 1)) == pytest.approx([30, 72])


def test_the_calibration_matrix_projects_as_the_view_does() -> None:
    point = np.array([0.4, -0.3, 2.0])
    x, y, one = AHEAD.calibration @ point / point[2]
    assert (x, y) == pytest.approx(tuple(AHEAD.pixels_from_rays(point)))
    assert one == 1
    assert AHEAD.calibration[1, 0] == AHEAD.calibration[0, 1] == 0


@FEW
@given(ROTATIONS, st.floats(-20, 90), st.floats(-20, 60), st.floats(0.1, 10))
def test_pixels_survive_the_round_trip_at_any_distance(
    rotation: NDArray[np.float64], x: float, y: float, distance: float
) -> None:
    bearing = view_of(rotation).bearings_from_pixels((x, y))
    assert np.linalg.norm(bearing) == pytest.approx(1)
    assert view_of(rotation).pixels_from_rays(distance * bearing) == pytest.approx([x, y], abs=1e-8)


def test_a_view_to_the_right_sees_what_is_right_of_the_camera() -> None:
    to_the_right = view_of(rotation_from_rotvec((0, np.pi / 2, 0)).T)
    assert to_the_right.pixels_from_rays((1, 0, 0)) == pytest.approx([30, 22])
    assert to_the_right.bearings_from_pixels((30, 22)) == pytest.approx([1, 0, 0])


@pytest.mark.parametrize("ray", [(0, 0, -1), (1, 0, 0), (0.3, 0.2, -1e-9)])
def test_rays_not_before_the_view_have_no_pixel(ray: tuple[float, float, float]) -> None:
    assert np.isnan(AHEAD.pixels_from_rays(ray)).all()
    several = AHEAD.pixels_from_rays([ray, (0, 0, 1)])
    assert np.isnan(several).tolist() == [[True, True], [False, False]]


@pytest.mark.parametrize(
    ("pixel", "inside"),
    [
        ((0, 0), True),
        ((63.999, 39.999), True),
        ((64, 10), False),
        ((10, 40), False),
        ((-0.001, 10), False),
        ((10, -0.001), False),
        ((50, 45), False),
        ((np.nan, 10), False),
        ((10, np.nan), False),
    ],
)
def test_a_view_contains_its_pixels_from_edge_to_edge(pixel: tuple[float, float], inside: bool) -> None:
    assert AHEAD.contains(pixel) == inside
    assert AHEAD.contains([[pixel, (1, 1)]]).tolist() == [[inside, True]]


def test_rays_go_through_the_centres_of_the_pixels_or_where_they_are_wanted() -> None:
    view = view_of(rotation_from_rotvec((0.2, -0.7, 0.4)))
    rays = view.rays()
    assert rays.shape == (40, 64, 3)
    y, x = np.mgrid[0:40, 0:64]
    assert view.pixels_from_rays(rays) == pytest.approx(np.stack([x + 0.5, y + 0.5], axis=-1))
    corners = view.rays(slice(3, 7), offset_xy=(0.0, 0.25))
    assert view.pixels_from_rays(corners) == pytest.approx(np.stack([x, y + 0.25], axis=-1)[3:7])


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
@settings(max_examples=80)
def test_rays_are_those_of_colmap_anywhere(x: float, y: float) -> None:
    ray = CAMERA.cam_ray_from_img(np.array([x, y]))
    assert ray_from_pixel((x, y), (HEIGHT, WIDTH)) == pytest.approx(ray, abs=1e-15)


@given(UNITS, st.floats(0.1, 100))
@settings(max_examples=80)
def test_pixels_are_those_of_colmap_anywhere(ray: NDArray[np.float64], length: float) -> None:
    expected = CAMERA.img_from_cam((ray * length)[None])[0]
    got = pixel_from_ray(ray * length, (HEIGHT, WIDTH))
    across_the_seam = abs(got[0] - expected[0]) == WIDTH
    assert across_the_seam or got[0] == pytest.approx(expected[0], abs=1e-9)
    assert got[1] == pytest.approx(expected[1], abs=1e-9)


@FEW
@given(RIGIDS, UNITS)
def test_transforms_and_quaternions_are_those_of_colmap(pose: Rigid3, point: NDArray[np.float64]) -> None:
    w, x, y, z = quat_wxyz_from_rotation(pose.rotation)
    theirs = pycolmap.Rigid3d(pycolmap.Rotation3d(np.array([x, y, z, w])), pose.translation)
    assert theirs * point == pytest.approx(pose.apply(point), abs=1e-9)
    assert theirs.inverse().translation == pytest.approx(pose.center, abs=1e-9)
    assert isinstance(pose, Rigid3)
