"""Triangulation at the hard places: beside the epipoles, far away, behind, and with more than two rays."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, ranges_from_bearings, triangulate_bearings
from tests.geometry.strategies import FEW, RIGIDS, ROTATIONS, UNITS


def bearing(point_in_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    result: NDArray[np.float64] = point_in_cam / np.linalg.norm(point_in_cam, axis=-1, keepdims=True)
    return result


@FEW
@given(ROTATIONS, UNITS, st.floats(0.05, 1e4), st.floats(1e-3, np.pi - 1e-3), st.floats(0, 2 * np.pi))
def test_ranges_are_recovered_from_beside_the_epipole_to_far_away(
    rotation: NDArray[np.float64], center: NDArray[np.float64], distance: float, off_axis: float, around: float
) -> None:
    side = bearing(np.cross(center, (0.31, -0.67, 0.45)))
    up = np.cross(center, side)
    ray = np.cos(off_axis) * center + np.sin(off_axis) * (np.cos(around) * side + np.sin(around) * up)
    second_from_first = Rigid3.from_center(rotation, center)
    point = distance * ray
    in_second = second_from_first.apply(point)
    parallax = float(np.linalg.norm(np.cross(ray, bearing(point - center))))
    if parallax < 1e-6:
        return
    first, second = ranges_from_bearings(ray, bearing(in_second), second_from_first)
    tolerance = 1e-14 / parallax**2 + 1e-12 / parallax
    assert first == pytest.approx(distance, rel=tolerance, abs=tolerance)
    assert second == pytest.approx(np.linalg.norm(in_second), rel=tolerance, abs=tolerance)


@FEW
@given(RIGIDS, UNITS)
def test_a_point_behind_has_a_negative_range(second_from_first: Rigid3, ray: NDArray[np.float64]) -> None:
    point = -2 * ray  # the first camera looks the other way
    in_second = second_from_first.apply(point)
    center = second_from_first.center
    if np.linalg.norm(np.cross(ray, center)) < 0.05 or np.linalg.norm(in_second) < 0.05:
        return
    first, second = ranges_from_bearings(ray, bearing(in_second), second_from_first)
    assert first == pytest.approx(-2, rel=1e-6)
    assert second == pytest.approx(np.linalg.norm(in_second), rel=1e-6)


def test_the_ranges_are_those_of_the_points_nearest_to_both_rays() -> None:
    rng = np.random.default_rng(3)
    p, q = bearing(rng.normal(size=(50, 3))), bearing(rng.normal(size=(50, 3)))
    pose = Rigid3.from_center(np.eye(3), (0.4, -0.2, 1.0))
    first, second = ranges_from_bearings(p, q, pose)
    between = first[:, None] * p - (pose.center + second[:, None] * q)
    assert np.abs(np.sum(between * p, axis=1)).max() < 1e-9
    assert np.abs(np.sum(between * q, axis=1)).max() < 1e-9


def test_parallel_rays_have_no_range() -> None:
    pose = Rigid3.from_center(np.eye(3), (1, 0, 0))
    for ray in ((0, 0, 1), (1, 0, 0)):
        assert np.isnan(ranges_from_bearings(ray, ray, pose)).all()


@FEW
@given(st.lists(RIGIDS, min_size=2, max_size=5), UNITS, st.floats(0.5, 30))
def test_points_are_recovered_from_many_cameras(
    cameras: list[Rigid3], direction: NDArray[np.float64], distance: float
) -> None:
    point = distance * direction
    rays_in_world = [bearing(point - camera.center) for camera in cameras]
    parallax = max(float(np.linalg.norm(np.cross(rays_in_world[0], ray))) for ray in rays_in_world)
    if parallax < 1e-3 or min(np.linalg.norm(point - camera.center) for camera in cameras) < 1e-3:
        return
    found = triangulate_bearings([bearing(camera.apply(point)) for camera in cameras], cameras)
    assert found == pytest.approx(point, abs=1e-12 / parallax**2)


def test_many_tracks_at_once_are_each_alone_and_parallel_ones_are_nan() -> None:
    cameras = [Rigid3.identity(), Rigid3.from_center(np.eye(3), (1, 0, 0)), Rigid3.from_center(np.eye(3), (0, 1, 0))]
    points = np.random.default_rng(0).normal(size=(2, 5, 3)) * 4
    rays = np.stack([bearing(camera.apply(points)) for camera in cameras])
    rays[:, 1, 2] = (0, 0, 1)
    found = triangulate_bearings(rays, cameras)
    assert np.isnan(found[1, 2]).all()
    found[1, 2] = points[1, 2]
    assert found == pytest.approx(points, abs=1e-9)


@pytest.mark.parametrize("count", [1, 3])
def test_bearings_and_cameras_must_pair_up(count: int) -> None:
    with pytest.raises(UsageError, match="one bearing for each of two or more cameras"):
        triangulate_bearings(np.ones((count, 3)), [Rigid3.identity()] * min(count, 2))
