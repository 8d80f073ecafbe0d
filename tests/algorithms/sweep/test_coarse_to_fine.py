"""Laws of the sweep from coarse to fine: what it shares with the plain one, and what it must not lose."""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.coarse_to_fine import GuidedSweep
from pano_mvs.algorithms.sweep.hypotheses import mean_baseline_of, virtual_ranges
from pano_mvs.algorithms.sweep.numba.arguments import (
    fresh_state,
    run_arguments,
    runs_of,
    spread_tiles,
    sweep_arguments,
    tile_means,
)
from pano_mvs.algorithms.sweep.numba.kernels_band import sweep_band
from pano_mvs.algorithms.sweep.numba.kernels_guided import (
    adopt_candidates,
    follow_guided_rows,
    follow_guided_strip,
    split_layers,
)
from pano_mvs.algorithms.sweep.numba.slanted import STEPS
from pano_mvs.algorithms.sweep.preparation import SweepInput, prepare_picture
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3, pad_panorama, roll_panorama
from pano_mvs.scene import RangeMap
from pano_mvs.testing.room import Room, capture_poses, default_room, render
from tests.oracles.sweep import follow
from tests.synthetic.scenes import poles

NEAR, FAR = 0.5, 6.0
PLAIN = SweepSettings(planes=48, no_match="keep")


@functools.cache
def _capture(height: int) -> tuple[list[NDArray[np.uint8]], list[Rigid3], NDArray[np.float32]]:
    """Return pictures, source_from_reference and the true range of view 0 of a room."""
    views_at = capture_poses(3, seed=5)
    views = [render(default_room(1), pose, (height, 2 * height)) for pose in views_at]
    return [view[0] for view in views], [pose @ views_at[0].inverse() for pose in views_at[1:]], views[0][1]


def _sweep(
    pictures: Sequence[NDArray[np.uint8]], poses: Sequence[Rigid3], settings: SweepSettings, **options: Any
) -> RangeMap:
    return sweep_range(pictures[0], pictures[1:], poses, near=NEAR, far=FAR, settings=settings, **options)


def _work(height: int, settings: SweepSettings) -> SweepInput:
    pictures, poses, _ = _capture(height)
    baseline = mean_baseline_of(poses)
    ranges = virtual_ranges(NEAR, FAR, planes=settings.planes, spacing=settings.spacing, baseline=baseline)
    prepared = [prepare_picture(picture, settings) for picture in pictures]
    return SweepInput(prepared[0], tuple(prepared[1:]), tuple(poses), None, ranges, settings)


def _good(result: NDArray[np.float32], truth: NDArray[np.float32]) -> NDArray[np.bool_]:
    found: NDArray[np.bool_] = np.abs(result - truth) < 0.05 * truth
    return found


@pytest.mark.parametrize("changes", [{}, {"cost": "sad", "spacing": "log"}, {"combination": "parallax_weighted"}])
def test_around_a_flat_guide_costs_are_those_of_the_plain_sweep(changes: dict[str, Any]) -> None:
    _compare_with_the_plain_sweep(64, SweepSettings(planes=20, exposure=False, **changes))


@pytest.mark.kernel("sweep.numba.kernels_guided", "sweep.numba.kernels_band")
def test_around_a_flat_guide_costs_of_a_tiny_picture_are_those_of_the_plain_sweep() -> None:
    """Small enough to run as plain Python too."""
    _compare_with_the_plain_sweep(16, SweepSettings(planes=14, window=3, exposure=False))


def _compare_with_the_plain_sweep(height: int, settings: SweepSettings) -> None:
    work, bands = _work(height, settings), range(0, height, 32)
    plain = np.empty((height, settings.planes, 2 * height), np.uint8)
    shared = sweep_arguments(work)
    for first in bands:
        rows = min(32, height - first)
        sweep_band(
            first, shared, shared.others, work.ranges, plain[first : first + rows], *fresh_state(rows, 2 * height)
        )
    with ThreadPoolExecutor(1) as pool:
        sweep = GuidedSweep(work, np.full((2, height, 2 * height), 9.0, np.float32), pool)
        sweep._sweep(0, np.ones((height, 2 * height), np.bool_))
    around = plain[:, 9 - STEPS : 10 + STEPS].astype(int)
    # Projections differ by rounding, and bilinear samples with them by a level now and then.
    assert (np.abs(sweep.volume[:, : 2 * STEPS + 1] - around) <= 4).mean() > 0.99


