"""A rig knows which lens a direction of its panorama comes from, and where that ray starts."""

from __future__ import annotations

import json

import cv2
import numpy as np
import pycolmap
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import FisheyeLens, LensRig, Rigid3, rotation_from_rotvec, spiral_rays
from tests.geometry.strategies import FEW

BACK = rotation_from_rotvec(np.array([0.02, np.pi - 0.03, 0.01]))


def rig(distance: float = 2.0, field_deg: float = 200.0) -> LensRig:
    lens = FisheyeLens((960, 960), (250.0, 252.0), (478.0, 483.0), (0.01, -0.002, 0.0, 0.0), np.radians(field_deg / 2))
    return LensRig.centred(
        ("front", "back"),
        (lens, lens),
        (Rigid3.identity(), Rigid3.from_center(BACK, (0.002, -0.003, -0.04))),
        stitch_distance_m=distance,
    )


def test_the_origin_is_between_the_lenses_whatever_the_file_calls_the_origin() -> None:
    assert rig().centers.sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-15)
    assert rig().centers[0] - rig().centers[1] == pytest.approx((-0.002, 0.003, 0.04))
    assert 2 * rig().lens_offset_m == pytest.approx(np.linalg.norm((0.002, 0.003, 0.04)))


@pytest.mark.parametrize("distance", [0.3, 2.0, np.inf])
def test_true_rays_start_at_the_lens_and_pass_through_the_stitching_sphere(distance: float) -> None:
    bearings = spiral_rays(500)
    own = rig(distance)
    origins, directions = own.rays_from_bearings(bearings)
    assert np.linalg.norm(directions, axis=1) == pytest.approx(1)
    assert origins == pytest.approx(own.centers[own.lens_of_bearings(bearings)])
    assert own.bearings_from_rays(origins, directions) == pytest.approx(bearings, abs=1e-14)
    if np.isinf(distance):
        assert directions == pytest.approx(bearings)
    else:
        assert np.cross(distance * bearings - origins, directions) == pytest.approx(np.zeros_like(bearings), abs=1e-14)


def test_a_surface_at_another_distance_is_shifted_as_the_documentation_states() -> None:
    own, range_m = rig(2.0), 0.8
    towards = spiral_rays(2000)
    for idx in (0, 1):
        directions = range_m * towards - own.centers[idx]
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        shown = own.bearings_from_rays(np.broadcast_to(own.centers[idx], towards.shape), directions)
        shift = np.linalg.norm(np.cross(shown, towards), axis=1).max()
        assert shift == pytest.approx(own.lens_offset_m * (1 / range_m - 1 / 2.0), rel=0.05)


def test_the_lens_is_the_one_that_sees_further_inside_its_field_of_view() -> None:
    labels = rig().lens_of_bearings([(0, 0, 1), (0, 0, -1), (1, 0, 0.3), (1, 0, -0.3), (0, 1, 0.2)])
    assert labels.tolist() == [0, 1, 0, 1, 0]
    blind = rig(field_deg=170.0)
    assert blind.lens_of_bearings((0, 1, 0)) == -1
    assert blind.rays_from_bearings((0.0, 1.0, 0.0))[0].tolist() == [0, 0, 0]


def test_the_angle_from_the_seam_is_that_from_the_plane_between_opposite_lenses() -> None:
    lens = FisheyeLens((960, 960), (250.0, 250.0), (480.0, 480.0), (0.0, 0.0, 0.0, 0.0), np.radians(100))
    back = Rigid3.from_center(rotation_from_rotvec(np.array([0, np.pi, 0])), (0, 0, -0.04))
    own = LensRig.centred(("a", "b"), (lens, lens), (Rigid3.identity(), back))
    elevations = np.radians([-9.0, -3.0, 0.0, 2.0, 9.0])
    rays = np.stack([np.cos(elevations), np.zeros(5), np.sin(elevations)], axis=1)
    assert own.angle_from_seam(rays) == pytest.approx(np.abs(elevations), abs=1e-12)
    assert own.angle_from_seam([(0, 0, 1), (0.1, 0, -1)]).tolist() == [np.inf, np.inf]


def test_beyond_the_border_of_its_picture_a_lens_sees_nothing() -> None:
    lens = FisheyeLens((300, 960), (250.0, 250.0), (480.0, 150.0), (0.0, 0.0, 0.0, 0.0), np.radians(100))
    both = LensRig.centred(("a", "b"), (lens, lens), (Rigid3.identity(), Rigid3.from_center(BACK, (0, 0, -0.04))))
    assert both.lens_of_bearings([(0, 1, 1), (1, 0, 1)]).tolist() == [-1, 0]


def test_values_survive_json_exactly() -> None:
    for distance in (2.0, np.inf):
        own = rig(distance)
        again = LensRig.from_values(json.loads(json.dumps(own.to_values())))
        assert again.to_values() == own.to_values()
        assert again.lenses == own.lenses
        assert again.stitch_distance_m == distance
        assert np.array_equal(again.centers, own.centers)


