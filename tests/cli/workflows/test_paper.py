"""The paper's way: its poses, written as a workflow, and the shipped workflow that does what the paper does."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.algorithms.poses.frame.metric_scale import unit_translations
from pano_mvs.geometry import Rigid3, rotation_from_rotvec
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.scene import Poses
from pano_mvs.testing.room import capture_poses
from tests.cli.conftest import SIZE_HW, Command, run_json

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


SMALL = ("--set", "features.max_keypoints=3000", "--set", "depth.planes=64")


@pytest.fixture
def run(rendered: Path, pano_mvs: Command) -> Callable[..., dict[str, Any]]:
    def call(*overrides: str, out: str = "out") -> dict[str, Any]:
        options = [part for override in overrides for part in ("--set", override)]
        result = pano_mvs(
            *f"run paper --images {rendered / 'images'} --out {out} --set scores.truth={rendered / 'truth'}".split(),
            *SMALL,
            *options,
        )
        assert result.code == 0, result.text
        return run_json(Path(out))

    return call


@pytest.mark.slow
def test_the_papers_way_from_pictures_to_ranges(run: Callable[..., dict[str, Any]]) -> None:
    summary = run()
    params = {stage["name"]: stage["params"] for stage in summary["stages"]}
    assert params["depth"]["spacing"] == "uniform"
    assert (params["depth"]["near"], params["depth"]["far"]) == (0.05, 10)
    assert (params["depth"]["cost"], params["depth"]["window"], params["depth"]["selection"]) == ("sad", 7, "winner")
    for name, view in summary["scores"]["views"].items():
        # Ranges of a plane sweep over uniform hypotheses are coarse far away; no constant comes near them all the same.
        assert view["psnr_db"] > view["best_constant_psnr_db"] + 4, name
        assert view["w_mae"] < 0.65 * view["best_constant_w_mae"], name
        assert view["w_delta_105"] > view["best_constant_w_delta_105"], name
        assert view["median_relative_error"] < 0.16, name
    for name in ("000", "003"):
        ranges = read_range_tiff(Path("out") / f"range/{name}.tiff")
        assert ranges.shape == SIZE_HW
        assert np.nanmin(ranges) >= 0.05
        assert np.nanmax(ranges) <= 10


@pytest.mark.slow
def test_each_ablation_is_one_switch(run: Callable[..., dict[str, Any]]) -> None:
    full = run()
    unscaled = run("unscaled.enabled=true", out="unscaled")
    lengths = [np.linalg.norm(center) for center in unscaled["poses"]["centers"]]
    np.testing.assert_allclose(lengths, [0, 1, 1, 1], atol=1e-9)
    assert np.ptp(np.linalg.norm(full["poses"]["centers"], axis=1)[1:]) > 0.01
    plain = run("depth.prefilter_diameter=0", "depth.derotate=false", "smooth.keep_confidence=1", out="plain")
    stages = {stage["name"]: stage["params"] for stage in plain["stages"]}
    assert (stages["depth"]["prefilter_diameter"], stages["smooth"]["keep_confidence"]) == (0, 1)
    runs = [summary["scores"]["views"]["000.png"]["psnr_db"] for summary in (full, unscaled, plain)]
    assert len(set(runs)) == 3
    wrong = [summary["scores"]["poses"]["scale_ratio_error_max"] for summary in (full, unscaled)]
    assert wrong[0] < 0.5 * wrong[1]


def test_without_scale_factors_directions_and_rotations_stay() -> None:
    rng = np.random.default_rng(0)
    cameras = {
        f"{idx}": Rigid3.from_center(rotation_from_rotvec(rng.normal(size=3)), rng.normal(size=3) * (idx > 0) + 5)
        for idx in range(4)
    }
    poses = Poses.without_points(cameras, rejected={"x": "why"}, frame="f", scale="s", metric=True)
    moved = unit_translations(poses)
    np.testing.assert_allclose(moved.rotations, poses.rotations)
    offsets, before = moved.centers - 5, poses.centers - 5
    np.testing.assert_allclose(np.linalg.norm(offsets[1:], axis=1), 1)
    np.testing.assert_allclose(offsets[1:], before[1:] / np.linalg.norm(before[1:], axis=1, keepdims=True))
    assert (moved.rejected, moved.metric) == ({"x": "why"}, False)