def test_parts_of_a_band_cost_the_same_as_the_whole() -> None:
    rng = np.random.default_rng(3)
    work = _work(96, SweepSettings(planes=20))
    guides = np.repeat(9 + np.cumsum(rng.normal(0, 0.1, (1, 96, 192)), axis=2).astype(np.float32), 2, axis=0)
    some = np.zeros((96, 192), np.bool_)
    some[10, 130] = some[50, 5] = some[95, 100] = True
    with ThreadPoolExecutor(2) as pool:
        whole, parts = GuidedSweep(work, guides, pool), GuidedSweep(work, guides, pool)
        parts.volume[:] = 0
        whole._sweep(0, np.ones_like(some))
        parts._sweep(0, some)
    swept = spread_tiles(tile_means(some) > 0, some.shape)
    assert 0.1 < swept.mean() < 0.7
    count = 2 * STEPS + 1
    assert np.array_equal(*(np.moveaxis(each.volume[:, :count], 1, -1)[swept] for each in (whole, parts)))
    assert not np.moveaxis(parts.volume[:, :count], 1, -1)[~swept].any()


def test_runs_cover_the_tiles_that_are_set_and_no_others() -> None:
    rng = np.random.default_rng(1)
    size_hw = (80, 400)
    tiles = rng.random((3, 7)) < 0.4
    tiles[1] = True
    shared = sweep_arguments(_work(64, SweepSettings(planes=20)))
    covered = np.zeros(size_hw, int)
    for run in runs_of(tiles, size_hw, shared.windows):
        covered[run.place] += 1
        assert (run.margin == 0) == (run.columns == 400)
    assert np.array_equal(covered, spread_tiles(tiles, size_hw).astype(int))
    run = runs_of(np.array([[True, False, False]]), (32, 128), shared.windows)[0]
    assert run_arguments(shared, run).reference.flags.c_contiguous


@pytest.mark.kernel("sweep.numba.kernels_guided")
@pytest.mark.parametrize("upward", [False, True])
@pytest.mark.parametrize("drift", [0, 1, -1])
def test_paths_among_candidates_follow_the_definition(drift: int, upward: bool) -> None:
    rng = np.random.default_rng(7)
    height, width, count = 10, 12, 3
    volume = rng.integers(0, 200, (height, 2 * count, width)).astype(np.uint8)
    guides = rng.integers(0, 60, (height, 2, width)).astype(np.int16)
    penalties = rng.integers(60, 300, (height, width)).astype(np.uint16)
    total = np.zeros(volume.shape, np.uint16)
    for first in (0, 5):  # two strips, one of which crosses the seam
        lines = 5 if first == 0 else 7
        follow_guided_strip(volume, total, guides, penalties, np.uint16(40), first, lines, drift, upward, 0, True)
    expected = np.zeros(volume.shape)
    for column in range(width):
        rows = np.arange(height)[:: -1 if upward else 1]
        columns = (column + drift * np.arange(height)) % width
        costs = volume[rows, :, columns].reshape(height, 2, count)
        path = follow(costs, guides[rows, :, columns], penalties[rows, columns], 40, 16)
        expected[rows, :, columns] = path.reshape(height, -1)
    assert np.array_equal(total, expected)


@pytest.mark.kernel("sweep.numba.kernels_guided")
def test_paths_along_rows_go_around_the_sphere() -> None:
    rng = np.random.default_rng(8)
    height, width, count = 3, 20, 3
    volume = rng.integers(0, 200, (height, 2 * count, width)).astype(np.uint8)
    guides = rng.integers(0, 60, (height, 2, width)).astype(np.int16)
    penalties = rng.integers(60, 300, (2, height, width)).astype(np.uint16)
    total = np.zeros(volume.shape, np.uint16)
    follow_guided_rows(volume, total, guides, penalties, np.uint16(40), 0, height, width)
    expected = np.zeros(volume.shape)
    for row in range(height):
        for way, step in enumerate((1, -1)):
            columns = np.tile(np.arange(width)[::step], 2)
            costs = volume[row][:, columns].T.reshape(-1, 2, count)
            path = follow(costs, guides[row][:, columns].T, penalties[way, row, columns], 40, 16)
            expected[row][:, columns[width:]] += path[width:].reshape(width, -1).T
    assert np.array_equal(total, expected)


@pytest.mark.kernel("sweep.numba.kernels_guided")
def test_two_surfaces_are_told_apart_and_one_is_not_split() -> None:
    positions = np.full((12, 16), 10.0, np.float32)
    positions[:, 8:] = 30.0
    layers = np.empty((2, 12, 16), np.float32)
    split_layers(pad_panorama(positions, 2), 2, np.float32(6), layers)
    # The seam is an edge too, and the poles see the other half.
    assert np.all(layers[0, 3:-3, 2:10] == 10)
    assert np.all(layers[1, 3:-3, 6:14] == 30)
    assert np.all(layers[:, 3:-3, 4:6] == 10)
    split_layers(pad_panorama(positions, 2), 2, np.float32(25), layers)
    assert np.array_equal(layers[0], layers[1])


