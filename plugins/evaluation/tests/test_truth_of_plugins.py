"""Ground truth whose poses a plugin file of the user reads."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from pano_mvs.cli.plugins.new import EXAMPLES
from tests.cli.test_plugin_new import written_into


@pytest.mark.slow
def test_evaluate_knows_readers_of_files_from_the_start(mine: Path, tmp_path: Path) -> None:
    """In a process of its own, in which nothing has imported the user's files before."""
    written_into(mine, "pose_reader")
    path = tmp_path / "poses.txt"
    path.write_text(EXAMPLES["pose_reader"].format(name="mine_pose_reader"))
    command = [sys.executable, "-m", "pano_mvs", "evaluate", "poses", str(path), "--truth", str(path)]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
