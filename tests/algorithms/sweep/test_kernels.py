"""Each compiled part of the sweep equals its slow and obvious form."""

from __future__ import annotations

from typing import Any, Literal

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.backends import numba_backend
from pano_mvs.algorithms.sweep.backends.numba_backend import winners_by_paths
from pano_mvs.algorithms.sweep.backends.numpy_backend import _aggregate, path_step, winners_of
from pano_mvs.algorithms.sweep.numba import kernels_sgm, kernels_sgm_rows
from pano_mvs.algorithms.sweep.numba.arguments import pack_colors, pack_plane, pack_sources, pack_votes
from pano_mvs.algorithms.sweep.numba.kernels_band import combine_row
from pano_mvs.algorithms.sweep.numba.kernels_cost import (
    add_differences,
    average_differences,
    box_rows,
    census_row,
    count_census_row,
    difference_row,
    interleave_rows,
    one_box_serves,
    store_row,
)
from pano_mvs.algorithms.sweep.numba.kernels_lookup import knot_rows, vote_row, warp_band
from pano_mvs.algorithms.sweep.numba.kernels_records import Combination, Lookup, Sources
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
from pano_mvs.algorithms.sweep.numba.x86.kernels_vector import HAS_VECTOR, _lanes_of_this_machine
from pano_mvs.algorithms.sweep.penalties import DIRECTIONS, padded_channels, penalty_table, step_penalties
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.windows import column_offsets
from pano_mvs.geometry import Rigid3, pad_panorama, pixel_from_ray, ray_grid, rotation_from_rotvec, sample_panorama
from tests.oracles import sweep as oracle

SIZE = 16, 32


def _picture(seed: int, shape: tuple[int, ...] = SIZE) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, shape, dtype=np.uint8)


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
    """Return the last of some kernels as plain Python without vector instructions; each calls those before it."""
    monkeypatch.setattr(module, "HAS_VECTOR", False)
    for name in names:
        monkeypatch.setattr(module, name, getattr(module, name).py_func)
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


ROTATION = rotation_from_rotvec((0.4, -1.9, 0.7))
needs_vector = pytest.mark.skipif(not HAS_VECTOR, reason="no vector instructions, or numba compiles nothing")
TRANSLATIONS = [(0.0, 0.0, 0.0), (0.3, -0.2, 0.5), (0.0, 0.9, 0.0), (0.0, 0.0, -0.99)]


def _warped(
    source: NDArray[np.uint8],
    translation: tuple[float, float, float],
    size_hw: tuple[int, int],
    *,
    vector: bool,
    halo: int = 3,
    pad: int = 4,
    first: int = 0,
    rows: int | None = None,
    against: NDArray[Any] | None = None,
) -> NDArray[Any]:
    height, width = size_hw
    rows = rows or height
    azimuth = 2 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    sin_cos = np.stack([np.sin(azimuth), np.cos(azimuth)]).astype(np.float32)
    packed, colors, starts = pack_sources([source], vector=vector)
    warped = np.zeros((source.shape[2], rows + 2 * halo, width + 2 * pad), np.uint8)
    votes = np.zeros((rows + 2 * halo, width), np.uint8)
    knots = np.zeros((2, knot_rows(rows + 2 * halo), width), np.float32)
    valid = np.ones((source.shape[0] + 1) * (source.shape[1] + 2), np.uint8)
    against = np.zeros((0, width), np.uint32) if against is None else against
    pixel_costs = np.zeros((rows + 2 * halo, width + 2 * pad), np.uint16)
    shapes, poses = np.array([source.shape[:2]]), np.column_stack([ROTATION, translation])[None]
    masked = np.array([[0, valid.size]])  # none is, but all are asked
    sources = Sources(poses, packed, colors, starts, shapes, valid, np.zeros(1, np.int64), masked, vector)
    found = Lookup(knots, warped, votes, against, pixel_costs)
    warp_band(first - halo, height, sin_cos, sources, 0, True, 1.3, pad, found)
    assert votes.all()
    return pixel_costs if len(against) else warped


