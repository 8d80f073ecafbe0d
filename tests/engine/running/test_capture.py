"""What a unit does with the standard streams ends with it."""

from __future__ import annotations

import io
import sys
from pathlib import Path

import pytest

from pano_mvs.engine.executors.capture import captured


@pytest.mark.skipif(not Path("/proc/self/fd").is_dir(), reason="of Linux")
@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_detached_stream_leaves_no_open_files(tmp_path: Path) -> None:
    """It failed the unit, and the next units found fewer and fewer descriptors."""
    before = sorted(Path("/proc/self/fd").iterdir())
    log = tmp_path / "log.txt"
    for _ in range(3):
        with captured(log):
            sys.stdout = io.TextIOWrapper(sys.stdout.detach(), encoding="utf-8")  # type: ignore[union-attr]
            print("seen")
    assert log.read_text() == "seen\n"
    assert sorted(Path("/proc/self/fd").iterdir()) == before
