"""The paper's way to poses, written as a workflow."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pano_mvs.testing.room import capture_poses
from tests.cli.conftest import Command, run_json

FAITHFUL = """\
pano_mvs: 1
stages:
  images:   {{use: source.folder, path: "{images}"}}
  features: {{use: features.sphorb, max_keypoints: 3000}}
  pairs:    {{use: pairs.exhaustive}}
  matches:
    {{use: matches.brute_force, ratio: 0.75, mutual: false, solver: eight_point, refine: false, threshold_deg: 1}}
  poses:    {{use: poses.scaled_translation, scale_estimator: kappa, kappa: 0.01, adjust: false}}
  colmap:   {{use: export.colmap}}
"""


@pytest.fixture
def faithful(capture: Path, tmp_path: Path) -> Path:
    workflow = tmp_path / "paper_poses.yaml"
    workflow.write_text(FAITHFUL.format(images=capture / "images"))
    return workflow


@pytest.mark.slow
def test_a_workflow_can_say_what_the_paper_does(faithful: Path, tmp_path: Path, pano_mvs: Command) -> None:
    outcome = pano_mvs("run", faithful, "--out", tmp_path / "out")
    assert outcome.code == 0, outcome.text
    summary = run_json(tmp_path / "out")
    found = np.array(summary["poses"]["centers"])
    true = np.array([pose.center for pose in capture_poses(4, spread=0.4)])
    np.testing.assert_allclose(found, true / np.linalg.norm(true[1]), atol=0.05)
    stages = {stage["name"]: stage for stage in summary["stages"]}
    assert stages["poses"]["params"]["adjust"] is False
    metrics = stages["matches"]["metrics"]
    assert metrics["inliers"] > 100
    assert 0 < metrics["residual_deg"] < 1
    assert 0 < metrics["direction_std_deg"] < 1
    assert metrics["parallax_deg"] > 2
