"""What a run on a dask cluster delivers and stores."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.testing.room import capture_poses, default_room
from tests.cli.workflows.test_equivariance import WAYS, check_same_bytes
from tests.synthetic.capture_files import write_capture


@pytest.mark.slow
def test_dask_gives_the_same_bytes(tmp_path: Path) -> None:
    write_capture(tmp_path / "capture", default_room(), capture_poses(3, spread=0.4), size_hw=(112, 224))
    ways = {"serial": WAYS["serial"], "dask": ("--executor", "dask", "--workers", "2")}
    check_same_bytes(ways, tmp_path / "capture", tmp_path)
