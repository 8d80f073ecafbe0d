"""`pano-mvs calibrate`: a calibration of rendered pictures, or an error that names the remedy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pano_mvs.io.rig_calibration import read_rig
from pano_mvs.scene import FilePart
from pano_mvs.scene.image_file import write_png
from tests.cli.conftest import Command, pano_mvs
from tests.synthetic.rig_images import tiny_rig_capture
from tools.benchmarks.poses.lens_calibration import calibration_errors, place, random_rig, write_raw_capture

__all__ = ["pano_mvs"]  # a fixture


def write_pictures(folder: Path, count: int, value: int = 90, *, size_hw: tuple[int, int] = (100, 200)) -> Path:
    folder.mkdir(exist_ok=True)
    for number in range(count):
        write_png(folder / f"{value}_{number}.png", np.full((*size_hw, 3), value, np.uint8))
    return folder


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--lenses", "front"], "two different names, separated by a comma"),
        (["--layout", "stacked"], "is not one of 'auto', 'side_by_side', 'folders', 'suffixes'"),
        (["--up", "down"], "is not one of 'top', 'right', 'bottom', 'left'"),
        (["--distance", "28"], "28 m is too far for the lenses of one camera. Add a unit: 28mm"),
        (["--distance", "near"], "is not a length"),
    ],
)
def test_wrong_options_are_errors(pano_mvs: Command, tmp_path: Path, options: list[str], message: str) -> None:
    result = pano_mvs("calibrate", write_pictures(tmp_path / "in", 2), "--out", tmp_path / "rig.yaml", *options)
    assert result.code == 2
    assert message in result.flat


def test_stitched_pictures_are_refused(pano_mvs: Command, tmp_path: Path) -> None:
    result = pano_mvs("calibrate", write_pictures(tmp_path / "in", 2), "--out", tmp_path / "rig.yaml")
    assert result.code == 2
    assert "no bright circle with a dark surround. Give the raw pictures" in result.flat
    assert not (tmp_path / "rig.yaml").exists()


def test_one_picture_is_not_enough(pano_mvs: Command, tmp_path: Path) -> None:
    result = pano_mvs("calibrate", write_pictures(tmp_path / "in", 1), "--out", tmp_path / "rig.yaml")
    assert result.code == 2
    assert "contains 1 complete capture of both lenses; a calibration needs two or more" in result.flat


def test_pictures_of_two_sizes_are_refused(pano_mvs: Command, tmp_path: Path) -> None:
    write_pictures(tmp_path / "in", 1)
    write_pictures(tmp_path / "in", 1, 91, size_hw=(120, 240))
    result = pano_mvs("calibrate", tmp_path / "in", "--out", tmp_path / "rig.yaml")
    assert result.code == 2
    assert "91_0.png has another size than the pictures before it" in result.flat


def test_pictures_with_too_little_in_common_are_refused(pano_mvs: Command, tmp_path: Path) -> None:
    result = pano_mvs("calibrate", tiny_rig_capture() / "images", "--out", tmp_path / "rig.yaml")
    assert result.code == 2
    assert "Give" in result.flat
    assert not (tmp_path / "rig.yaml").exists()


@pytest.mark.slow
def test_the_lenses_of_a_rendered_camera_are_found(pano_mvs: Command, tmp_path: Path) -> None:
    rig, (room, poses) = random_rig(5, size_px=320), place("room", 5, 4)
    write_raw_capture(tmp_path, room, poses, rig=rig, seed=5)
    distance = f"{2000 * rig.lens_offset_m}mm"
    result = pano_mvs("calibrate", tmp_path / "images", "--out", tmp_path / "rig.yaml", "--distance", distance)
    assert result.code == 0, result.text
    found = read_rig(FilePart(tmp_path / "rig.yaml"))
    errors = calibration_errors(found, rig)
    assert errors.ray_deg < 0.03
    assert errors.turn_deg < 0.05
    assert errors.offset_deg < 5
    assert found.metric
    assert found.lens_offset_m == pytest.approx(rig.lens_offset_m)
    assert "the standard deviations cover noise in the key points only" in (tmp_path / "rig.yaml").read_text()
