"""Positions on the Earth, and poses that are fitted to them."""

from __future__ import annotations

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.poses.frame.gauge import in_gauge_of, moved_poses, normalised_poses
from pano_mvs.algorithms.poses.frame.georeference import fit_gps, fit_survey, georeferenced_poses, scaled_by_gps
from pano_mvs.core.errors import ContractError
from pano_mvs.geometry import Rigid3, Similarity3, rotation_from_rotvec
from pano_mvs.geometry.geodesy import lla_from_local, local_from_lla
from pano_mvs.scene import Poses, WorldAxes
from tests.algorithms.poses.synthetic_capture import random_rotation

UP = np.array([0.0, -1.0, 0.0])
HOME = np.array([47.5, 8.25, 410.0])
NOISE_M = 3.0


def street(rng: np.random.Generator, count: int, *, step_m: float = 8.0, bend_deg: float = 4.0) -> Poses:
    """A walk north-east along a bending street, in metres east, down, north; cameras turned about the vertical."""
    headings = np.cumsum(np.deg2rad(rng.normal(bend_deg, 3, count))) + 0.6
    steps = step_m * np.stack([np.sin(headings), 0.02 * rng.normal(size=count), np.cos(headings)], axis=1)
    centers = np.cumsum(steps, axis=0)
    poses = {
        f"{n:03d}.jpg": Rigid3.from_center(rotation_from_rotvec([0, rng.uniform(-3, 3), 0]), center)
        for n, center in enumerate(centers)
    }
    bare = Poses.without_points(poses, frame="", scale="", metric=False)
    return replace(
        bare,
        points_in_world=rng.normal(size=(5, 3)) * 20,
        point_colors_rgb=np.zeros((5, 3), np.uint8),
        point_errors_rad=np.full(5, 0.002, np.float32),
    )


def positions(poses: Poses, rng: np.random.Generator, noise_m: float) -> dict[str, tuple[float, ...]]:
    noise = noise_m * rng.normal(size=(len(poses.names), 3)) * (1, 3, 1)
    return dict(zip(poses.names, map(tuple, lla_from_local(poses.centers + noise, HOME)), strict=True))


def test_axes_are_east_down_north_in_metres() -> None:
    """One second of latitude is 30.9 m, one of longitude 30.9 m times the cosine, at 47.5° north."""
    second = 1 / 3600
    north = local_from_lla(HOME + np.array([second, 0, 0]), HOME)
    east = local_from_lla(HOME + np.array([0, second, 0]), HOME)
    np.testing.assert_allclose(north, [0, 0, 30.885], atol=0.01)
    np.testing.assert_allclose(east, [20.94, 0, 0], atol=0.01)
    np.testing.assert_allclose(local_from_lla(HOME + np.array([0, 0, 5]), HOME), [0, -5, 0], atol=1e-6)


def test_the_ellipsoid_is_that_of_wgs_84() -> None:
    """A quarter of the meridian and of the equator, as the chords of known radii."""
    pole = local_from_lla([90.0, 0, 0], [0.0, 0, 0])
    np.testing.assert_allclose(pole, [0, 6378137.0, 6356752.3142], atol=1e-3)
    np.testing.assert_allclose(local_from_lla([0.0, 90, 0], [0.0, 0, 0]), [6378137.0, 6378137.0, 0], atol=1e-6)


