"""The bilateral solver: its cells, its linear system against dense elimination, and what it does to ranges."""

from __future__ import annotations

from functools import partial
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.filters.bilateral_solver import fast_bilateral_solver, solve_bilateral, sphere_cells
from pano_mvs.algorithms.filters.kernels_bilateral import COLOR_BINS
from pano_mvs.geometry import Rigid3, angle_between, ray_grid
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import default_room, render
from tests.algorithms.range_scenes import as_map, rolled
from tests.oracles.range_errors import errors_of_ranges
from tests.oracles.range_filters import corner_weights, dense_system

View = tuple[NDArray[np.uint8], NDArray[np.float32]]

SIZE = (128, 256)

smooth_all = partial(fast_bilateral_solver, keep_confidence=256, max_hole_deg=0)


@pytest.fixture(scope="module")
def view() -> View:
    image, ranges = render(default_room(), Rigid3.identity(), SIZE)
    return image, ranges


def harmed(ranges: NDArray[Any], seed: int = 0) -> RangeMap:
    """5 % noise, 20 % outliers of low confidence, holes."""
    rng = np.random.default_rng(seed)
    noisy = ranges * (1 + 0.05 * rng.standard_normal(ranges.shape))
    outlier = rng.random(ranges.shape) < 0.2
    noisy[outlier] = rng.uniform(0.5, 5, outlier.sum())
    hole = np.kron(rng.random((ranges.shape[0] // 8, ranges.shape[1] // 8)) < 0.1, np.ones((8, 8))) > 0
    noisy[hole] = np.nan
    confidence = np.where(outlier, 70, 200)
    return as_map(noisy, confidence)


@pytest.mark.parametrize("size", [(16, 32), (64, 128), (60, 100), (33, 66)])
@pytest.mark.parametrize("cell_px", [4, 8])
class TestCells:
    def test_neighbours_are_mutual(self, size: tuple[int, int], cell_px: int) -> None:
        cells = sphere_cells(size, cell_px)
        count = len(cells.starts) - 1
        dense = np.zeros((count, count))
        for cell in range(count):
            for position in range(cells.starts[cell], cells.starts[cell + 1]):
                dense[cell, cells.neighbours[position]] += cells.strengths[position]
        np.testing.assert_allclose(dense, dense.T, atol=1e-12)
        assert (np.diag(dense) == 0).all()
        assert dense.sum(axis=1).min() >= 4 - 1e-9  # left, right, above and below, everywhere on the sphere

    def test_weights_place_a_pixel_between_cells(self, size: tuple[int, int], cell_px: int) -> None:
        """A smooth function on the sphere, taken at the cells' middles, comes back at the pixels."""
        cells = sphere_cells(size, cell_px)
        rays = ray_grid(size)
        count = len(cells.starts) - 1
        total, weight = np.zeros((count, 3)), np.zeros(count)
        for row in range(size[0]):
            for column in range(size[1]):
                corners = cells.corners[cells.element_of_pixel[cells.gap_of_row[row], column]]
                shares = corner_weights(cells, row, column)
                assert shares.sum() == pytest.approx(1)
                np.add.at(total, corners, shares[:, None] * rays[row, column])
                np.add.at(weight, corners, shares)
        middles = total / weight[:, None]
        for row in range(0, size[0], 3):
            for column in range(0, size[1], 5):
                corners = cells.corners[cells.element_of_pixel[cells.gap_of_row[row], column]]
                found = corner_weights(cells, row, column) @ middles[corners]
                assert angle_between(found, rays[row, column]) < 0.5 * cell_px * np.pi / size[0]


@pytest.mark.kernel("filters.kernels_bilateral")
@pytest.mark.parametrize("smoothness", [0.1, 4, 100])
@pytest.mark.parametrize("holes", [0.0, 0.5])
def test_the_solution_is_that_of_the_dense_system(smoothness: float, holes: float) -> None:
    rng = np.random.default_rng(2)
    size = (16, 32)
    cells = sphere_cells(size, 4)
    bins = np.stack([rng.integers(1, 4, size), np.full(size, 2), rng.integers(1, 3, size)], axis=-1)
    colors = (bins[..., 0] * COLOR_BINS + bins[..., 1]) * COLOR_BINS + bins[..., 2]
    target = rng.uniform(1, 3, size)
    weight = np.where(rng.random(size) < holes, 1e-4, rng.uniform(0.1, 1, size))
    matrix, right, splat = dense_system(target, weight, bins, cells, smoothness)
    expected = (np.linalg.solve(matrix, right) @ splat).reshape(size)
    found, _ = solve_bilateral(target, weight, colors, cells=cells, smoothness=smoothness, iterations=2000)
    np.testing.assert_allclose(found, expected, rtol=2e-3)


@pytest.mark.parametrize("domain", ["inverse", "range"])
def test_it_recovers_ranges_from_noise_outliers_and_holes(view: View, domain: Literal["range", "inverse"]) -> None:
    image, truth = view
    broken = harmed(truth)
    before = errors_of_ranges(np.nan_to_num(broken.range, nan=2.5), truth)
    solved = smooth_all(broken, image, domain=domain, sigma_spatial=4)
    solved.check()
    after = errors_of_ranges(solved.range, truth)
    assert after.completeness == 1
    assert after.psnr_db > before.psnr_db + 10
    assert after.mae < 0.5 * before.mae
    # A higher PSNR is easily had by blurring: the share of exact pixels must grow too.
    assert after.near > before.near + 0.2


def test_it_keeps_an_edge_that_the_picture_shows_and_smooths_one_that_it_does_not() -> None:
    image = np.full((*SIZE, 3), 60, np.uint8)
    image[:, 64:128] = 180
    ranges = np.full(SIZE, 4.0)
    ranges[:, 64:128] = 2.0
    rng = np.random.default_rng(1)
    noisy = as_map(ranges * (1 + 0.05 * rng.standard_normal(SIZE)), 200)
    kept = smooth_all(noisy, image, smoothness=50).range
    assert np.abs(kept / ranges - 1)[40:90].max() < 0.03
    blurred = smooth_all(noisy, np.full_like(image, 60), smoothness=50).range
    assert np.abs(blurred / ranges - 1)[40:90, 60:68].mean() > 0.15


def test_a_plane_keeps_its_slant() -> None:
    """A ceiling all over the upper half, in one colour: linear weights and 1/range leave no staircase."""
    size = (256, 512)
    down = np.abs(ray_grid(size)[..., 1])
    ranges = np.minimum(1.5 / np.maximum(down, 0.1), 15)
    solved = smooth_all(as_map(ranges, 200), np.full((*size, 3), 128, np.uint8), smoothness=4).range
    steep = down > 0.3
    assert np.median(np.abs(solved / ranges - 1)[steep]) < 0.005
    assert np.abs(solved / ranges - 1)[steep].max() < 0.02


@pytest.mark.parametrize("columns", [8, 64, 3, 125])
def test_rolling_the_input_rolls_the_output(view: View, columns: int) -> None:
    """Cells begin somewhere, so a roll by part of a cell changes a little; a crack at the seam would be large."""
    image, truth = view
    broken = harmed(truth)
    solved = smooth_all(broken, image).range
    turned = smooth_all(rolled(broken, columns), np.roll(image, columns, 1)).range
    change = np.abs(turned / np.roll(solved, columns, 1) - 1)
    assert np.median(change) < (0.001 if columns % 8 == 0 else 0.01)
    assert np.quantile(change, 0.9) < (0.02 if columns % 8 == 0 else 0.06)
    # No worse at the old and the new seam than elsewhere.
    seam = change[:, [0, 1, -1, columns - 1, columns % SIZE[1]]]
    assert np.quantile(seam, 0.9) < 2 * np.quantile(change, 0.9) + 1e-3


def test_holes_are_filled_and_marked_and_nothing_else_is(view: View) -> None:
    image, truth = view
    broken = harmed(truth)
    filled = smooth_all(broken, image)
    new = ~broken.valid
    assert filled.valid.all()
    assert 1 <= filled.confidence[new].min() <= filled.confidence[new].max() <= 63
    np.testing.assert_array_equal(filled.confidence[~new], broken.confidence[~new])
    left = smooth_all(broken, image, fill=False)
    left.check()
    np.testing.assert_array_equal(left.valid, broken.valid)
    np.testing.assert_array_equal(left.range[~new], filled.range[~new])


def test_a_colour_that_has_no_range_at_all_gets_one() -> None:
    image = np.zeros((64, 128, 3), np.uint8)
    image[20:40, 30:60] = (250, 20, 20)
    ranges = np.full((64, 128), 3.0)
    ranges[20:40, 30:60] = np.nan
    np.testing.assert_allclose(smooth_all(as_map(ranges), image).range, 3.0, rtol=1e-3)


def test_no_range_anywhere_is_returned_as_it_is() -> None:
    empty = as_map(np.full((16, 32), np.nan))
    assert smooth_all(empty, np.zeros((16, 32, 3), np.uint8)) is empty


def test_a_map_that_nobody_checked_is_solved_as_if_all_were_sure(view: View) -> None:
    image, truth = view
    weak, sure = as_map(harmed(truth).range, 100), as_map(harmed(truth).range, 200)
    np.testing.assert_allclose(smooth_all(weak, image).range, smooth_all(sure, image).range, rtol=1e-4)


@pytest.mark.parametrize("height", [25, 50, 75, 100, 150])
def test_corners_of_cells_without_a_pixel_do_not_stop_the_solution(height: int) -> None:
    """In pictures of some heights (75, 100, 150, 333, 375 rows …) their 0 / 0 once made the solver return its input."""
    size_hw = height, 2 * height
    rows, columns = np.indices(size_hw)
    picture = np.repeat(((rows + columns) % 200).astype(np.uint8)[..., None], 3, axis=-1)
    ranges = np.random.default_rng(height).uniform(1.9, 2.1, size_hw).astype(np.float32)
    solved = fast_bilateral_solver(RangeMap(ranges, np.full(size_hw, 90, np.uint8)), picture)
    assert solved.valid.all()
    assert solved.range.std() < 0.5 * ranges.std()
