"""The sweep on PyTorch is the sweep of the other backends."""

from __future__ import annotations

import subprocess
import sys
from importlib.metadata import entry_points
from typing import Any, Literal

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from pano_mvs.algorithms.sweep.backends.numpy_backend import path_step as plain_path_step
from pano_mvs.algorithms.sweep.backends.numpy_backend import winners_of as plain_winners_of
from pano_mvs.algorithms.sweep.sweep import SweepSettings, sweep_range
from pano_mvs.algorithms.sweep.windows import CostWindow
from pano_mvs.api import Rigid3, UsageError
from pano_mvs.geometry import roll_panorama, sample_panorama
from pano_mvs.testing.room import capture_poses, default_room, render
from pano_mvs.testing.sweep_backends import CASES, agreement, sweep_case
from torch.nn import functional

from pano_mvs_torch import sweep
from pano_mvs_torch.batch import Batch, batch_for
from pano_mvs_torch.lookup import _blend, packed_patches
from pano_mvs_torch.paths import path_step

DEVICES = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]


@pytest.fixture(autouse=True)
def _plugins_are_loaded() -> None:
    for entry in entry_points(group="pano_mvs.plugins"):
        entry.load()


@pytest.mark.parametrize("device", DEVICES)
def test_the_winners_are_those_of_the_readable_backend(device: str) -> None:
    shares = [agreement(number, "torch", device=device) for number in range(CASES)]
    assert np.mean(shares) >= 0.99
    # From tiny pictures each backend's own rough ranges match exposures, to a grey level more or less.
    assert min(shares) >= 0.95
    assert min(share for number, share in enumerate(shares) if not sweep_case(number).settings.exposure) >= 0.97


@pytest.mark.parametrize("number", [0, 1, 9, 20])
def test_how_much_is_done_at_a_time_changes_no_byte(number: int, monkeypatch: pytest.MonkeyPatch) -> None:
    case = sweep_case(number)
    whole = case.swept("torch", device="cpu")
    small = Batch(torch.device("cpu"), costs=7 * case.settings.planes * whole.range.shape[1], samples=2000)
    assert small.rows(case.settings.planes, whole.range.shape[1]) == 7
    monkeypatch.setattr(sweep, "batch_for", lambda _: small)
    pieces = case.swept("torch", device="cpu")
    assert pieces.range.tobytes() == whole.range.tobytes()
    assert pieces.confidence.tobytes() == whole.confidence.tobytes()


@pytest.mark.parametrize("aggregation", ["box", "sgm"])
def test_rolling_all_pictures_rolls_the_range(aggregation: Literal["box", "sgm"]) -> None:
    poses = capture_poses(2, seed=5)
    pictures = [render(default_room(1), pose, (32, 64))[0] for pose in poses]
    pose = poses[1] @ poses[0].inverse()
    settings = SweepSettings(planes=12, window=5, aggregation=aggregation)

    def swept(views: list[NDArray[np.uint8]], pose: Rigid3) -> NDArray[np.float32]:
        return sweep_range(views[0], views[1:], [pose], near=0.5, far=6, settings=settings, backend="torch").range

    turn = Rigid3(roll_panorama(pictures[0], 16)[1], np.zeros(3))
    rolled = swept([np.roll(picture, 16, axis=1) for picture in pictures], turn @ pose @ turn.inverse())
    difference = np.abs(np.roll(rolled, -16, axis=1) / swept(pictures, pose) - 1)
    assert np.nanmedian(difference) < 1e-5
    assert (difference > 1e-3).mean() < 0.02  # at this size, some costs are equal to the last bit
    assert np.isfinite(difference).mean() > 0.9


def test_packed_samples_are_bilinear_over_seam_and_poles() -> None:
    rng = np.random.default_rng(1)
    picture = rng.integers(0, 256, (10, 20, 3), dtype=np.uint8)
    pixels = rng.uniform(0, 1, (500, 2)) * (20, 10)
    pixels[:4] = np.array([[0, 0], [20, 10], [19.9, 0.1], [0.2, 9.9]])
    packed = packed_patches(picture, torch.device("cpu"))
    x, y = torch.from_numpy(pixels + 0.5).float().T
    column, row = x.int().clamp(max=20), y.int().clamp(max=10)
    patches = packed[(row * 21 + column).long()]
    blended = _blend(patches, (x - column)[:, None], (y - row)[:, None]).numpy()
    expected = sample_panorama(picture, pixels)
    assert np.abs(blended - expected).max() <= 0.5 + 1e-3


def test_a_step_of_a_path_is_that_of_the_definition() -> None:
    rng = np.random.default_rng(2)
    costs = rng.integers(0, 256, (3, 11, 8))
    before = rng.integers(0, 8000, (3, 11, 8))
    penalty = rng.integers(500, 7900, (3, 8))
    bytes_, sums, steps = (
        torch.from_numpy(given.astype(kind))
        for given, kind in ((costs, np.uint8), (before, np.int16), (penalty, np.int16))
    )
    found = path_step(bytes_, functional.pad(sums, (0, 0, 1, 1), value=20_000), steps, 5000)[:, 1:-1]
    for k in range(3):
        np.testing.assert_array_equal(found[k].numpy(), plain_path_step(costs[k], before[k], penalty[k], p1=5000))


def test_of_equal_planes_the_nearest_wins() -> None:
    volume = np.random.default_rng(4).integers(0, 4, (6, 9, 8)).astype(np.float32)
    found = sweep.winners_of(torch.from_numpy(volume))
    for name, expected in vars(plain_winners_of(volume.transpose(1, 0, 2).astype(np.float64))).items():
        np.testing.assert_array_equal(getattr(found, name), expected)


def test_a_device_that_is_not_there_is_named() -> None:
    with pytest.raises(UsageError, match="'cuda:99': use `device: auto`"):
        batch_for("cuda:99")
    assert batch_for("auto").device.type == ("cuda" if torch.cuda.is_available() else "cpu")


def test_costs_that_it_does_not_have_are_refused() -> None:
    from pano_mvs.api import register_sweep_cost

    @register_sweep_cost("somebody-elses")
    def cost(reference: NDArray[Any], warped: NDArray[Any], window: CostWindow) -> NDArray[np.float64]:
        return np.zeros(reference.shape[:2])

    with pytest.raises(
        UsageError, match="backend 'torch' does not have the cost 'somebody-elses'; those that do: numpy"
    ):
        sweep_range(*_nothing(), near=1, far=2, settings=SweepSettings(cost="somebody-elses"), backend="torch")


def _nothing() -> tuple[NDArray[np.uint8], list[NDArray[np.uint8]], list[Rigid3]]:
    picture = np.zeros((16, 32, 3), np.uint8)
    return picture, [picture], [Rigid3(np.eye(3), np.array([0.3, 0, 0]))]


def test_torch_is_not_imported_before_it_is_used() -> None:
    code = (
        "import sys; from importlib.metadata import entry_points as e\n"
        "[p.load() for p in e(group='pano_mvs.plugins')]\n"
        "from pano_mvs.algorithms.sweep.backends.registry import SWEEP_BACKENDS as b\n"
        "assert 'torch' in b.names() and 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
