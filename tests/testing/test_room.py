"""The synthetic room: everything else trusts it, so it is held against closed forms."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pano_mvs.geometry import (
    Rigid3,
    pixel_from_ray,
    ray_grid,
    roll_panorama,
    rotation_from_rotvec,
    sample_panorama,
    spiral_rays,
)
from pano_mvs.testing.room import Room, capture_poses, default_room, noise, range_along, render
from pano_mvs.testing.surfaces import Ball, Cuboid, Quad
from tests.synthetic.capture_files import write_capture

GREY = ((0.5, 0.5, 0.5), (0.4, 0.4, 0.4))
SIZE = (64, 128)
COMPONENT = st.floats(-0.6, 0.6)


@given(center=st.tuples(COMPONENT, COMPONENT, COMPONENT), turn=st.tuples(*[st.floats(-3, 3)] * 3))
@settings(max_examples=20, deadline=None)
def test_ranges_inside_a_sphere_and_a_box_end_on_them(
    center: tuple[float, float, float], turn: tuple[float, float, float]
) -> None:
    pose = Rigid3.from_center(rotation_from_rotvec(turn), center)
    for surface in (Ball((0.1, -0.2, 0.3), 2.0, GREY), Cuboid((-1, -2, -3), (1, 2, 3), GREY)):
        _, range_map = render(Room((surface,)), pose, (16, 32), supersample=1)
        points = np.array(center) + range_map[..., None].astype(float) * (ray_grid((16, 32)) @ pose.rotation)
        if isinstance(surface, Ball):
            assert np.linalg.norm(points - (0.1, -0.2, 0.3), axis=-1) == pytest.approx(2.0, abs=1e-6)
        else:
            assert np.max(np.abs(points) / (1, 2, 3), axis=-1) == pytest.approx(1.0, abs=1e-6)


def test_rays_parallel_to_a_slab_are_told_apart() -> None:
    box = Cuboid((-1, -1, 2), (1, 1, 3), GREY)
    ahead = np.array([[0.0, 0.0, 1.0]])
    assert box.hit(np.zeros(3), ahead)[0] == 2
    assert np.isinf(box.hit(np.array([0.0, 1.5, 0.0]), ahead)[0])
    assert np.isinf(box.hit(np.array([0.0, 0.0, 4.0]), ahead)[0])
    assert box.hit(np.array([0.0, 0.0, 2.25]), ahead)[0] == 0.75


def test_a_quad_is_met_within_its_edges_and_from_both_sides() -> None:
    quad = Quad((-1, -1, 2), (2, 0, 0), (0, 2, 0), GREY)
    rays = np.array([[0, 0, 1.0], [0.49, 0, 1], [0.51, 0, 1], [0, -0.49, 1], [0, -0.51, 1], [0, 0, -1]])
    assert np.isfinite(quad.hit(np.zeros(3), rays)[0]).tolist() == [True, True, False, True, False, False]
    distance, normal = quad.hit(np.array([0.0, 0, 3]), np.array([[0.0, 0, -1]]))
    assert (distance.item(), normal.tolist()) == (1.0, [[0.0, 0.0, 1.0]])


def test_normals_point_towards_the_camera() -> None:
    room = default_room()
    rays = ray_grid(SIZE).reshape(-1, 3)
    for surface in room.surfaces:
        distance, normal = surface.hit(np.array([0.1, 0.2, -0.1]), rays)
        met = np.isfinite(distance)
        assert met.any()
        assert np.all(np.sum(normal[met] * rays[met], axis=1) < 0)
        assert np.linalg.norm(normal[met], axis=1) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("surface", default_room().surfaces[1:])
def test_rays_that_do_not_come_near_a_surface_do_not_meet_it(surface: Cuboid | Quad | Ball) -> None:
    rays, bounded = spiral_rays(3000), 0
    for origin in np.random.default_rng(0).uniform(-2.5, 2.5, (20, 3)):
        met, near = np.flatnonzero(np.isfinite(surface.hit(origin, rays)[0])), surface.towards(origin, rays)
        assert near is None or np.isin(met, near).all()
        bounded += near is not None and len(near) < 1000
    assert bounded > 5


def test_range_is_taken_at_the_exact_pixel_centre() -> None:
    room, pose = default_room(), capture_poses(3)[2]
    _, range_map = render(room, pose, SIZE, supersample=3)
    exact = range_along(room, pose.center, ray_grid(SIZE).reshape(-1, 3) @ pose.rotation)
    np.testing.assert_array_equal(range_map.ravel(), exact.astype(np.float32))


def test_where_nothing_is_met_the_range_is_nan() -> None:
    image, range_map = render(Room((Ball((0, 0, 3), 1.0, GREY),)), Rigid3.identity(), SIZE)
    assert 0.9 < np.isnan(range_map).mean() < 1.0
    assert np.nanmin(range_map) == pytest.approx(2.0, abs=5e-3)
    assert not image[0].any()


@pytest.mark.parametrize("columns", [1, 37, 64, -5])
def test_rolling_the_camera_rolls_the_picture(columns: int) -> None:
    room, pose = default_room(), capture_poses(2)[1]
    image, range_map = render(room, pose, SIZE)
    rolled, new_from_old = roll_panorama(range_map, columns)
    turned_image, turned_range = render(room, Rigid3(new_from_old, np.zeros(3)) @ pose, SIZE)
    np.testing.assert_allclose(turned_range, rolled, rtol=1e-6)
    assert np.abs(turned_image.astype(int) - np.roll(image, columns, axis=1)).max() <= 1


def test_turning_the_camera_keeps_every_point_in_its_place() -> None:
    room, pose = default_room(texture="isotropic"), Rigid3.from_center(np.eye(3), (0.3, -0.1, 0.2))
    turn = rotation_from_rotvec((0.9, -0.4, 1.3))
    turned = Rigid3(turn, np.zeros(3)) @ pose
    sizes = (128, 256)
    (image, range_map), (turned_image, turned_range) = render(room, pose, sizes), render(room, turned, sizes)
    in_turned = pixel_from_ray(ray_grid(sizes) @ turn.T, sizes)
    assert np.abs(sample_panorama(turned_range, in_turned) - range_map).max() < 1e-3
    difference = np.abs(sample_panorama(turned_image, in_turned) - image)
    assert np.median(difference) < 12  # a texture this fine is blurred a little by the interpolation


def test_a_point_has_the_same_colour_from_two_places() -> None:
    room, sizes = default_room(), (160, 320)
    first, second = Rigid3.identity(), capture_poses(2, seed=4)[1]
    image, range_map = render(room, first, sizes)
    other, other_range = render(room, second, sizes)
    points_in_second = (second @ first.inverse()).apply(range_map[..., None] * ray_grid(sizes))
    pixels = pixel_from_ray(points_in_second, sizes)
    distance = np.linalg.norm(points_in_second, axis=-1)
    visible = np.abs(sample_panorama(other_range, pixels) / distance - 1) < 2e-3
    assert 0.8 < visible.mean() < 1
    error = np.abs(sample_panorama(other, pixels) - image)[visible].mean()
    shuffled = np.abs(np.roll(image, 7, axis=1).astype(float) - image)[visible].mean()
    assert error < 0.3 * shuffled


def test_the_weak_texture_is_weak_and_seeds_differ() -> None:
    pose = Rigid3.identity()
    strong, weak = (render(default_room(texture=name), pose, SIZE)[0].astype(float) for name in ("strong", "weak"))
    steps = [np.abs(np.diff(image, axis=1)).mean() for image in (strong, weak)]
    assert steps[1] < 0.4 * steps[0]
    again = render(default_room(), pose, SIZE)[0]
    np.testing.assert_array_equal(again, strong)
    assert np.abs(render(default_room(1), pose, SIZE)[0] - strong).mean() > 10


def test_the_isotropic_texture_is_as_rough_at_the_pole_as_at_the_equator() -> None:
    room = default_room(texture="isotropic")
    tipped = Rigid3(rotation_from_rotvec((np.pi / 2, 0, 0)), np.zeros(3))
    upright, turned = (render(room, pose, (128, 256))[0].astype(float) for pose in (Rigid3.identity(), tipped))
    ahead = np.s_[48:80, 112:144]  # the second camera looks straight at what is the first one's pole
    assert turned[ahead].std() == pytest.approx(upright[ahead].std(), rel=0.2)


def test_the_cameras_of_a_capture_are_free_and_apart() -> None:
    room = default_room()
    poses = capture_poses(9, seed=3)
    assert len(poses) == 9
    centers = np.array([pose.center for pose in poses])
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=-1) + 9 * np.eye(9)
    assert apart.min() > 0.05
    for pose in poses:
        assert range_along(room, pose.center, ray_grid(SIZE).reshape(-1, 3)).min() > 0.1
        assert pose.rotation @ pose.rotation.T == pytest.approx(np.eye(3), abs=1e-12)


def test_a_written_capture_is_the_same_bytes_twice(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        write_capture(tmp_path / folder, default_room(), capture_poses(2), size_hw=SIZE)
    files = sorted(path.relative_to(tmp_path / "a") for path in (tmp_path / "a").rglob("*.*"))
    assert [str(path) for path in files] == ["images/000.png", "images/001.png", "truth/depth.npz", "truth/poses.json"]
    for path in files:
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes()


def test_the_texture_is_smooth_noise_of_the_wavelengths_that_are_asked_for() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-3, 3, (20_000, 3))
    values = noise(points, cells=((0.1, 1.0),), seed=3)
    assert values.mean() == pytest.approx(0, abs=0.05)
    assert values.std() == pytest.approx(0.9, abs=0.15)
    aside = rng.normal(size=points.shape)
    aside /= np.linalg.norm(aside, axis=1, keepdims=True)
    steps = [noise(points + length * aside, cells=((0.1, 1.0),), seed=3) - values for length in (0.05, 0.5)]
    assert steps[0].std() < 0.6  # an eighth of the shortest wavelength away it is nearly the same
    assert steps[1].std() > 1.0  # and half of a mean one away it is another
    line = np.linspace(0, 1, 10_001)[:, None] * (0.48, 0.6, 0.64)
    assert np.abs(np.diff(noise(line, cells=((0.1, 1.0),), seed=3))).max() < 0.01  # no jump anywhere
