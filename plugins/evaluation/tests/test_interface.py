"""The Python interface of evaluation: its names, and inputs in memory."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pano_mvs_evaluation.capture import RunEvaluation, score_capture
from pano_mvs_evaluation.clouds.evaluate import evaluate_cloud
from pano_mvs_evaluation.poses import evaluate_poses
from pano_mvs_evaluation.ranges import tables as depth_tables
from pano_mvs_evaluation.ranges.evaluate import evaluate_depth
from pano_mvs_evaluation.tables import TextTable

from pano_mvs.core.errors import UsageError
from pano_mvs.geometry import Rigid3
from pano_mvs.io.ply import write_ply
from pano_mvs.scene import PointCloud, Poses, RangeMap
from tests.stored import write_npz

POSES = {name: Rigid3(np.eye(3), np.array([x, 0.0, z])) for name, x, z in (("a", 0, 0), ("b", 1, 0), ("c", 0, 2))}


def test_poses_may_be_records_files_or_transforms(tmp_path: Path) -> None:
    record = Poses.without_points(POSES, frame="of the test", scale="of the test", metric=True)
    views = [{"image": n, "R": p.rotation.tolist(), "t": p.translation.tolist()} for n, p in POSES.items()]
    (tmp_path / "poses.json").write_text(json.dumps({"metric": True, "views": views}))
    turned = POSES | {"c": Rigid3(np.diag([-1.0, 1, -1]), POSES["c"].translation)}
    found = [evaluate_poses(turned, truth) for truth in (record, str(tmp_path / "poses.json"), POSES)]
    assert [one.unit for one in found] == ["m", "m", "units of the truth"]
    for one in found:
        assert one.pairs.rotation_deg.max() == pytest.approx(180)
        assert one.to_json()["pairs"] == 3


def test_ranges_in_memory_score_like_those_in_files(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    truth = {name: rng.uniform(1, 4, (8, 16)).astype(np.float32) for name in "ab"}
    estimates = {name: (1.1 * ranges).astype(np.float32) for name, ranges in truth.items()}
    write_npz(tmp_path / "found.npz", estimates)
    write_npz(tmp_path / "true.npz", truth)
    of_files = evaluate_depth(str(tmp_path / "found.npz"), tmp_path / "true.npz")
    in_memory = evaluate_depth(estimates, truth)
    assert in_memory.views == of_files.views
    confidence = np.full((8, 16), 200, np.uint8)
    records = {name: RangeMap(ranges, confidence) for name, ranges in estimates.items()}
    assert evaluate_depth(records, truth).mean.keys() - in_memory.mean.keys() > {"ause"}
    np.testing.assert_array_equal(evaluate_depth(records, truth).read_maps("a").confidence, confidence)
    with pytest.raises(UsageError, match="the array a has the shape"):
        evaluate_depth({"a": np.ones(3)}, truth)


def test_clouds_in_memory_score_like_those_in_files(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(0, 1, (200, 3)).astype(np.float32)
    up, grey = np.tile(np.array([0, -1, 0], np.float32), (200, 1)), np.full((200, 3), 9, np.uint8)
    cloud = PointCloud(points, up, grey, np.ones(200, np.uint8))
    write_ply(tmp_path / "a.ply", cloud)
    given = (points, cloud, tmp_path / "a.ply", str(tmp_path / "a.ply"))
    scores = [evaluate_cloud(one, points + 0.03, thresholds=(0.06, 0.04)).scores for one in given]
    assert scores[0] == scores[1] == scores[2] == scores[3]
    assert scores[0][1].accuracy < scores[0][0].accuracy == 1
    with pytest.raises(UsageError, match=r"of shape \(N, 3\)"):
        evaluate_cloud(np.ones((4, 2)), points)


def test_evaluations_print_their_main_figures_only() -> None:
    truth = {name: np.full((8, 16), 2, np.float32) for name in "ab"}
    depth = evaluate_depth({name: 1.1 * ranges for name, ranges in truth.items()}, truth)
    points = np.random.default_rng(0).uniform(0, 1, (200, 3)).astype(np.float32)
    cloud = evaluate_cloud(points, points, thresholds=(0.06,))
    assert repr(evaluate_poses(POSES, POSES)) == "PoseEvaluation(3 of 3 images registered, median error of a pair 0°)"
    assert repr(depth) == "DepthEvaluation(2 views, mean w_mae 0.2, w_abs_rel 0.1, completeness 1)"
    assert repr(cloud) == "CloudEvaluation(200 points, F-score 1.000 within 0.06 units of the truth)"
    run = RunEvaluation(score_capture(POSES, POSES), depth, cloud, {})
    assert repr(run).splitlines() == [
        "RunEvaluation(",
        "  poses: 3 of 3 images registered, median error of a pair 0°",
        f"  {depth!r}",
        f"  {cloud!r})",
    ]
    assert repr(RunEvaluation(None, None, cloud, {"poses": "no"})).endswith("\n  poses not compared: no)")


def test_a_table_is_readable_text() -> None:
    table = TextTable(("view", "MAE"), (("a", "0.1"), ("long", "2")), (("constant", "1"), ("constant", "9")))
    assert str(table).splitlines() == ["view      MAE", "a         0.1", "constant  1", "long      2", "constant  9"]


def test_zero_has_no_sign_in_tables() -> None:
    assert depth_tables._shown("psnr_db", {"psnr_db": -0.0}).count("-") == 0
    assert "0" in depth_tables._shown("psnr_db", {"psnr_db": -0.0})
