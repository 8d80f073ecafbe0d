"""The mask of docs/masks.md, written as the page shows it, keeps its contract and holds in a whole run."""

from __future__ import annotations

import re
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from pano_mvs.io.ply import read_ply
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.testing.conformance import stage_contract_tests
from tests.cli.conftest import Command, capture, pano_mvs, rendered  # noqa: F401  # fixtures
from tests.stored import read_picture

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "masks.md").read_text(encoding="utf-8")


@pytest.fixture
def plugin(tmp_path: Path) -> Path:
    (place,) = re.findall(r"<!-- file: (\S+) -->", PAGE)
    return Path(shutil.copy(ROOT / place, tmp_path))


def test_the_mask_on_the_page_keeps_the_contract(plugin: Path) -> None:
    for contract_test in stage_contract_tests(plugin):
        contract_test.check()


@pytest.mark.slow
def test_nothing_of_a_bearer_is_left_in_any_output(pano_mvs: Command, capture: Path, plugin: Path) -> None:  # noqa: F811
    """Somebody in a vest, on the seam of every picture; in each picture with another pattern on it."""
    size_hw = (160, 320)
    rows, columns = np.mgrid[: size_hw[0], : size_hw[1]]
    beside_seam = np.minimum(columns, size_hw[1] - 1 - columns)
    bearer = np.hypot(beside_seam, rows - 90) < 14
    for idx, path in enumerate(sorted((capture / "images").iterdir())):
        picture = cv2.cvtColor(read_picture(path), cv2.COLOR_BGR2RGB)
        pattern = np.random.default_rng(idx).integers(-25, 26, (*size_hw, 1))
        picture[bearer] = (np.array([225, 95, 5]) + pattern * (1, 0.4, 0.1))[bearer].astype(np.uint8)
        cv2.imwrite(str(path), cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))
    workflow = plugin.with_name("masked.yaml")
    (text,) = re.findall(r"<!-- workflow -->\n```yaml\n(.*?)```", PAGE, re.DOTALL)
    workflow.write_text(text.replace("photos", str(capture / "images")), encoding="utf-8")
    result = pano_mvs(
        "run", workflow, "--out", "out", "--set", "depth.planes=32", "--set", "features.max_keypoints=1500"
    )
    assert result.code == 0, result.text
    for path in sorted(Path("out/range").iterdir()):
        ranges = read_range_tiff(path)
        assert np.isnan(ranges[bearer]).all()
        assert np.isfinite(ranges[~bearer]).mean() > 0.7
    colors = read_ply(Path("out/cloud.ply")).colors_rgb.astype(np.int64)
    assert len(colors) > 1000
    assert not ((colors[:, 0] > 170) & (colors[:, 2] < 40)).any()