@pytest.mark.kernel("sweep.numba.kernels_guided")
def test_candidates_are_adopted_with_those_that_agree() -> None:
    found, costs = np.full((9, 9), 50.0, np.float32), np.full((9, 9), np.inf, np.float32)
    found[4, 4:6], costs[4, 4:6] = (10, 12), (1, 2)
    found[4, 3], costs[4, 3] = 40, 5
    layer = np.full((5, 5), np.nan, np.float32)
    adopt_candidates(found, costs, 2, np.float32(3), layer)
    assert layer[2, 2] == 11  # in the padded picture (4, 4)
    assert np.isfinite(layer).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", [PLAIN, PLAIN.replace(aggregation="box"), PLAIN.replace(cost="sad", aggregation="box")]
)
def test_it_finds_what_the_plain_sweep_finds(settings: SweepSettings) -> None:
    pictures, poses, truth = _capture(160)
    plain, guided = (_sweep(pictures, poses, settings.replace(levels=levels)) for levels in (1, 2))
    guided.check()
    assert _good(guided.range, truth).mean() > _good(plain.range, truth).mean() - 0.01


@pytest.mark.slow
def test_three_levels_are_not_much_worse_than_two() -> None:
    pictures, poses, truth = _capture(192)
    two, three = (_sweep(pictures, poses, PLAIN.replace(levels=levels)) for levels in (2, 3))
    assert _good(three.range, truth).mean() > _good(two.range, truth).mean() - 0.03


def test_it_turns_with_the_pictures() -> None:
    """By whole tiles exactly; by even numbers of pixels nearly; else the half resolution sees other pixels."""
    pictures, poses, _ = _capture(160)
    settings = PLAIN.replace(levels=2)
    found = _sweep(pictures, poses, settings).range
    for columns, median, share in ((64, 1e-5, 0.999), (38, 1e-4, 0.95), (37, 2e-3, 0.85)):
        turned = _rolled_reference(pictures, poses, settings, columns)
        difference = np.abs(turned / np.roll(found, columns, axis=1) - 1)
        assert np.median(difference) <= median
        assert (difference < 1e-2).mean() > share


def _rolled_reference(
    pictures: Sequence[NDArray[np.uint8]], poses: Sequence[Rigid3], settings: SweepSettings, columns: int
) -> NDArray[np.float32]:
    rolled, rotation = roll_panorama(pictures[0], columns)
    turn = Rigid3(rotation, np.zeros(3))
    return _sweep([rolled, *pictures[1:]], [pose @ turn.inverse() for pose in poses], settings).range


def test_masks_hold_and_sizes_that_cannot_be_halved_are_swept_plainly() -> None:
    pictures, poses, _ = _capture(160)
    mask = np.ones((160, 320), np.bool_)
    mask[-40:] = False
    settings = PLAIN.replace(levels=2)
    found = _sweep(pictures, poses, settings, reference_mask=mask, source_masks=[mask, mask])
    assert np.isnan(found.range[~mask]).all()
    assert np.isfinite(found.range[40:100]).all()
    odd = [picture[:, :318] for picture in pictures]
    assert np.array_equal(
        _sweep(odd, poses, settings).range, _sweep(odd, poses, settings.replace(levels=1)).range, equal_nan=True
    )


def test_the_number_of_threads_changes_no_bit() -> None:
    pictures, poses, _ = _capture(160)
    threads = numba.get_num_threads()
    results = []
    for count in (1, max(2, threads) if threads > 1 else 1):
        numba.set_num_threads(count)
        results.append(_sweep(pictures, poses, PLAIN.replace(levels=2)))
    numba.set_num_threads(threads)
    assert np.array_equal(results[0].range, results[1].range, equal_nan=True)
    assert np.array_equal(results[0].confidence, results[1].confidence)


def test_only_the_compiled_backend_has_levels() -> None:
    pictures, poses, _ = _capture(64)
    with pytest.raises(UsageError, match="needs the sweep backend numba, got 'numpy'"):
        _sweep(pictures, poses, PLAIN.replace(levels=2), backend="numpy")
    with pytest.raises(UsageError, match="levels must be"):
        SweepSettings(levels=0)


@pytest.mark.slow
def test_thin_rods_are_seen_where_the_plain_sweep_sees_them() -> None:
    scene, size_hw = poles(seed=2), (160, 320)
    views = [scene.view(idx, size_hw) for idx in range(3)]
    relative = [pose @ scene.poses[0].inverse() for pose in scene.poses[1:3]]
    bare = len(default_room().surfaces)
    empty = dataclasses.replace(scene.room, surfaces=scene.room.surfaces[:bare], textures=scene.room.textures[:bare])
    assert isinstance(empty, Room)
    truth = views[0][1]
    thin = np.abs(render(empty, scene.poses[0], size_hw)[1] - truth) > 0.05 * truth
    plain, guided = (
        _good(_sweep([view[0] for view in views], relative, PLAIN.replace(levels=levels)).range, truth)[thin].mean()
        for levels in (1, 2)
    )
    assert guided > 0.8 * plain