@pytest.mark.kernel("sweep.numba.kernels_lookup")
@pytest.mark.parametrize("source_hw", [(16, 32), (24, 48), (16, 64)])
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("translation", TRANSLATIONS)
@pytest.mark.parametrize("vector", [False, pytest.param(True, marks=needs_vector)])
def test_a_warped_band_equals_exact_sampling_even_beyond_the_poles(
    source_hw: tuple[int, int], channels: int, translation: tuple[float, float, float], vector: bool
) -> None:
    source = _picture(1, (*source_hw, channels))
    warped = _warped(source, translation, SIZE, vector=vector)
    exact = sample_panorama(source, pixel_from_ray(ray_grid(SIZE) * 1.3 @ ROTATION.T + translation, source_hw))
    for color in range(channels):
        expected = np.pad(pad_panorama(exact[..., color], 3)[:, 3:-3], ((0, 0), (4, 4)), mode="wrap")
        # Half a level is rounding; the rest is what 1e-4 px of float32 projection makes of white noise.
        assert np.abs(warped[color] - expected).max() < 0.6


@pytest.mark.kernel("sweep.numba.kernels_lookup")
def test_rows_vote_as_their_patches_do_wherever_the_mask_is() -> None:
    """Rows that are looked up above or below the masked rows are not looked up one by one."""
    masks = [np.ones(SIZE, np.bool_) for _ in range(3)]
    masks[1][9:11, 4:20] = False
    masks[2][0, 0] = masks[2][15, 31] = False
    valid, starts, masked = pack_votes(_masked_input(tuple(masks)))
    stride = SIZE[1] + 2
    patches = [(valid[start : start + 17 * stride] == 0).reshape(17, stride) for start in starts]
    assert masked[0, 0] == masked[0, 1] == 0
    assert not patches[0].any()
    assert np.argwhere(patches[1])[[0, -1]].tolist() == [[9, 4], [11, 20]]
    for source in range(3):
        for row in range(17):
            index = np.arange(row * stride, row * stride + SIZE[1] + 1, dtype=np.int32)
            votes = np.full((2, len(index)), 7, np.uint8)
            vote_row(valid, starts[source], *masked[source], index, votes, 1)
            expected = 7 if source == 0 else ~patches[source][row, :-1]
            np.testing.assert_array_equal(votes[1], np.broadcast_to(expected, len(index)))
            assert (votes[0] == 7).all()


def _masked_input(masks: tuple[NDArray[np.bool_], ...]) -> SweepInput:
    grey, settings = _picture(1, (*SIZE, 1)), SweepSettings()
    poses = tuple(Rigid3(ROTATION, np.ones(3)) for _ in masks)
    return SweepInput(grey, (grey,) * len(masks), poses, masks, np.array([1.0, 2.0, 3.0]), settings)


@pytest.mark.parametrize("translation", TRANSLATIONS)
def test_interpolated_positions_miss_by_little(translation: tuple[float, float, float]) -> None:
    height, width = 256, 16  # positions are interpolated along columns
    ramp = (np.arange(height)[:, None] % 32 * 4 + np.abs(np.arange(512) % 64 - 32) * 3).astype(np.uint8)[..., None]
    warped = _warped(ramp, translation, (height, width), vector=HAS_VECTOR)
    pixels = pixel_from_ray(ray_grid((height, width)) * 1.3 @ ROTATION.T + translation, ramp.shape[:2])
    difference = np.abs(warped[0, 3:-3, 4:-4] - sample_panorama(ramp, pixels)[..., 0])
    assert np.mean(difference < 0.75) > 0.99
    assert difference.max() < 124 * 0.08 + 0.5  # 0.08 px over the steepest step


