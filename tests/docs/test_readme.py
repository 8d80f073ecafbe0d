"""What the README says is true: its commands exist, its plugin and its workflow run."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.testing.room import capture_poses, default_room
from tests.stored import read_picture
from tests.synthetic.capture_files import write_capture

README = Path(__file__).parents[2] / "README.md"


def block(mark: str) -> str:
    """Return the fenced block that follows a mark."""
    found = re.search(rf"<!-- {mark} -->\n```\w+\n(.*?)```", README.read_text(encoding="utf-8"), re.DOTALL)
    assert found, mark
    return found.group(1)


@pytest.mark.slow
def test_plugin_and_workflow_run_as_they_stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_capture(tmp_path / "room", default_room(), capture_poses(3, spread=0.4), size_hw=(128, 256))
    (tmp_path / "room" / "images").rename(tmp_path / "photos")
    (tmp_path / "far_cut.py").write_text(block("plugin"))
    (tmp_path / "mine.yaml").write_text(block("workflow"))
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["run", "mine.yaml", "--set", "depth.planes=16", "--set", "near.far=8"])
    assert result.exit_code == 0, result.output
    for path in sorted((tmp_path / "out" / "mine" / "range").iterdir()):
        ranges = read_picture(path, cv2.IMREAD_UNCHANGED)
        assert ranges[ranges == ranges].max() <= 8


def test_quickstart_command_names_a_workflow_that_is_there() -> None:
    workflow = re.search(r"pano-mvs run (\S+)", block("command: run"))
    assert workflow
    assert (README.parent / workflow.group(1)).is_file()