@pytest.mark.parametrize("origin", [(47.5, 8.25, 410.0), (-33.9, 151.2, 10.0), (89.9, 10.0, 0.0), (0.0, 180.0, -50.0)])
def test_there_and_back(origin: tuple[float, float, float]) -> None:
    offsets = np.random.default_rng(1).normal(size=(50, 3)) * (2000, 100, 2000)
    there = lla_from_local(offsets, origin)
    np.testing.assert_allclose(local_from_lla(there, origin), offsets, atol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_fit_recovers_scale_and_heading_despite_wrong_positions(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = street(rng, 24)
    known = positions(true, rng, 1.5)
    for name in ("002.jpg", "011.jpg", "017.jpg", "018.jpg"):
        known[name] = (known[name][0] + rng.normal() / 500, known[name][1] + rng.normal() / 500, 0.0)
    turn = random_rotation(rng)
    solved = moved_poses(true, Similarity3(0.2, turn, rng.normal(size=3)))
    fit = fit_gps(solved, known, turn @ UP, gps_noise_m=NOISE_M, rng=rng)
    assert fit
    assert 18 <= fit.used <= 21
    scaled = scaled_by_gps(solved, fit)
    assert scaled.metric
    assert "metres, by GPS of" in scaled.scale
    np.testing.assert_allclose(scaled.rotations, solved.rotations, atol=1e-12)
    ratio = np.linalg.norm(scaled.centers[5] - scaled.centers[0]) / np.linalg.norm(true.centers[5] - true.centers[0])
    assert ratio == pytest.approx(1, abs=4 * fit.scale_error)
    assert abs(ratio - 1) < 0.04
    world = georeferenced_poses(solved, fit)
    np.testing.assert_allclose(world.centers, true.centers - true.centers[0], atol=3.0)
    np.testing.assert_allclose(world.points_in_world, true.points_in_world - true.centers[0], atol=6.0)
    np.testing.assert_array_equal(world.centers[0], 0)
    np.testing.assert_array_equal(world.point_errors_rad, true.point_errors_rad)
    assert "x east, y down, z north, by GPS" in world.frame
    assert world.axes is WorldAxes.NORTH
    assert solved.origin_lla is None
    world.check()


def test_exact_positions_give_the_exact_world() -> None:
    rng = np.random.default_rng(9)
    true = street(rng, 6)
    turn = random_rotation(rng)
    solved = moved_poses(true, Similarity3(5.0, turn, np.ones(3)))
    world = georeferenced_poses(
        solved, fit_gps(solved, positions(true, rng, 0.0), turn @ UP, gps_noise_m=0.02, rng=rng)
    )
    np.testing.assert_allclose(world.centers, true.centers - true.centers[0], atol=2e-3)
    np.testing.assert_allclose(world.rotations, true.rotations, atol=1e-5)
    latitude, longitude, altitude = lla_from_local(true.centers[0], HOME)
    told = re.search(r"\(([\d.]+)°, ([\d.]+)°, ([\d.]+) m\)", world.frame)
    assert told
    np.testing.assert_allclose([float(number) for number in told.groups()], [latitude, longitude, altitude], atol=0.06)
    np.testing.assert_allclose(float(told.group(1)), latitude, atol=2e-7)


def test_a_survey_gives_its_own_axes() -> None:
    """Easting and northing of a national grid have seven digits; z points up."""
    rng = np.random.default_rng(9)
    true = street(rng, 6)
    surveyed = {
        name: (2_600_000.0 + east, 1_200_000.0 + north, 400.0 - down)
        for name, (east, down, north) in zip(true.names, true.centers, strict=True)
    }
    turn = random_rotation(rng)
    solved = moved_poses(true, Similarity3(5.0, turn, np.ones(3)))
    fit = fit_survey(solved, surveyed, turn @ UP, noise_m=0.02, rng=rng, survey="points.csv")
    world = georeferenced_poses(solved, fit)
    np.testing.assert_allclose(world.centers, true.centers - true.centers[0], atol=2e-3)
    np.testing.assert_allclose(world.rotations, true.rotations, atol=1e-5)
    assert (world.axes, world.origin_lla, world.metric) == (WorldAxes.LEVEL, None, True)
    assert world.frame.startswith("x as x, y down, z as y in points.csv; origin at the first registered camera (26000")
    assert world.scale.startswith("metres, by the positions in points.csv of 6 of 6 panoramas")
    placed = replace(solved, axes=WorldAxes.NORTH, origin_lla=tuple(HOME))
    again = georeferenced_poses(placed, fit)
    assert (again.axes, again.origin_lla) == (WorldAxes.LEVEL, None), "of the GPS, which the survey replaces"
    again.check()
    few = dict(list(surveyed.items())[:2])
    reason = fit_survey(solved, few, turn @ UP, noise_m=0.02, rng=rng, survey="points.csv").reason
    assert reason == "2 of 6 registered panoramas have a position in points.csv; 3 are needed"


def test_many_positions_are_fitted_by_a_draw_of_pairs() -> None:
    rng = np.random.default_rng(2)
    true = street(rng, 200, bend_deg=1.0)
    known = positions(true, rng, 2.0)
    known |= dict.fromkeys(true.names[::5], (47.6, 8.3, 0.0))
    fit = fit_gps(true, known, UP, gps_noise_m=NOISE_M, rng=np.random.default_rng(0))
    assert fit.local_from_world.scale == pytest.approx(1, abs=0.005)
    assert fit.used == pytest.approx(160, abs=4)
    again = fit_gps(true, known, UP, gps_noise_m=NOISE_M, rng=np.random.default_rng(0))
    assert again.local_from_world.scale == fit.local_from_world.scale


def test_a_room_is_too_small_for_gps() -> None:
    rng = np.random.default_rng(3)
    true = street(rng, 6, step_m=0.7)
    fit = fit_gps(true, positions(true, rng, 2.0), UP, gps_noise_m=NOISE_M, rng=rng)
    assert not fit
    assert "too close for positions that are good to" in fit.reason
    assert fit_gps(true, positions(true, rng, 0.01), UP, gps_noise_m=0.01, rng=rng)


def test_positions_that_have_nothing_to_do_with_the_poses_are_refused() -> None:
    rng = np.random.default_rng(4)
    true = street(rng, 12)
    shuffled = dict(zip(true.names, rng.permutation(list(positions(true, rng, 0.1).values())), strict=True))
    assert "positions by GPS fit the camera poses" in fit_gps(true, shuffled, UP, gps_noise_m=NOISE_M, rng=rng).reason


@pytest.mark.parametrize("same", ["poses", "positions"])
def test_one_place_is_no_scale(same: str) -> None:
    rng = np.random.default_rng(5)
    true = street(rng, 5)
    known = positions(true, rng, 0.0)
    if same == "poses":
        true = replace(true, translations=np.zeros((5, 3)))
    else:
        known = dict.fromkeys(true.names, tuple(HOME))
    fit = fit_gps(true, known, UP, gps_noise_m=NOISE_M, rng=rng)
    assert not fit
    assert fit.reason


def test_two_positions_are_too_few() -> None:
    rng = np.random.default_rng(6)
    true = street(rng, 5)
    known = dict(list(positions(true, rng, 0.0).items())[:2])
    assert (
        "2 of 5 registered panoramas have a GPS position; 3"
        in fit_gps(true, known, UP, gps_noise_m=NOISE_M, rng=rng).reason
    )


@pytest.mark.parametrize("home", [HOME, np.array([-33.9, -70.65, -12.3]), np.array([0.0000001, 179.9, 0.0])])
def test_the_world_tells_where_its_origin_is(home: NDArray[Any]) -> None:
    rng = np.random.default_rng(11)
    poses = street(rng, 12)
    lla = {name: tuple(lla_from_local(center, home)) for name, center in zip(poses.names, poses.centers, strict=True)}
    world = georeferenced_poses(poses, fit_gps(poses, lla, UP, gps_noise_m=0.01, rng=rng))
    assert world.origin_lla is not None
    assert np.abs(local_from_lla(world.origin_lla, lla[poses.names[0]])).max() < 0.01


def test_a_world_that_is_turned_or_moved_does_not_keep_what_was_known_of_it() -> None:
    rng = np.random.default_rng(12)
    placed = replace(street(rng, 4), axes=WorldAxes.NORTH, origin_lla=(47.5, 8.25, 410.0))
    placed.check()
    turn, nothing = random_rotation(rng), np.zeros(3)

    def known(poses: Poses) -> tuple[WorldAxes, bool]:
        poses.check()
        return poses.axes, poses.origin_lla is not None

    assert known(moved_poses(placed, Similarity3(2.0, np.eye(3), nothing))) == (WorldAxes.NORTH, True)
    assert known(moved_poses(placed, Similarity3(2.0, np.eye(3), np.ones(3)))) == (WorldAxes.NORTH, False)
    turned = moved_poses(placed, Similarity3(2.0, turn, nothing))
    assert known(turned) == (WorldAxes.UNKNOWN, False)
    assert known(normalised_poses(placed)) == (WorldAxes.UNKNOWN, False)
    for metric in (True, False):  # an adjustment leaves the world, and comes back
        assert known(in_gauge_of(replace(placed, metric=metric), 2 * placed.centers)) == (WorldAxes.NORTH, True)
    with pytest.raises(ContractError, match="a world with origin_lla must have the axes NORTH"):
        replace(placed, axes=WorldAxes.LEVEL).check()
