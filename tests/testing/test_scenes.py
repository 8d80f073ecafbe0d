"""The synthetic scenes: their truth is held against closed forms, and each is the hard place that it claims to be."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pano_mvs.geometry import Rigid3, pixel_from_ray, ray_grid, rotation_from_rotvec, sample_panorama
from pano_mvs.io.truth import read_truth
from pano_mvs.testing.room import Room, range_along, render
from tests.stored import read_picture
from tests.synthetic.paints import STEEL
from tests.synthetic.rod import Rod
from tests.synthetic.scenes import SCENES, courtyard, poles, white_room, write_scene

SIZE = (64, 128)


@given(turn=st.tuples(*[st.floats(-3, 3)] * 3), tilt=st.tuples(*[st.floats(-0.7, 0.7)] * 3))
@settings(max_examples=20, deadline=None)
def test_points_of_a_rod_are_a_radius_off_its_axis_and_between_its_ends(
    turn: tuple[float, float, float], tilt: tuple[float, float, float]
) -> None:
    foot, head = np.array([0.4, 1.5, 2.0]), np.array([0.4, -1.5, 2.0]) + tilt
    rod = Rod(tuple(foot), tuple(head), 0.3, STEEL)
    pose = Rigid3.from_center(rotation_from_rotvec(turn), (0.1, -0.2, 0.3))
    rays = ray_grid(SIZE).reshape(-1, 3) @ pose.rotation
    distance, normals = rod.hit(pose.center, rays)
    met = np.isfinite(distance)
    assert met.sum() > 20
    points = pose.center + distance[met, None] * rays[met]
    axis = (head - foot) / np.linalg.norm(head - foot)
    along = (points - foot) @ axis
    off = points - foot - along[:, None] * axis
    assert np.linalg.norm(off, axis=1) == pytest.approx(0.3, abs=1e-9)
    assert along.min() >= 0
    assert along.max() <= np.linalg.norm(head - foot)
    outward = np.sum(off * normals[met], axis=1) > 0  # through the open ends the inside is seen
    np.testing.assert_allclose(normals[met], np.where(outward, 1, -1)[:, None] * off / 0.3, atol=1e-9)
    assert np.all(np.sum(normals[met] * rays[met], axis=1) < 0)


def test_a_rod_across_the_view_is_as_near_as_its_axis_less_its_radius() -> None:
    rod = Rod((-1, 0, 2), (1, 0, 2), 0.1, STEEL)
    rays = np.array([[0, 0, 1.0], [0, 0, -1], [1, 0, 0]])
    assert rod.hit(np.zeros(3), rays)[0].tolist() == [pytest.approx(1.9), np.inf, np.inf]
    assert rod.hit(np.array([0, 0, 2.0]), rays)[0][0] == pytest.approx(0.1)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_ranges_of_a_scene_are_exact_and_its_views_agree(name: str) -> None:
    scene = SCENES[name](seed=3)
    (image, ranges), (other, other_ranges) = (scene.view(idx, SIZE) for idx in (0, 1))
    exact = range_along(scene.room, scene.poses[0].center, ray_grid(SIZE).reshape(-1, 3) @ scene.poses[0].rotation)
    np.testing.assert_array_equal(np.nan_to_num(ranges, nan=np.inf).ravel(), exact.astype(np.float32))
    second_from_first = scene.poses[1] @ scene.poses[0].inverse()
    points = second_from_first.apply(ranges[..., None] * ray_grid(SIZE))
    distance = np.linalg.norm(points, axis=-1)
    with np.errstate(invalid="ignore"):
        exact = range_along(
            scene.room, scene.poses[1].center, (points / distance[..., None]).reshape(-1, 3) @ scene.poses[1].rotation
        )
        visible = np.abs(exact.reshape(SIZE) / distance - 1) < 1e-4
        assert np.all((exact.reshape(SIZE) <= distance * (1 + 1e-4))[np.isfinite(ranges)]), "nothing is seen through"
    assert visible.mean() > 0.35
    pixels = pixel_from_ray(np.where(visible[..., None], points, (0.0, 0, 1)), SIZE)
    error = np.abs(sample_panorama(other.astype(np.float32), pixels) - image)[visible].mean()
    shuffled = np.abs(np.roll(image, 41, axis=1).astype(float) - image)[visible].mean()
    assert error < 0.6 * shuffled
    assert other_ranges.shape == SIZE


@pytest.mark.parametrize("name", SCENES)
def test_cameras_are_turned_at_random_and_stand_free_and_apart(name: str) -> None:
    scene = SCENES[name](views=6)
    turns = [np.degrees(np.arccos((np.trace(pose.rotation) - 1) / 2)) for pose in scene.poses]
    assert np.ptp(turns) > 30
    centers = np.array([pose.center for pose in scene.poses])
    apart = np.linalg.norm(centers[:, None] - centers, axis=-1) + 9 * np.eye(6)
    assert apart.min() > 0.2
    for center in centers:
        assert range_along(scene.room, center, ray_grid(SIZE).reshape(-1, 3)).min() > 0.3
    level = SCENES[name](views=6, turned=False)
    np.testing.assert_allclose([pose.center for pose in level.poses], centers, atol=1e-12)
    assert all(np.array_equal(pose.rotation, np.eye(3)) for pose in level.poses)


def test_the_court_has_sky_and_ranges_to_sixty() -> None:
    _, ranges = courtyard(turned=False).view(0, SIZE, supersample=1)
    assert 0.25 < np.isnan(ranges).mean() < 0.45
    assert np.isnan(ranges[0]).all()
    assert np.nanmin(ranges) == pytest.approx(1.6, abs=0.1)
    assert 50 < np.nanmax(ranges) < 65


def test_walls_of_the_white_room_are_plain_but_for_noise() -> None:
    scene = white_room(turned=False)
    image, _ = scene.view(0, SIZE)
    ceiling, floor = image[4:16].astype(float), image[48:60].astype(float)
    steps = [np.abs(np.diff(part, axis=1)).mean() for part in (ceiling, floor)]
    assert steps[0] < 2.5
    assert steps[1] > 4 * steps[0]
    again, _ = scene.view(0, SIZE)
    np.testing.assert_array_equal(again, image)


def test_rods_are_a_few_pixels_thick() -> None:
    with_rods = poles(turned=False).room
    without = Room(with_rods.surfaces[:11])
    rays = ray_grid((512, 1024))[200:312].reshape(-1, 3)
    hidden = range_along(with_rods, np.zeros(3), rays) < range_along(without, np.zeros(3), rays) - 1e-9
    run = np.diff(np.flatnonzero(np.diff(np.pad(hidden.reshape(112, 1024)[56].astype(int), 1))))[::2]
    assert len(run) > 10
    assert 1 < np.median(run) <= 5


@pytest.mark.slow
def test_exposure_changes_pictures_and_not_ranges() -> None:
    plain, exposed = courtyard(), courtyard(exposure=0.15)
    (image, ranges), (other, other_ranges) = plain.view(1, SIZE), exposed.view(1, SIZE)
    np.testing.assert_array_equal(ranges, other_ranges)
    mid = (image > 40) & (image < 160)
    found = [np.polyfit(image[..., k][mid[..., k]], other[..., k][mid[..., k]], 1) for k in range(3)]
    np.testing.assert_allclose([fit[0] for fit in found], exposed.gains[1], rtol=0.05)
    np.testing.assert_allclose([fit[1] for fit in found], exposed.offsets[1], atol=3)
    assert np.ptp(np.log(exposed.gains)) > 0.1


def test_a_written_scene_is_read_back_with_its_truth(tmp_path: Path) -> None:
    scene = white_room(views=2)
    write_scene(tmp_path, scene, SIZE)
    truth = read_truth(tmp_path / "truth")
    names = sorted(truth.views)
    for idx, name in enumerate(names):
        image, ranges = scene.view(idx, SIZE)
        np.testing.assert_allclose(truth.views[name].cam_from_world.rotation, scene.poses[idx].rotation, atol=1e-12)
        np.testing.assert_array_equal(truth.range_map(truth.views[name]), ranges)
        read = read_picture(tmp_path / name)[..., ::-1]
        np.testing.assert_array_equal(read, image)


@pytest.mark.slow
def test_a_far_wall_does_not_flicker_between_views() -> None:
    """Texture finer than a pixel once made far walls look different from every place."""
    scene = courtyard(turned=False)
    ranges = render(scene.room, scene.poses[0], SIZE, supersample=1)[1]
    fine, coarse = (render(scene.room, scene.poses[0], SIZE, supersample=n)[0].astype(float) for n in (4, 1))
    far = (ranges > 20) & (np.ptp([np.roll(ranges, step, 1) for step in (-1, 0, 1)], axis=0) < 3)
    assert far.sum() > 30
    assert np.median(np.abs(fine - coarse)[far]) < 10
