"""fast.yaml goes from pictures to a cloud."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pano_mvs.io.ply import read_ply
from pano_mvs.io.ranges import read_range_tiff
from tests.cli.conftest import Command, run_json


@pytest.mark.slow
def test_fast_runs_from_pictures_to_cloud(pano_mvs: Command, rendered: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    result = pano_mvs(
        *f"run fast --images {rendered / 'images'} --out {out} --set scores.truth={rendered / 'truth'}".split(),
        *["--set", "features.max_keypoints=1500"],
    )
    assert result.code == 0, result.text
    assert {stage["name"]: stage["run"] for stage in run_json(out)["stages"]}["depth"] == 4
    ranges = [read_range_tiff(out / f"range/00{view}.tiff") for view in range(4)]
    assert all(np.isfinite(found).mean() > 0.8 for found in ranges)
    assert len(read_ply(out / "cloud.ply")) > 5000
