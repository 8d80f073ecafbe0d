"""Where in the picture a thing is makes no difference to the dense stages of the best workflow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pano_mvs.geometry import roll_panorama, rotation_from_rotvec
from tests.synthetic.scenes import SCENES, Scene, write_scene
from tools.benchmarks.dense_chain import DenseChain
from tools.benchmarks.equivariance import (
    Bad,
    Equivariance,
    FolderPlace,
    ScenePlace,
    bad_pixels,
    measure,
    relative_difference,
    row,
    smooth_truth,
    turned_picture,
)

SMALL = ["depth.planes=48", "depth.near=1.0", "depth.far=6.0"]
SIZE = (64, 128)


@pytest.fixture(scope="module")
def scene() -> Scene:
    return SCENES["weak_room"](views=3, seed=2)


@pytest.fixture(scope="module")
def found(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Equivariance]:
    folder, chain = tmp_path_factory.mktemp("turned"), DenseChain("quality", overrides=SMALL)
    chain.dense.remove("structure")  # no test here looks at it, and it takes most of the time
    return measure(chain, ScenePlace(scene, folder, SIZE[1]), folder, seed=1)


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["depth", "slanted", "checked", "planes"])
def test_rolled_pictures_give_the_rolled_range(found: dict[str, Equivariance], stage: str) -> None:
    median, above_1_percent = found[stage].roll
    assert median <= 1e-3
    assert above_1_percent < 0.05


@pytest.mark.slow
@pytest.mark.parametrize(("stage", "most"), [("depth", 1.2e-2), ("slanted", 8e-3), ("planes", 8e-3)])
def test_a_turned_reference_gives_the_turned_range(found: dict[str, Equivariance], stage: str, most: float) -> None:
    """At 80 rows; the benchmark holds larger pictures against the bar of 5e-3."""
    assert found[stage].turn[0] <= most


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["depth", "checked", "planes"])
def test_seam_and_poles_are_no_worse_than_the_middle(found: dict[str, Equivariance], stage: str) -> None:
    assert found[stage].seam.there <= 1.2 * found[stage].seam.elsewhere + 0.01
    # The raw sweep of these few rows has 6 % of bad pixels at the equator, and 12 % at the poles; with other seeds, the
    # poles have fewer or one per cent more.
    assert found[stage].poles.there <= 1.2 * found[stage].poles.elsewhere + 0.055


@pytest.mark.slow
def test_a_line_tells_all(found: dict[str, Equivariance]) -> None:
    assert len(row("x", "depth", found["depth"])) == 12


def test_ranges_that_did_not_turn_with_the_picture_are_told(scene: Scene) -> None:
    truth = scene.view(0, SIZE)[1]
    rolled, turn = roll_panorama(truth, 31)
    smooth = smooth_truth(truth)
    assert 0.5 < smooth.mean() < 1
    assert np.median(relative_difference(truth, rolled, turn, smooth)) < 1e-6
    assert np.median(relative_difference(truth, truth, turn, smooth)) > 0.05


def test_wrong_and_missing_ranges_are_bad() -> None:
    truth = np.full((4, 8), 2.0, np.float32)
    ranges = truth * np.array([1, 1.04, 1.06, 0.9, np.nan, 1, 1, 1], np.float32)
    np.testing.assert_array_equal(bad_pixels(ranges, truth)[0], [False, False, True, True, True, False, False, False])
    assert Bad(0.3, 0.2).ratio == pytest.approx(1.5)


@pytest.mark.slow
def test_a_capture_on_disk_turns_like_the_scene(scene: Scene, tmp_path: Path) -> None:
    """Resampled from twice the size, a picture differs from one rendered in the turned camera by a few grey levels."""
    turn = {"000.png": rotation_from_rotvec((0.7, -1.1, 0.4))}
    still = ScenePlace(scene, tmp_path, SIZE[1])
    write_scene(tmp_path / "capture", still._still, (2 * SIZE[0], 2 * SIZE[1]))
    resampled = FolderPlace(tmp_path / "capture", SIZE[1], 2).turned(turn, tmp_path / "resampled")
    afresh = still.turned(turn, tmp_path / "afresh").first(2)
    np.testing.assert_allclose(resampled.poses["000.png"].rotation, afresh.poses["000.png"].rotation, atol=1e-12)
    pictures = [np.asarray(each.panoramas["000.png"].load(), np.float64) for each in (resampled, afresh)]
    assert np.abs(pictures[0] - pictures[1]).mean() < 4
    with np.errstate(invalid="ignore"):
        assert np.median(np.abs(resampled.ranges["000.png"] / afresh.ranges["000.png"] - 1)) < 0.01
    unturned = turned_picture(np.asarray(afresh.panoramas["000.png"].load()), np.eye(3), SIZE)
    assert np.abs(unturned - pictures[1]).mean() < 3