@pytest.mark.parametrize(
    ("features", "lanes"), [("", 0), ("+sse2", 0), ("+ssse3,-avx2", 1), ("+avx2, +ssse3", 2), ("+avx512bw,+avx2", 4)]
)
def test_instructions_that_numba_must_not_use_are_left_unused(
    features: str, lanes: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """NUMBA_CPU_NAME=generic once ended the process: the instructions of the processor could not be compiled."""
    monkeypatch.setattr(numba.config, "CPU_FEATURES", features)
    assert _lanes_of_this_machine() == lanes


def test_without_avx_the_widest_registers_have_one_lane(monkeypatch: pytest.MonkeyPatch) -> None:
    """NUMBA_ENABLE_AVX=0 ended the process, too."""
    monkeypatch.setattr(numba.config, "CPU_FEATURES", None)
    monkeypatch.setattr(numba.config, "ENABLE_AVX", 0)
    assert _lanes_of_this_machine() <= 1


@needs_vector
@pytest.mark.kernel("sweep.numba.kernels_lookup", "sweep.numba.x86.kernels_vector")
@pytest.mark.parametrize("channels", [1, 3])
def test_vector_instructions_give_what_loops_give(channels: int) -> None:
    source = _picture(2, (64, 128, channels))
    loops = _warped(source, TRANSLATIONS[1], (48, 100), vector=False, first=5, rows=8)
    instructions = _warped(source, TRANSLATIONS[1], (48, 100), vector=True, first=5, rows=8)
    assert loops.tobytes() == instructions.tobytes()
    assert loops.std() > 30


@needs_vector
@pytest.mark.kernel("sweep.numba.kernels_lookup", "sweep.numba.x86.kernels_vector")
def test_differences_added_while_sampling_are_those_of_what_is_sampled() -> None:
    reference, source = _picture(4, (3, 56, 72)), _picture(5, (64, 128, 3))
    warped = _warped(source, TRANSLATIONS[1], (48, 64), vector=True, first=5, rows=8)
    expected = np.zeros(warped.shape[1:], np.uint16)
    add_differences(reference, 20, warped, 4, expected)
    added = _warped(
        source, TRANSLATIONS[1], (48, 64), vector=True, first=5, rows=8, against=interleave_rows(reference, 20, 14, 4)
    )
    assert added[:, 4:-4].tolist() == expected[:, 4:-4].tolist()
    whole = np.abs(reference[:, 20:34, 4:-4].astype(int) - warped[..., 4:-4]).sum(axis=0)
    assert added[:, 4:-4].tolist() == whole.tolist()


def test_packed_patches_hold_the_four_neighbours_over_seam_and_poles() -> None:
    source = _picture(2, (*SIZE, 3))
    packed, colors = pack_plane(source[..., 1]), pack_colors(source)
    assert packed.shape == colors.shape == (SIZE[0] + 1, SIZE[1] + 2)
    for row, column in [(0, 0), (0, 32), (16, 0), (16, 32), (7, 32), (5, 9)]:
        corners = [oracle.pixel_at(source[..., 1], row - 1 + j, column - 1 + i) for i in (0, 1) for j in (0, 1)]
        assert list(packed[row, column : column + 1].view(np.uint8) ^ 128) == corners
        both = colors[row, column : column + 2].view(np.uint8).reshape(2, 4, 2) ^ 128
        assert both[:, 1].ravel().tolist() == corners


@pytest.mark.kernel("sweep.numba.kernels_cost")
@pytest.mark.parametrize("side", [3, 7, 15])
@pytest.mark.parametrize("width", [20, 64, 100])
def test_census_by_vector_instructions_counts_what_loops_count(side: int, width: int) -> None:
    pad = 40
    reference, warped = _picture(3, (side + 2, width + 2 * pad)) // 16, _picture(4, (side, width + 2 * pad)) // 16
    offsets = np.rint(np.linspace(-30, 30, side)).astype(np.int64)
    expected, counted = np.zeros(width, np.uint8), np.zeros(width, np.uint8)
    census_row(reference, side // 2 + 2, warped, side // 2, offsets, pad, expected)
    count_census_row(reference, side // 2 + 2, warped, side // 2, offsets, pad, counted)
    assert counted.tolist() == expected.tolist()
    assert len(set(expected)) > 3
