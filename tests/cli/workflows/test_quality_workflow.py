"""quality.yaml goes from pictures to a cloud, and its ranges are more precise than the quickstart's."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pano_mvs.io.ply import read_ply
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.session.session import open_session
from tests.cli.conftest import SMALL, Command, run_json


def test_exchanged_ranges_are_checked_against_those_before_the_exchange() -> None:
    """Otherwise the view that a range comes from confirms it."""
    edges = open_session("quality").graph.edges["checked"]
    assert edges["range_map"].producer == "exchanged"
    assert edges["sources"].producer == "plain"


@pytest.mark.slow
def test_quality_is_more_precise_than_the_quickstart_on_the_same_pictures(
    pano_mvs: Command, rendered: Path, tmp_path: Path
) -> None:
    errors = {}
    for preset in ("quickstart", "quality"):
        out = tmp_path / preset
        result = pano_mvs(
            *f"run {preset} --images {rendered / 'images'} --out {out} --cache cache".split(),
            *f"--set scores.truth={rendered / 'truth'}".split(),
            *SMALL,
        )
        assert result.code == 0, result.text
        errors[preset] = np.mean([view["median_relative_error"] for view in run_json(out)["scores"]["views"].values()])
        assert all(np.isfinite(read_range_tiff(out / f"range/00{view}.tiff")).mean() > 0.95 for view in range(4))
    assert errors["quality"] < 0.6 * errors["quickstart"]
    assert len(read_ply(tmp_path / "quality" / "cloud.ply")) > 5000
