"""All backends of the sweep give the same winners, and strangers' backends and costs are as good as ours."""

from __future__ import annotations

import functools
import itertools

import numpy as np
import pytest

from pano_mvs.algorithms.sweep.costs import CostWindow
from pano_mvs.algorithms.sweep.numpy_backend import winners_of
from pano_mvs.algorithms.sweep.running_winner import RunningWinner
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.algorithms.sweep.windows import WindowBands, column_offsets
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.testing.room import capture_poses, default_room, render

NEAR, FAR = 0.5, 6.0
SIZES = [(16, 32), (18, 36), (25, 50), (32, 64), (20, 30), (40, 24)]
COSTS = ["census", "zncc", "sad", "sad_gradient"]
COMBINATIONS = ["sum", "best_half", "best_k", "parallax_weighted"]


def _case(number: int):
    """Return pictures, poses, masks and settings drawn at random; every cost with every combination and aggregation."""
    rng = np.random.default_rng([2026, number])
    cost, combination, aggregation = list(itertools.product(COSTS, COMBINATIONS, ["box", "sgm"]))[number]
    settings = SweepSettings(
        planes=int(rng.integers(3, 24)),
        spacing=rng.choice(["inverse", "log", "uniform"]),
        cost=cost,
        window=int(rng.choice([3, 5, 7])),
        spherical_window=bool(rng.integers(2)),
        combination=combination,
        best=int(rng.integers(1, 4)),
        aggregation=aggregation,
        support=int(rng.choice([1, 3, 5])),
        p2_contrast=float(rng.choice([0.0, 15.0])),
        derotate=bool(rng.integers(4) == 0),
        exposure=bool(rng.integers(4) == 0),
    )
    count = int(rng.integers(1, 5))
    poses = capture_poses(count + 1, seed=number, spread=0.4)
    sizes = [SIZES[idx] for idx in rng.integers(0, len(SIZES), count + 1)]
    room = default_room(number % 3)
    pictures = [render(room, pose, size)[0] for pose, size in zip(poses, sizes, strict=True)]
    masks = [np.ones(size, np.bool_) for size in sizes]
    for mask in masks if rng.integers(2) else []:
        mask[-mask.shape[0] // 5 :] = False
        mask[4:9, 3:11] = False
    return pictures, [pose @ poses[0].inverse() for pose in poses[1:]], masks, settings


def _position(ranges, settings):
    scale = {"inverse": lambda r: 1 / r, "log": np.log, "uniform": lambda r: r}[settings.spacing]
    return (scale(ranges) - scale(NEAR)) / (scale(FAR) - scale(NEAR)) * (settings.planes - 1)


def _agreement(one, other, settings):
    """Return the share of pixels within half a level of each other, or without range in both."""
    with np.errstate(invalid="ignore"):
        close = np.abs(_position(one.range, settings) - _position(other.range, settings)) < 0.5
    return float((close | (np.isnan(one.range) & np.isnan(other.range))).mean())


def _swept(backend, pictures, poses, masks, settings):
    return sweep_range(
        pictures[0], pictures[1:], poses, near=NEAR, far=FAR, settings=settings, backend=backend,
        reference_mask=masks[0], source_masks=masks[1:],
    )  # fmt: skip


@functools.cache
def _plain(number: int):
    case = _case(number)
    return case, _swept("numpy", *case)


@pytest.mark.parametrize("backend", ["numba", "opencv"])
def test_every_backend_gives_the_winners_of_the_readable_one(backend):
    shares = []
    for number in range(32):
        case, plain = _plain(number)
        result = _swept(backend, *case)
        result.check()
        shares.append(_agreement(result, plain, case[-1]))
    assert np.mean(shares) >= 0.99
    assert min(shares) >= 0.97


def test_bands_find_every_place_of_the_window():
    rng = np.random.default_rng(0)
    picture = rng.integers(0, 255, (24, 48), dtype=np.uint8)
    bands = WindowBands.of((24, 48), 3, spherical=True)
    padded = bands.pad(picture)
    window = list(CostWindow(3, column_offsets((24, 48), 3, spherical=True)).neighbours(picture))
    covered = np.zeros(24, int)
    for rows, places in bands.places():
        covered[rows] += 1
        for place, expected in zip(places, window, strict=True):
            np.testing.assert_array_equal(padded[place], expected[rows])
    assert (covered == 1).all()


@pytest.mark.parametrize("levels", [4, 1000])
def test_the_running_winner_is_that_of_the_volume(levels):
    """With four levels many planes are equally cheap."""
    volume = np.random.default_rng(levels).integers(0, levels, (9, 17, 14)).astype(np.float64)
    running = RunningWinner((9, 14))
    for plane in range(17):
        running.add(volume[:, plane].astype(np.float32))
    for name, expected in vars(winners_of(volume)).items():
        np.testing.assert_array_equal(getattr(running.result(), name), expected)


def test_opencv_says_how_wide_a_picture_may_be():
    wide = np.zeros((16, 32_002, 3), np.uint8)
    pose = Rigid3(np.eye(3), np.array([0.3, 0, 0]))
    with pytest.raises(UsageError, match="at most 32000 columns"):
        sweep_range(wide, [wide], [pose], near=1, far=2, settings=SweepSettings(planes=3), backend="opencv")
