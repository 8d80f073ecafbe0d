"""The calibration file that docs/rigs.md shows can be read, and its keys are those of the code."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.io.rig_calibration import MODELS, read_rig
from pano_mvs.scene import FilePart
from pano_mvs.stages.rigs import DualFisheyeParams

PAGE = (Path(__file__).parents[2] / "docs" / "rigs.md").read_text(encoding="utf-8")


def test_the_calibration_file_of_the_page_can_be_read(tmp_path: Path) -> None:
    found = re.search(r"<!-- calibration -->\n```yaml\n(.*?)```", PAGE, re.DOTALL)
    assert found
    (tmp_path / "rig.yaml").write_text(found[1], encoding="utf-8")
    rig = read_rig(FilePart(tmp_path / "rig.yaml"), stitch_distance_m=3.0)
    assert rig.names == ("front", "back")
    assert 2 * rig.lens_offset_m == pytest.approx(np.linalg.norm((0.0004, -0.0002, -0.0291)))
    assert rig.lens_of_bearings([(0, 0, 1), (0, 0, -1)]).tolist() == [0, 1]
    assert all(model in PAGE for model in MODELS)


def test_defaults_on_the_page_are_those_of_the_stage() -> None:
    defaults = DualFisheyeParams.model_validate({"path": "photos"})
    assert f"`stitch_distance_m` ({defaults.stitch_distance_m:g} by default" in PAGE
    assert f"`blend_deg` ({defaults.blend_deg:g})" in PAGE
