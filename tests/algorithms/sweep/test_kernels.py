"""Each compiled part of the sweep equals its slow and obvious form."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import pytest
from numba import njit

from pano_mvs.algorithms.sweep.backends import numba_backend
from pano_mvs.algorithms.sweep.backends.numba_backend import winners_by_paths
from pano_mvs.algorithms.sweep.backends.numpy_backend import _aggregate, path_step, winners_of
from pano_mvs.algorithms.sweep.numba import kernels_sgm, kernels_sgm_rows
from pano_mvs.algorithms.sweep.numba.kernels_band import combine_row
from pano_mvs.algorithms.sweep.numba.kernels_cost import (
    average_differences,
    box_rows,
    census_row,
    difference_row,
    one_box_serves,
    store_row,
)
from pano_mvs.algorithms.sweep.numba.kernels_records import Combination
from pano_mvs.algorithms.sweep.numba.kernels_sgm import (
    DRIFTS,
    Front,
    PathCosts,
    Sums,
    follow_block,
    look_up_penalties,
    state_columns,
)
from pano_mvs.algorithms.sweep.numba.kernels_sgm_rows import follow_rows
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
from pano_mvs.algorithms.sweep.penalties import DIRECTIONS, padded_channels, penalty_table, step_penalties
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.settings import SweepSettings
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


@pytest.mark.kernel("sweep.numba.kernels_cost")
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


@pytest.mark.kernel("sweep.numba.kernels_cost")
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


@pytest.mark.kernel("sweep.numba.kernels_band")
@pytest.mark.parametrize("sources", [1, 2, 3, 5, 8, 9])
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


@pytest.mark.kernel("sweep.numba.kernels_cost")
def test_costs_are_stored_rounded_and_saturated() -> None:
    voxels = np.zeros(5, np.uint8)
    store_row(np.array([0.0, 1.24, 1.26, 100.0, 1e6], np.float32), np.float32(2.0), voxels)
    assert voxels.tolist() == [0, 2, 3, 200, 255]


def _follow(
    costs: kernels_sgm.PathCosts, strips: list[int], blocks: list[int], warm: int, follow: Any = follow_block
) -> np.ndarray:
    """Return the sum of the three paths to each pixel, and 3, strip by strip and block by block."""
    height, depth, width = costs.volume.shape
    fronts = [Front(np.zeros((3, depth, width), np.uint16), np.zeros((3, width), np.uint16)) for _ in range(2)]
    before, after = np.full((2, height, depth, width + 2), 3, np.uint16)
    state = np.full((3, depth + 1, state_columns(max(strips), max(blocks))), 77, np.uint16)
    step = -warm
    for count in blocks:
        first = 0
        for lines in strips:
            follow(costs, fronts[0], fronts[1], (step, count), (first, lines), Sums(before, 0, after, 0), state)
            first += lines
        fronts.reverse()
        step += count
    assert (first, step) == (width, height)
    assert (after[:, :, width:] == 3).all()
    total: np.ndarray = after[:, :, :width]
    return total


@pytest.mark.kernel("sweep.numba.kernels_sgm")
@pytest.mark.parametrize("upward", [False, True])
@pytest.mark.parametrize(("strips", "blocks"), [([20], [3, 8]), ([7, 13], [2, 1, 5, 3]), ([1, 18, 1], [3, 6, 2])])
def test_paths_over_the_poles_equal_a_walk_pixel_by_pixel(upward: bool, strips: list[int], blocks: list[int]) -> None:
    rng = np.random.default_rng(9)
    (height, width), depth, p1, warm = (8, 20), 5, 9, 3
    volume = rng.integers(0, 200, (height, depth, width)).astype(np.uint8)
    penalties = rng.integers(20, 90, (3, height, width)).astype(np.uint16)
    total = _follow(PathCosts(volume, penalties, np.uint16(p1), upward), strips, blocks, warm)
    expected = np.full(volume.shape, 3, np.int64)
    for way, drift in enumerate(DRIFTS):
        for line in range(width):
            path = oracle.path_pixels((height, width), (-1 if upward else 1, drift), line, warm=(warm, 0))
            costs = oracle.path_costs(volume, penalties[way], path, p1)
            for (row, column), cost in list(zip(path, costs, strict=True))[warm:]:
                expected[row, :, column] += cost
    np.testing.assert_array_equal(total, expected)


@pytest.mark.kernel("sweep.numba.kernels_sgm_rows")
@pytest.mark.parametrize("largest", [90, 4000])  # with dear steps, a path remembers for more than once around
def test_paths_along_a_row_equal_a_walk_pixel_by_pixel(largest: int) -> None:
    rng = np.random.default_rng(10)
    (height, width), depth, p1 = (3, 20), 5, 9
    volume = rng.integers(0, 200, (height, depth, width)).astype(np.uint8)
    penalties = rng.integers(20, largest, (2, height, width)).astype(np.uint16)
    sums, expected = np.full((2, depth, width + 3), 7, np.uint16), np.zeros((2, depth, width), np.int64)
    follow_rows(volume, penalties, np.uint16(p1), (1, 2), sums, 1)
    for row in (1, 2):
        for idx, step in enumerate((1, -1)):
            path = oracle.path_pixels((height, width), (0, step), row, warm=(0, width))
            costs = oracle.path_costs(volume, penalties[idx], path, p1)
            for (_, column), cost in list(zip(path, costs, strict=True))[width:]:
                expected[row - 1, :, column] += cost
    np.testing.assert_array_equal(sums[:, :, :width], expected)
    assert (sums[:, :, width:] == 7).all()


@pytest.mark.kernel("sweep.numba.kernels_sgm")
@pytest.mark.parametrize(("contrast", "falloff"), [(15.0, "inverse"), (15.0, "square"), (0.0, "square")])
def test_penalties_are_looked_up_as_they_are_defined(contrast: float, falloff: Literal["inverse", "square"]) -> None:
    picture = np.random.default_rng(12).integers(0, 256, (*SIZE, 3), dtype=np.uint8)
    settings = SweepSettings(p1=300, p2=3000, p2_contrast=contrast, p2_falloff=falloff)
    found = np.empty((len(DIRECTIONS), 9, SIZE[1]), np.uint16)
    table = penalty_table(settings, SIZE[0])
    look_up_penalties(padded_channels(picture), table, np.array(DIRECTIONS), 4, found)
    for direction, penalties in zip(DIRECTIONS, found, strict=True):
        np.testing.assert_array_equal(penalties, step_penalties(picture, direction, settings, rows=slice(4, 13)))
    colors = pad_panorama(picture.astype(np.float64), 1)
    step = np.abs(colors[1:-1, 1:-1] - colors[:-2, 2:]).max(axis=-1)
    power = 1 if falloff == "inverse" else 2
    expected = np.maximum(9, 94 / (1 + (step / contrast) ** power)) if contrast else 94.0
    found = step_penalties(picture, (1, -1), settings)
    np.testing.assert_allclose(found, np.broadcast_to(expected, SIZE), atol=0.5 + 1e-9)


def test_one_step_of_many_paths_equals_each_alone() -> None:
    rng = np.random.default_rng(11)
    costs, before = rng.integers(0, 200, (2, 5, 30))
    penalty = rng.integers(20, 90, 30)
    together = path_step(costs, before, penalty, p1=9)
    for k in range(30):
        p2, floor = int(penalty[k]), int(before[:, k].min())
        for d in range(5):
            around = [before[e, k] + 9 for e in (d - 1, d + 1) if 0 <= e < 5]
            assert together[d, k] == costs[d, k] + min([before[d, k], floor + p2, *around]) - floor


def _by_loops(monkeypatch: pytest.MonkeyPatch, module: Any, *names: str) -> Any:
    """Return the last of some kernels, compiled again without vector instructions; each calls those before it."""
    monkeypatch.setattr(module, "HAS_VECTOR", False)
    for name in names:
        monkeypatch.setattr(module, name, njit(getattr(module, name).py_func, error_model="numpy"))
    return getattr(module, names[-1])


@pytest.mark.kernel("sweep.numba.kernels_sgm", "sweep.numba.x86.kernels_vector_path")
@pytest.mark.slow
@pytest.mark.skipif(not HAS_VECTOR, reason="there is nothing but loops")
def test_paths_by_vector_instructions_equal_those_by_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(13)
    (height, width), depth = (9, 100), 7
    volume = rng.integers(1, 256, (height, depth, width), dtype=np.uint8)
    penalties = rng.integers(20, 90, (3, height, width)).astype(np.uint16)
    loops = _by_loops(monkeypatch, kernels_sgm, "_step_row", "follow_block")
    for upward in (False, True):
        costs = PathCosts(volume, penalties, np.uint16(11), upward)
        expected = _follow(costs, [100], [3, 9], 3, loops)
        for strips, blocks in (([100], [3, 9]), ([64, 36], [1, 2, 5, 4]), ([5, 33, 1, 61], [3, 2, 7])):
            assert _follow(costs, strips, blocks, 3).tobytes() == expected.tobytes()


@pytest.mark.kernel("sweep.numba.kernels_sgm_rows", "sweep.numba.x86.kernels_vector_path")
@pytest.mark.slow
@pytest.mark.skipif(not HAS_VECTOR, reason="there is nothing but loops")
def test_paths_along_rows_by_vector_instructions_equal_those_by_loops(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(15)
    names = ("_turn_row", "_turn_sums", "step_pixel", "_close_circle", "follow_rows")
    loops = _by_loops(monkeypatch, kernels_sgm_rows, *names)
    for depth, width in ((64, 96), (37, 50), (7, 90), (40, 9)):
        volume = rng.integers(0, 256, (4, depth, width), dtype=np.uint8)
        penalties = rng.integers(100, 3000, (2, 4, width)).astype(np.uint16)
        results = np.zeros((2, 3, depth, width + 32), np.uint16)
        for follow, sums in zip((follow_rows, loops), results, strict=True):
            follow(volume, penalties, np.uint16(90), (1, 3), sums, 1)
        assert results[0].tobytes() == results[1].tobytes()


@pytest.mark.parametrize(("size", "top", "count"), [((24, 48), 0, 24), ((40, 100), 0, 40), ((64, 128), 20, 30)])
def test_all_paths_equal_the_readable_ones(
    size: tuple[int, int], top: int, count: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(14)
    settings = SweepSettings(planes=33, p1=200, p2=4000)
    picture = rng.integers(0, 256, (*size, 3), dtype=np.uint8)
    work = SweepInput(picture, (), (), None, np.linspace(1, 2, 33), settings)
    volume = rng.integers(0, 256, (count, 33, size[1]), dtype=np.uint8)
    found = winners_by_paths(work, volume, top=top)
    monkeypatch.setattr(numba_backend, "_BLOCK_ROWS", 5)
    monkeypatch.setattr(numba_backend, "_STRIP_COLUMNS", 31)
    again = winners_by_paths(work, volume, top=top)
    for name in ("plane", "cost", "before", "after", "rival"):
        np.testing.assert_array_equal(getattr(found, name), getattr(again, name))
    if count == size[0]:
        expected = winners_of(_aggregate(volume.astype(np.int64), work).astype(np.float64))
        np.testing.assert_array_equal(found.plane, expected.plane)
        np.testing.assert_array_equal(found.cost, expected.cost)
        np.testing.assert_array_equal(found.rival, expected.rival)
