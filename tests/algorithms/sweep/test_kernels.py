"""Each compiled part of the sweep equals its slow and obvious form."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from pano_mvs.algorithms.sweep.backends.numpy_backend import path_step, winners_of
from pano_mvs.algorithms.sweep.numba import kernels_sgm
from pano_mvs.algorithms.sweep.numba.kernels_combine import combine_row
from pano_mvs.algorithms.sweep.numba.kernels_cost import box_rows, census_row, difference_row
from pano_mvs.algorithms.sweep.numba.kernels_records import Combination
from pano_mvs.algorithms.sweep.numba.kernels_sad import average_differences, one_box_serves
from pano_mvs.algorithms.sweep.numba.kernels_sgm import sweep_row, sweep_strip
from pano_mvs.algorithms.sweep.numba.kernels_source_cost import store_row
from pano_mvs.algorithms.sweep.numba.kernels_winner import (
    AFTER,
    BEFORE,
    BEST,
    RIVAL,
    STATES,
    update_plain,
    update_winners,
    winners_of_rows,
)
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR
from pano_mvs.algorithms.sweep.penalties import DIRECTIONS
from pano_mvs.algorithms.sweep.windows import column_offsets
from pano_mvs.geometry import pad_panorama
from tests.oracles import sweep as oracle

SIZE = 16, 32


def _picture(seed: int, size_hw: tuple[int, int] = SIZE) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, size_hw, dtype=np.uint8)


@pytest.mark.kernel("sweep.numba.kernels_cost")
@pytest.mark.parametrize("row", [0, 1, 8, 15])
def test_census_counts_what_the_definition_counts(row: int) -> None:
    reference, warped = _picture(3) // 16, _picture(4) // 16  # few levels: ties
    offsets = column_offsets(SIZE, 2, spherical=True)
    pad = 8
    disagree = np.zeros(SIZE[1], np.uint8)
    census_row(
        pad_panorama(reference, pad), row + pad, pad_panorama(warped, pad), row + pad, offsets[row], pad, disagree
    )
    expected = [oracle.census_cost(reference, warped, row, column, offsets[row]) for column in range(SIZE[1])]
    assert disagree.tolist() == expected


@pytest.mark.kernel("sweep.numba.kernels_cost")
def test_differences_add_up_over_colours() -> None:
    reference, warped = _picture(5), _picture(6)
    total = np.full(SIZE[1], 7, np.uint16)
    difference_row(pad_panorama(reference, 2), 5, pad_panorama(warped, 2), 6, 2, total)
    expected = 7 + np.abs(reference[3].astype(int) - warped[4])
    assert total.tolist() == expected.tolist()


@pytest.mark.kernel("sweep.numba.kernels_cost")
@pytest.mark.parametrize("radius", [1, 3])
def test_running_sums_equal_the_mean_over_each_window(radius: int) -> None:
    cost = np.random.default_rng(7).integers(0, 766, SIZE).astype(np.uint16)
    reach = column_offsets(SIZE, radius, spherical=True)[:, -1].copy()
    pad = int(reach.max()) + 1
    padded = np.ascontiguousarray(pad_panorama(cost, pad)[pad - radius : pad + SIZE[0] + radius])
    scratch = np.zeros((2, SIZE[1] + 2 * pad), np.int32)
    means = np.zeros(SIZE, np.float32)
    box_rows(padded, reach, radius, pad, scratch[0], scratch[1], means)
    expected = [
        [oracle.box_mean(cost, row, column, radius=radius, reach=int(reach[row])) for column in range(SIZE[1])]
        for row in range(SIZE[0])
    ]
    np.testing.assert_allclose(means, expected, rtol=1e-5)


@pytest.mark.kernel("sweep.numba.kernels_sad")
@pytest.mark.parametrize(
    ("sources", "share", "most", "pad", "serves"),
    [
        (3, 1.0, 3, 4, True),
        (3, 0.5, 3, 4, False),
        (3, 1.0, 2, 4, False),
        (3, 0.5, 1, 4, False),
        (1, 0.5, 1, 4, True),
        (85, 1.0, 85, 4, True),
        (86, 1.0, 86, 4, False),
        (80, 1.0, 80, 4096, False),
    ],
)
def test_one_box_serves_where_all_sources_count_and_nothing_overflows(
    sources: int, share: float, most: int, pad: int, serves: bool
) -> None:
    combination = Combination(np.zeros((0, 0, 0), np.float32), share, most, np.float32(9))
    assert one_box_serves(sources, combination, 3, pad) == serves
    weighted = combination._replace(weights=np.ones((sources, 1, 1), np.float32))
    assert not one_box_serves(sources, weighted, 3, pad)


@pytest.mark.kernel("sweep.numba.kernels_sad")
@pytest.mark.parametrize("radius", [0, 2])
def test_differences_are_averaged_over_seams(radius: int) -> None:
    costs = np.random.default_rng(7).integers(0, 65536, (4 + 2 * radius, 20)).astype(np.uint16)
    pad, reach = 5, np.array([0, 1, 2, 4]) if radius else np.zeros(4, np.int64)
    padded = np.zeros((len(costs), 20 + 2 * pad), np.uint16)
    padded[:, pad:-pad] = costs
    means, scratch = np.zeros((4, 20), np.float32), np.zeros((2, 20 + 2 * pad), np.int32)
    average_differences(padded, reach, radius, pad, scratch, means)
    for row, wide in enumerate(reach):
        rows = costs[row : row + 2 * radius + 1].astype(float)
        expected = np.mean([np.roll(rows, shift, axis=1) for shift in range(-wide, wide + 1)], axis=(0, 1))
        np.testing.assert_allclose(means[row], expected, rtol=1e-6)


@pytest.mark.kernel("sweep.numba.kernels_combine")
@pytest.mark.parametrize("sources", [1, 2, 3, 5])
@pytest.mark.parametrize(("share", "most"), [(0.5, 9), (1.0, 9), (1.0, 2)])
@pytest.mark.parametrize("all_vote", [True, False])
@pytest.mark.parametrize("weighted", [True, False])
def test_sources_combine_to_the_mean_of_those_that_count(
    sources: int, share: float, most: int, all_vote: bool, weighted: bool
) -> None:
    rng = np.random.default_rng(sources)
    costs = rng.random((sources, 2, 40)).astype(np.float32)
    weights = rng.random((sources, 3, 40)).astype(np.float32) if weighted else np.zeros((0, 0, 0), np.float32)
    if not all_vote:
        costs[rng.random(costs.shape) < 0.5] = np.inf
    expected = []
    for column in range(40):
        weight = weights[:, 2, column] if weighted else np.ones(sources)
        voting = sorted((float(c), float(w)) for c, w in zip(costs[:, 1, column], weight, strict=True) if c < np.inf)
        expected.append(oracle.combined_cost(voting, share=share, most=most, neutral=9.0))
    result = np.zeros(40, np.float32)
    combination = Combination(weights, share, min(most, sources), np.float32(9))
    combine_row(costs, 1, combination, 2, all_vote, result)
    np.testing.assert_allclose(result, expected, rtol=1e-5)


@pytest.mark.kernel("sweep.numba.kernels_winner", "sweep.numba.x86.kernels_vector_winner")
@pytest.mark.parametrize("kinds", [(np.float32, np.int32), (np.uint16, np.uint16)])
@pytest.mark.parametrize("at_once", [1, 4, 9])
def test_winners_of_a_stream_equal_those_of_the_volume(
    kinds: tuple[type[np.generic], type[np.generic]], at_once: int
) -> None:
    volume = np.random.default_rng(8).integers(0, 12, (3, 9, 500)).astype(kinds[0])  # few levels: ties, both ends
    expected = winners_of(volume.astype(np.float64))
    largest = np.inf if kinds[0] is np.float32 else 65535
    state, plane = np.full((STATES, 3, 500), largest, kinds[0]), np.zeros((3, 500), kinds[1])
    plain = state.copy(), plane.copy()
    for row in range(3):
        for d in range(0, 9, at_once):
            update_winners(volume[row], d, min(at_once, 9 - d), d, state, row, plane)
        update_plain(volume[row], 0, 9, 0, plain[0], row, plain[1], 0)
    np.testing.assert_array_equal(state, plain[0])
    np.testing.assert_array_equal(plane, plain[1])
    np.testing.assert_array_equal(plane, expected.plane)
    np.testing.assert_array_equal(state[BEST], expected.cost)
    np.testing.assert_array_equal(np.where(plane == 0, state[BEST], state[BEFORE]), expected.before)
    np.testing.assert_array_equal(state[AFTER], expected.after)
    np.testing.assert_array_equal(np.where(state[RIVAL] == largest, np.inf, state[RIVAL]), expected.rival)


@pytest.mark.kernel("sweep.numba.kernels_winner", "sweep.numba.x86.kernels_vector_winner")
def test_winners_of_rows_are_those_of_the_volume() -> None:
    volume = np.random.default_rng(9).integers(0, 60000, (5, 21, 45)).astype(np.uint16)
    expected = winners_of(volume.astype(np.float64))
    state, plane = np.full((STATES, 2, 45), 65535, np.uint16), np.zeros((2, 45), np.uint16)
    winners_of_rows(volume, 3, state, plane)
    np.testing.assert_array_equal(plane, expected.plane[3:])
    np.testing.assert_array_equal(state[RIVAL], expected.rival[3:])


@pytest.mark.kernel("sweep.numba.kernels_source_cost")
def test_costs_are_stored_rounded_and_saturated() -> None:
    voxels = np.zeros(5, np.uint8)
    store_row(np.array([0.0, 1.24, 1.26, 100.0, 1e6], np.float32), np.float32(2.0), voxels)
    assert voxels.tolist() == [0, 2, 3, 200, 255]


@pytest.mark.kernel("sweep.numba.kernels_sgm")
@pytest.mark.parametrize("direction", DIRECTIONS)
def test_paths_over_the_poles_equal_a_walk_pixel_by_pixel(direction: tuple[int, int]) -> None:
    rng = np.random.default_rng(9)
    (height, width), depth, p1, warm = (8, 20), 5, 9, 3
    volume = rng.integers(0, 200, (height, depth, width)).astype(np.uint8)
    penalties = rng.integers(20, 90, (height, width)).astype(np.uint16)
    total = np.zeros(volume.shape, np.uint16)
    for first, lines in ((0, 7), (7, 13)):
        sweep_strip(volume, total, penalties, np.uint16(p1), first, lines, direction[1], direction[0] < 0, warm)
    for line in range(width):
        path = oracle.path_pixels((height, width), direction, line, warm=(warm, 0))
        costs = oracle.path_costs(volume, penalties, path, p1)
        for (row, column), cost in list(zip(path, costs, strict=True))[warm:]:
            assert total[row, :, column].tolist() == cost.tolist()


@pytest.mark.kernel("sweep.numba.kernels_sgm")
def test_paths_along_a_row_equal_a_walk_pixel_by_pixel() -> None:
    rng = np.random.default_rng(10)
    (height, width), depth, p1, warm = (3, 20), 5, 9, 10
    volume = rng.integers(0, 200, (height, depth, width)).astype(np.uint8)
    penalties = rng.integers(20, 90, (2, height, width)).astype(np.uint16)
    total, expected = np.zeros(volume.shape, np.uint16), np.zeros(volume.shape, np.int64)
    for row in range(height):
        sweep_row(volume, total, penalties, np.uint16(p1), row, warm)
        for idx, step in enumerate((1, -1)):
            path = oracle.path_pixels((height, width), (0, step), row, warm=(0, warm))
            costs = oracle.path_costs(volume, penalties[idx], path, p1)
            for (_, column), cost in list(zip(path, costs, strict=True))[warm:]:
                expected[row, :, column] += cost
    np.testing.assert_array_equal(total, expected)


def test_one_step_of_many_paths_equals_each_alone() -> None:
    rng = np.random.default_rng(11)
    costs, before = rng.integers(0, 200, (2, 5, 30))
    penalty = rng.integers(20, 90, 30)
    together = path_step(costs, before, penalty, 9)
    for k in range(30):
        p2, floor = int(penalty[k]), int(before[:, k].min())
        for d in range(5):
            around = [before[e, k] + 9 for e in (d - 1, d + 1) if 0 <= e < 5]
            assert together[d, k] == costs[d, k] + min([before[d, k], floor + p2, *around]) - floor


@pytest.mark.kernel("sweep.numba.kernels_sgm", "sweep.numba.x86.kernels_vector_path")
@pytest.mark.skipif(not HAS_VECTOR, reason="there is nothing but loops")
@pytest.mark.parametrize(("drift", "upward"), [(0, False), (1, False), (-1, True)])
@pytest.mark.parametrize(("lines", "first"), [(100, 0), (40, 70), (5, 99), (33, 1)])
def test_paths_by_vector_instructions_equal_those_by_loops(
    drift: int, upward: bool, lines: int, first: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(lines)
    (height, width), depth = (9, 100), 7
    volume = rng.integers(1, 256, (height, depth, width), dtype=np.uint8)
    penalties = rng.integers(20, 90, (height, width)).astype(np.uint16)
    totals = []
    for vector in (True, False):
        monkeypatch.setattr(kernels_sgm, "HAS_VECTOR", vector)
        strip = kernels_sgm.sweep_strip if vector else njit(sweep_strip.py_func, error_model="numpy")
        totals.append(np.full(volume.shape, 3, np.uint16))
        strip(volume, totals[-1], penalties, np.uint16(11), first, lines, drift, upward, 3)
    assert totals[0].tobytes() == totals[1].tobytes()
    assert (totals[0] == 3).sum() == (width - lines) * depth * height
