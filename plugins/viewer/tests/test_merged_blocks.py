"""Captures that were run in blocks, and merged, in the viewer."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.testing.room import capture_poses, default_room
from tests.cli.conftest import Command
from tests.synthetic.capture_files import write_capture


@pytest.mark.slow
def test_a_capture_in_blocks_is_shown_with_its_panoramas(pano_mvs: Command, tmp_path: Path) -> None:
    write_capture(tmp_path / "capture", default_room(), capture_poses(8, spread=0.4), size_hw=(48, 96))
    result = pano_mvs(
        "run", "known_poses", "--images", tmp_path / "capture/images", "--out", "out", "--cache", "cache",
        "--set", f"poses.path={tmp_path / 'capture/truth/poses.json'}", "--set", "depth.planes=8",
        "--set", "views.sources=2", "--set", "features.max_keypoints=400", "--executor", "serial",
        "--block-size", "7", "--block-overlap", "3",
    )  # fmt: skip
    assert result.code in (0, 3), result.text
    for view in (("--view", "inside:003.png"), ()):
        result = pano_mvs("view", "out", *view, "--screenshot", "view.png")
        assert result.code == 0, result.text
        assert "panoramas are not in" not in result.text
        assert Path("view.png").is_file()
