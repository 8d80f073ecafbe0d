"""All backends of the sweep give the same winners, and strangers' backends and costs are as good as ours."""

from __future__ import annotations

import numpy as np
import pytest

from pano_mvs.algorithms.sweep.costs import CostWindow
from pano_mvs.algorithms.sweep.numpy_backend import winners_of
from pano_mvs.algorithms.sweep.running_winner import RunningWinner
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.algorithms.sweep.windows import WindowBands, column_offsets
from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.testing.sweep_backends import CASES, agreement


@pytest.mark.parametrize("backend", ["numba", "opencv"])
def test_every_backend_gives_the_winners_of_the_readable_one(backend):
    shares = [agreement(number, backend) for number in range(CASES)]
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
