"""Costs are averaged among neighbours of similar colour, and semi-global matching works in parts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.backends.numba_backend import VOLUME_BYTES, volume_parts
from pano_mvs.algorithms.sweep.edge_support import EdgeSupport, average_volume, averaged, averaged_at
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.settings import SweepSettings
from pano_mvs.algorithms.sweep.sweep import sweep_range
from pano_mvs.testing.room import capture_poses, default_room, render

SIZE = 24, 48
DEPTH = 5


def _work(picture: NDArray[np.uint8], **changes: Any) -> SweepInput:
    settings = SweepSettings(planes=DEPTH).replace(**changes)
    return SweepInput(picture, (), (), None, np.linspace(1, 2, DEPTH), settings)


def _noise(seed: int = 0) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    rng = np.random.default_rng([seed, 0xED])
    picture = rng.integers(0, 60, (*SIZE, 3), dtype=np.uint8)
    return picture, rng.integers(0, 256, (SIZE[0], DEPTH, SIZE[1]), dtype=np.uint8)


@pytest.mark.kernel("sweep.numba.kernels_edge_support")
@pytest.mark.parametrize("side", [3, 5, 9])
def test_the_compiled_average_is_the_plain_one(side: int) -> None:
    picture, volume = _noise()
    work = _work(picture, edge_support=side)
    expected = averaged(volume.astype(np.int64), work)
    average_volume(volume, work)
    np.testing.assert_array_equal(volume, expected)


def test_the_weights_add_up_and_follow_the_colours() -> None:
    picture = np.full((*SIZE, 3), 200, np.uint8)
    picture[:, 20:22, 0] = 90  # red falls, brightness hardly
    support = EdgeSupport.of(_work(picture, edge_support=5))
    assert support is not None
    np.testing.assert_array_equal(support.along.sum(axis=0), 256)
    np.testing.assert_array_equal(support.across.sum(axis=0), 256)
    row, column = SIZE[0] // 2, 20
    assert support.along[2:4, row, column].min() > 120
    assert support.along[[0, 1, 4], row, column].max() <= 2
    np.testing.assert_array_equal(support.across[:, row, column], [51, 51, 52, 51, 51])


def test_a_thin_line_keeps_costs_of_its_own() -> None:
    picture = np.full((*SIZE, 3), 200, np.uint8)
    volume = np.full((SIZE[0], DEPTH, SIZE[1]), 200, np.uint8)
    picture[:, 30], volume[:, 2, 30] = 60, 0
    average_volume(volume, _work(picture))
    assert volume[4:-4, 2, 30].max() < 10
    assert volume[4:-4, 2, 29].min() > 190


def test_nothing_is_averaged_without_a_support_or_a_volume() -> None:
    picture, volume = _noise(1)
    before = volume.copy()
    average_volume(volume, _work(picture, edge_support=1))
    average_volume(volume, _work(picture, aggregation="box"))
    np.testing.assert_array_equal(volume, before)


def test_rows_in_parts_are_those_of_the_whole_away_from_the_cut() -> None:
    picture, volume = _noise(2)
    work = _work(picture, edge_support=5)
    lower = volume[10:].copy()
    average_volume(lower, work, top=10)
    average_volume(volume, work)
    np.testing.assert_array_equal(lower[2:], volume[12:])
    assert (lower[:2] != volume[10:12]).any()


@pytest.mark.parametrize("side", [1, 5])
def test_single_pixels_are_averaged_like_all_of_them(side: int) -> None:
    picture, volume = _noise(4)
    work = _work(picture, edge_support=side)
    rows, columns = np.array([0, 0, 11, 23]), np.array([0, 47, 13, 5])

    def costs_at(y: NDArray[np.intp], x: NDArray[np.intp]) -> NDArray[np.int64]:
        return volume[y, :, x].T.astype(np.int64)

    found = averaged_at(costs_at, work, rows=rows, columns=columns)
    expected = averaged(volume.astype(np.int64), work)
    np.testing.assert_array_equal(found, expected[rows, :, columns].T)


LIMITS = [(128, 0.02), (160, 0.005), (512, 0.1), (4096, 4.0), (4096, 8.0), (64, 1e-6)]


@pytest.mark.parametrize(("rows", "limit"), LIMITS)
def test_parts_cover_all_rows_once_and_know_what_is_around_them(rows: int, limit: float) -> None:
    settings = SweepSettings(volume_limit_gb=limit)
    parts = volume_parts((rows, 2 * rows), settings)
    assert [row for part in parts for row in range(part.rows.start, part.rows.stop)] == list(range(rows))
    for part in parts:
        assert part.around.start == 0 or part.rows.start - part.around.start >= rows / 20
        assert part.around.stop == rows or part.around.stop - part.rows.stop >= rows / 20
        volume = VOLUME_BYTES * (part.around.stop - part.around.start) * 2 * rows * settings.planes
        assert volume <= limit * 1e9 or part.rows.stop - part.rows.start <= 32


def test_matching_in_parts_finds_what_matching_at_once_does() -> None:
    views_at = capture_poses(2, seed=5)
    pictures = [render(default_room(1), pose, (256, 512), supersample=1)[0] for pose in views_at]
    poses = [views_at[1] @ views_at[0].inverse()]
    settings = SweepSettings(planes=24, exposure=False)
    limited = settings.replace(volume_limit_gb=0.005)
    whole = sweep_range(pictures[0], pictures[1:], poses, near=0.5, far=6.0, settings=settings)
    parts = sweep_range(pictures[0], pictures[1:], poses, near=0.5, far=6.0, settings=limited)
    assert len(volume_parts((256, 512), limited)) > 2
    same = np.isclose(parts.range, whole.range, rtol=1e-3, equal_nan=True)
    assert same.mean() > 0.995
    assert same[[0, -1]].mean() > 0.99
