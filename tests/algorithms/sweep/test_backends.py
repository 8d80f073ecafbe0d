"""All backends of the sweep give the same winners, and strangers' backends and costs are as good as ours."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.algorithms.sweep.backends.numpy_backend import find_winners, winners_of
from pano_mvs.algorithms.sweep.backends.opencv_backend import RunningWinner
from pano_mvs.algorithms.sweep.backends.registry import (
    SWEEP_BACKENDS,
    backend_for,
    helper_backend,
    register_sweep_backend,
)
from pano_mvs.algorithms.sweep.costs import SWEEP_COSTS, register_sweep_cost
from pano_mvs.algorithms.sweep.limits import limits_by_sweeping
from pano_mvs.algorithms.sweep.preparation import SweepInput
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.algorithms.sweep.windows import CostWindow, WindowBands, column_offsets, neighbours
from pano_mvs.algorithms.sweep.winner import Winners
from pano_mvs.core.errors import ContractError, PluginError, UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.testing.room import capture_poses, default_room, render
from pano_mvs.testing.sweep_backends import CASES, agreement, share_alike, sweep_case


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["numba", "opencv"])
def test_every_backend_gives_the_winners_of_the_readable_one(backend: str) -> None:
    """Every third case: all costs, combinations and aggregations, though not all of them together."""
    shares = {number: agreement(number, backend) for number in range(0, CASES, 3)}
    assert np.mean(list(shares.values())) >= 0.99
    # From tiny pictures each backend's own rough ranges match exposures, to a grey level more or less.
    assert min(shares.values()) >= 0.95
    assert min(share for number, share in shares.items() if not sweep_case(number).settings.exposure) >= 0.97


def test_bands_find_every_place_of_the_window() -> None:
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (24, 48), dtype=np.uint8)
    bands = WindowBands.of((24, 48), 3, spherical=True)
    padded = bands.pad(picture)
    columns = column_offsets((24, 48), 3, spherical=True)
    window = [neighbours(picture, row, columns[:, place]) for row in range(-3, 4) for place in range(7)]
    covered = np.zeros(24, int)
    for rows, places in bands.places():
        covered[rows] += 1
        for place, expected in zip(places, window, strict=True):
            np.testing.assert_array_equal(padded[place], expected[rows])
    assert (covered == 1).all()


@pytest.mark.parametrize("levels", [4, 1000])
def test_the_running_winner_is_that_of_the_volume(levels: int) -> None:
    """With four levels many planes are equally cheap."""
    volume = np.random.default_rng(levels).integers(0, levels, (9, 17, 14)).astype(np.float64)
    running = RunningWinner((9, 14))
    for plane in range(17):
        running.add(volume[:, plane].astype(np.float32))
    for name, expected in vars(winners_of(volume)).items():
        np.testing.assert_array_equal(getattr(running.result(), name), expected)


def test_opencv_says_how_wide_a_picture_may_be() -> None:
    wide = np.zeros((16, 32_002, 3), np.uint8)
    pose = Rigid3(np.eye(3), np.array([0.3, 0, 0]))
    with pytest.raises(UsageError, match="at most 32000 columns"):
        sweep_range(wide, [wide], [pose], near=1, far=2, settings=SweepSettings(planes=3), backend="opencv")


@pytest.fixture
def ours() -> Iterator[None]:
    """Forget what a test registers."""
    before = dict(SWEEP_BACKENDS._added), dict(SWEEP_COSTS._added)
    yield
    SWEEP_BACKENDS._added, SWEEP_COSTS._added = before


def census_like(reference: NDArray[Any], warped: NDArray[Any], window: CostWindow) -> NDArray[np.float64]:
    """The census cost, as a stranger would write it."""
    pairs = zip(window.neighbours(reference[..., 0]), window.neighbours(warped[..., 0]), strict=True)
    differs = [(ours > reference[..., 0]) != (theirs > warped[..., 0]) for ours, theirs in pairs]
    result: NDArray[np.float64] = np.sum(differs, axis=0) / (len(differs) - 1)
    return result


@pytest.mark.parametrize("backend", ["numpy", "opencv"])
@pytest.mark.parametrize("number", [2, 3])
def test_census_from_a_plugin_is_census(ours: None, backend: str, number: int) -> None:
    case = sweep_case(number)
    assert case.settings.cost == "census"
    register_sweep_cost("census-like")(census_like)
    settings = case.settings.replace(cost="census-like")
    found = replace(case, settings=settings).swept(backend)
    assert share_alike(found, case.swept("numpy"), case.ranges) >= 0.99


def test_a_colour_cost_is_given_colours_and_grey_is_the_default(ours: None) -> None:
    seen = []

    def cost(reference: NDArray[Any], warped: NDArray[Any], window: CostWindow) -> NDArray[np.float64]:
        seen.append((reference.shape, warped.shape, warped.dtype, window.radius))
        return np.full(reference.shape[:2], 0.5)

    register_sweep_cost("grey")(cost)
    register_sweep_cost("colour", colors=True)(cost)
    picture = np.zeros((16, 32, 3), np.uint8)
    pose = Rigid3(np.eye(3), np.array([0.3, 0, 0]))
    for name in ("grey", "colour"):
        settings = SweepSettings(planes=3, cost=name, exposure=False)
        sweep_range(picture, [picture], [pose], near=1, far=2, settings=settings, backend="numpy")
    assert {first[2] for first, *_ in seen} == {1, 3}
    assert all(ours == theirs and kind == np.float64 and radius == 3 for ours, theirs, kind, radius in seen)


@pytest.mark.parametrize("value", [1.5, -0.1, np.nan])
def test_a_cost_out_of_bounds_is_blamed(ours: None, value: float) -> None:
    register_sweep_cost("wrong")(lambda reference, warped, window: np.full(reference.shape[:2], value))
    picture = np.zeros((16, 32, 3), np.uint8)
    pose = Rigid3(np.eye(3), np.array([0.3, 0, 0]))
    with pytest.raises(ContractError, match=r"'wrong' must return \(16, 32\) from 0 to 1"):
        sweep_range(
            picture, [picture], [pose], near=1, far=2, settings=SweepSettings(planes=3, cost="wrong"), backend="opencv"
        )


def test_the_small_sweeps_behind_a_sweep_need_not_be_the_backends_own(ours: None) -> None:
    """A backend that has differences only: limits and exposures are found by census, with numba."""

    @register_sweep_backend("differences", costs=["sad"])
    def find(work: SweepInput) -> Winners:
        assert work.settings.cost == "sad"
        assert work.device == "cuda:3"
        return find_winners(work)

    assert helper_backend("differences") == "numba"
    assert helper_backend("opencv") == "opencv"
    poses = capture_poses(2, seed=5)
    pictures = [render(default_room(1), pose, (32, 64))[0] for pose in poses]
    masks = [np.ones((32, 64), np.bool_)] * 2
    near, far = limits_by_sweeping(pictures, poses, masks=masks, backend="differences")
    assert 0 < near < far
    found = sweep_range(
        pictures[0],
        pictures[1:],
        [poses[1] @ poses[0].inverse()],
        near=near,
        far=far,
        settings=SweepSettings(planes=8, cost="sad"),
        backend="differences",
        device="cuda:3",
    )
    found.check()
    with pytest.raises(UsageError, match="'differences' does not have the cost 'census'; those that do: numba, numpy"):
        backend_for("differences", SweepSettings())


def test_built_in_names_are_not_to_be_taken(ours: None) -> None:
    with pytest.raises(PluginError, match="'numba' is built in"):
        register_sweep_backend("numba")(find_winners)
    assert SWEEP_BACKENDS.code_file("numba") is None


@pytest.mark.parametrize(
    ("settings", "voxels"),
    [
        (SweepSettings(planes=100), 100_000),
        (SweepSettings(planes=100, aggregation="box"), 0),
        (SweepSettings(planes=100, levels=2), 25_000),
    ],
)
def test_the_memory_of_a_volume_is_the_backends(ours: None, settings: SweepSettings, voxels: int) -> None:
    register_sweep_backend("large", bytes_per_voxel=8)(find_winners)
    assert SWEEP_BACKENDS.get("large").volume_bytes(1000, settings) == 8 * voxels
    assert SWEEP_BACKENDS.get("numpy").volume_bytes(1000, settings) == 24 * voxels
    limited = settings.replace(volume_limit_gb=1e-5)
    assert SWEEP_BACKENDS.get("numba").volume_bytes(1000, limited) == min(3 * voxels, 10_000)
    assert SWEEP_BACKENDS.get("large").volume_bytes(1000, limited) == 8 * voxels
