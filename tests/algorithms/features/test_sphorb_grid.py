"""The geodesic grid, the smoothing on the sphere, and the layout of SPHORB's tests."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pano_mvs.algorithms.faces.layout import face_centers
from pano_mvs.algorithms.features import sphorb
from pano_mvs.algorithms.features.sphorb import NEIGHBOURS, GeodesicGrid, extract_sphorb, grid_pyramid, smooth_panorama
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import angle_between, ray_grid, roll_panorama

GRID = GeodesicGrid(40, 32)


def owned_places(grid: GeodesicGrid, *, beyond: int = 0) -> NDArray[np.float64]:
    v, u = np.mgrid[-beyond : grid.steps + 2 * beyond + 1, -beyond : grid.steps + 2 * beyond + 1]
    inside = u + v <= grid.steps + beyond
    return np.stack([u[inside], v[inside]], axis=-1).astype(np.float64)


def all_cells(grid: GeodesicGrid) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    places = owned_places(grid)
    faces = np.repeat(np.arange(20), len(places))
    return faces, np.tile(places, (20, 1))


def test_faces_own_what_is_nearest_to_their_centres() -> None:
    faces, places = all_cells(GRID)
    nearness = GRID.bearings(faces, places) @ face_centers().T
    assert np.all(nearness[np.arange(len(faces)), faces] >= nearness.max(axis=1) - 1e-9)


def test_grids_of_faces_meet_in_the_same_cells() -> None:
    """10 n² + 2 different cells: those on an edge are in two faces, the corners in five."""
    bearings = GRID.bearings(*all_cells(GRID))
    pairs = cKDTree(bearings).query_pairs(1e-9, output_type="ndarray")
    duplicate = np.unique(pairs.max(axis=1))
    assert len(bearings) - len(duplicate) == 10 * GRID.steps**2 + 2


def test_cells_are_nearly_equal_and_hexagonal() -> None:
    faces, places = all_cells(GRID)
    bearings = GRID.bearings(faces, places)
    steps = [angle_between(bearings, GRID.bearings(faces, places + step)) / GRID.spacing_rad for step in NEIGHBOURS]
    assert np.min(steps) > 0.85
    assert np.max(steps) < 1.2
    areas = 1 / np.abs(np.linalg.det(GRID.lattice_from_tangent(faces, places))) / np.sqrt(0.75)
    assert areas.min() > 0.9
    assert areas.max() < 1.12


def test_tangent_steps_go_as_far_as_they_say_and_all_turn_one_way() -> None:
    rng = np.random.default_rng(0)
    grid = GeodesicGrid(200, 32)
    faces, places = all_cells(grid)
    chosen = rng.choice(len(faces), 500, replace=False)
    faces, places = faces[chosen], places[chosen]
    turns = grid.lattice_from_tangent(faces, places)
    bearings = grid.bearings(faces, places)
    east, north = (grid.bearings(faces, places + turns @ axis) - bearings for axis in np.eye(2))
    for step in (east, north):
        np.testing.assert_allclose(np.linalg.norm(step, axis=1), grid.spacing_rad, rtol=0.01)
    assert np.abs(np.sum(east * north, axis=1)).max() < 0.02 * grid.spacing_rad**2
    assert np.all(np.sum(np.cross(east, north) * bearings, axis=1) > 0.9 * grid.spacing_rad**2)


@pytest.mark.parametrize("steps", [24, 60, 228])
def test_patches_stay_within_the_margin(steps: int) -> None:
    """From the farthest cell that is looked at, and at most three steps of climbing farther."""
    grid = GeodesicGrid(steps, sphorb._MARGIN)
    places = owned_places(grid, beyond=1)
    turns = grid.lattice_from_tangent(np.zeros(len(places), np.intp), places)
    reach = np.linalg.norm(turns, axis=2) * sphorb._CLEARANCE + 3
    assert np.all(places - reach > -sphorb._MARGIN)
    assert np.all(places + reach < steps + sphorb._MARGIN)


def test_the_grid_shows_what_lies_in_its_directions() -> None:
    size_hw, axis = (256, 512), np.array([0.5, 0.6, -0.62])
    image = np.rint(127 + 120 * (ray_grid(size_hw) @ axis)).astype(np.uint8)
    sampled = GRID.sample(image)
    faces, places = all_cells(GRID)
    column, row = (places + GRID.margin).astype(int).T
    expected = 127 + 120 * (GRID.bearings(faces, places) @ axis)
    assert np.abs(sampled[faces, row, column] - expected).max() < 2.0


def test_levels_shrink_by_the_scale() -> None:
    steps = [grid.steps for grid in grid_pyramid(1280, 7)]
    assert steps[0] == 228
    np.testing.assert_allclose(np.divide(steps[:-1], steps[1:]), 1.2, rtol=0.02)
    assert [grid.steps for grid in grid_pyramid(64, 7)] == [24]


def test_tests_are_within_the_patch_and_as_many_as_bits() -> None:
    tests = sphorb.binary_tests()
    assert tests.shape == (256, 4)
    assert np.hypot(tests[:, [0, 2]], tests[:, [1, 3]]).max() <= 15
    assert np.abs(tests.mean(axis=0)).max() < 1.5


@pytest.mark.parametrize("elevation_deg", [0, 50, 80])
def test_smoothing_spreads_a_spot_alike_everywhere(elevation_deg: int) -> None:
    """A spot of 4 px becomes one of 5 px when smoothed by 3 px; on the panorama the last is 5 times wider than high."""
    size_hw, pixel = (256, 512), 2 * np.pi / 512
    elevation = np.deg2rad(elevation_deg)
    center = np.array([0.0, -np.sin(elevation), np.cos(elevation)])
    distance_px = angle_between(ray_grid(size_hw), center) / pixel
    spot = np.rint(220 * np.exp(-0.5 * (distance_px / 4) ** 2)).astype(np.uint8)
    smoothed = smooth_panorama(spot, np.array([3.0]))[0]
    expected = 220 * (4 / 5) ** 2 * np.exp(-0.5 * (distance_px / 5) ** 2)
    assert np.abs(smoothed - expected).max() < 6


def test_smoothing_commutes_with_rolling() -> None:
    rng = np.random.default_rng(1)
    noise = cv2.GaussianBlur(rng.integers(0, 256, (64, 128)).astype(np.uint8), (0, 0), 1.0)
    rolled = roll_panorama(noise, 37)[0]
    for one, other in zip(*(smooth_panorama(p, np.array([0.0, 1.5])) for p in (noise, rolled)), strict=True):
        assert np.abs(np.roll(one, 37, axis=1).astype(int) - other).max() <= 1


def test_fewer_levels_find_fewer_and_smaller_key_points() -> None:
    noise = np.random.default_rng(2).integers(0, 256, (64, 128, 3)).astype(np.uint8)
    image = cv2.resize(noise, (512, 256), interpolation=cv2.INTER_CUBIC)
    mask = np.ones((256, 512), np.bool_)
    one, all_levels = (extract_sphorb(image, mask, max_keypoints=30_000, levels=n) for n in (1, 7))
    assert len(one) < len(all_levels)
    assert len(np.unique(one.sizes_rad)) == 1
    assert all_levels.sizes_rad.min() == one.sizes_rad.min()
    # The finest level has fewest steps that fit the picture; up to 1.2 to the sixth power wider are the coarsest.
    assert 2.0 < all_levels.sizes_rad.max() / all_levels.sizes_rad.min() < 3.2


def test_refuses_a_mask_of_another_size() -> None:
    with pytest.raises(UsageError, match="mask"):
        extract_sphorb(np.zeros((64, 128, 3), np.uint8), np.ones((4, 8), np.bool_))