def test_a_stitching_distance_inside_of_the_rig_is_refused() -> None:
    with pytest.raises(UsageError, match=r"stitching distance of 0\.03 m is not outside of the rig"):
        rig(0.03)


# Neither square nor centred, with different focal lengths: a mix-up of x and y shows.
LENS = FisheyeLens((900, 1000), (271.0, 268.0), (489.5, 457.25), (0.04, -0.012, 0.003, -0.0004), np.radians(100))
ANGLES = st.one_of(st.floats(0, np.radians(100)), st.sampled_from([0.0, 1e-12, 1e-6, np.pi / 2, np.radians(100)]))
AZIMUTHS = st.floats(-np.pi, np.pi)


def ray(angle: float, azimuth: float) -> tuple[float, float, float]:
    return np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)


@FEW
@given(ANGLES, AZIMUTHS, st.floats(0.01, 100))
def test_rays_of_any_length_survive_the_round_trip_also_beyond_90_degrees(
    angle: float, azimuth: float, length: float
) -> None:
    pixel = LENS.pixel_from_ray(length * np.array(ray(angle, azimuth)))
    assert LENS.ray_from_pixel(pixel) == pytest.approx(ray(angle, azimuth), abs=1e-11)


@FEW
@given(ANGLES)
def test_the_slope_is_the_derivative_of_the_radius(angle: float) -> None:
    h = 1e-6
    numeric = (LENS.radius_from_angle(angle + h) - LENS.radius_from_angle(angle - h)) / (2 * h)
    assert LENS.radius_slope(angle) == pytest.approx(numeric, abs=1e-8)


@pytest.mark.parametrize("angle_deg", [0.0, 1.0, 30.0, 60.0, 85.0])
def test_pixels_are_those_of_colmap_and_half_a_pixel_from_those_of_opencv(angle_deg: float) -> None:
    rays = np.array([ray(np.radians(angle_deg), azimuth) for azimuth in (0.3, 2.0, -1.1)])
    params = [*LENS.focal_xy, *LENS.principal_xy, *LENS.distortion]
    colmap = pycolmap.Camera(model="OPENCV_FISHEYE", width=1000, height=900, params=params)
    pixels = LENS.pixel_from_ray(rays)
    assert pixels == pytest.approx(colmap.img_from_cam(rays), abs=1e-9)
    # OpenCV counts from the centre of the first pixel, so that its principal point is half a pixel less.
    (fx, fy), (cx, cy) = LENS.focal_xy, LENS.principal_xy
    matrix = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    opencv, _ = cv2.fisheye.projectPoints(rays[:, None], np.zeros(3), np.zeros(3), matrix, np.array(LENS.distortion))
    assert pixels - 0.5 == pytest.approx(opencv[:, 0], abs=1e-9)


def test_nothing_beyond_the_field_of_view_has_a_pixel_or_a_ray() -> None:
    assert np.isnan(LENS.pixel_from_ray(ray(np.radians(100.01), 0.5))).all()
    outermost = 271.0 * float(LENS.radius_from_angle(np.radians(100)))
    assert np.isfinite(LENS.ray_from_pixel((489.5 + outermost - 0.01, 457.25))).all()
    assert np.isnan(LENS.ray_from_pixel((489.5 + outermost + 0.01, 457.25))).all()
    assert LENS.contains([(0, 0), (1000, 900), (1000.1, 5), (np.nan, 3), (-0.1, 3)]).tolist() == [
        True,
        True,
        False,
        False,
        False,
    ]


def test_newton_finds_angles_where_the_radius_hardly_grows_any_more() -> None:
    """The slope is nearly zero at the edge, so that plain Newton steps leave the field of view."""
    lens = FisheyeLens((100, 100), (20.0, 20.0), (50.0, 50.0), (-0.1, 0.0, 0.0, 0.0), 1.82)
    assert lens.monotonic_limit_rad == pytest.approx(np.sqrt(1 / 0.3))
    angles = np.linspace(0, 1.82, 2000)
    assert lens.angle_from_radius(lens.radius_from_angle(angles)) == pytest.approx(angles, abs=1e-9)


@pytest.mark.parametrize(
    ("focal", "k1", "angle_deg", "message"),
    [
        (0.0, 0.0, 60, "must be positive"),
        (20.0, 0.0, 183, "at most 360°"),
        (20.0, -0.1, 105, r"stops growing 104\.6° from the axis, but the field of view reaches 105\.0°"),
    ],
)
def test_impossible_lenses_are_refused(focal: float, k1: float, angle_deg: float, message: str) -> None:
    with pytest.raises(UsageError, match=message):
        FisheyeLens((100, 100), (focal, 20.0), (50.0, 50.0), (k1, 0.0, 0.0, 0.0), np.radians(angle_deg))
