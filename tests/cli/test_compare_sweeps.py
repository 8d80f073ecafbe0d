"""Two branches in one workflow: each with its files and its scores, the first one as if it were alone."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import Command, run_json
from tests.cli.workflows.test_workflows import known

SAD = ("--set", "depth_sad.planes=32")
ALIKE = ("--set", "depth.near=0.4", "--set", "depth.far=6", "--set", "depth_sad.near=0.4", "--set", "depth_sad.far=6")
KNOWN = "pano_mvs: 1\nname: both\nextends: [compare_sweeps, fixed.yaml]\n"
FIXED = """\
pano_mvs: 1
stages:
  pairs: {in: {poses: poses}}
  weak: null
  learned: null
  likely: null
  rematched: null
  merged: null
  refined: null
  levelled: null
  verified: {correct: false, in: {poses: points}}
  poses: {use: poses.from_model, path: TRUTH/poses.json}
  points: {use: poses.triangulate, in: {poses: poses}}
  scores: {truth: TRUTH}
  scores_sad: {truth: TRUTH}
"""


@pytest.mark.slow
def test_two_sweeps_side_by_side(pano_mvs: Command, rendered: Path) -> None:
    truth = str(rendered / "truth")
    Path("fixed.yaml").write_text(FIXED.replace("TRUTH", truth), encoding="utf-8")
    Path("both.yaml").write_text(KNOWN, encoding="utf-8")
    arguments = (
        *f"--images {rendered / 'images'} --cache cache --set depth.planes=32".split(),
        *["--set", "features.max_keypoints=1500"],
        *ALIKE,
    )
    result = pano_mvs("run", "both.yaml", *arguments, *SAD, "--out", "both")
    assert result.code == 0, result.text
    assert "median over views" in result.text
    assert "scores_sad" in result.text

    summary = run_json(Path("both"))
    assert set(summary["all_scores"]) == {"scores", "scores_sad"}
    assert summary["scores"] == summary["all_scores"]["scores"]
    ours, papers = (summary["all_scores"][name]["views"] for name in ("scores", "scores_sad"))
    assert set(ours) == set(papers) == {f"00{number}.png" for number in range(4)}
    assert ours != papers
    assert all(view["w_delta_105"] > 0.5 for view in ours.values())
    files = {path.relative_to("both").as_posix() for path in Path("both").rglob("*.*") if path.is_file()}
    assert {"cloud.ply", "range/000.tiff", "preview/000.jpg"} <= files
    assert {"sad/cloud.ply", "sad/range/000.tiff", "sad/confidence/000.png", "sad/preview/000.jpg"} <= files
    assert summary["views"][0]["preview"] == "preview/000.jpg"

    known_poses = pano_mvs("run", "known_poses", *known(rendered), *ALIKE[:4], *["--cache", "cache", "--out", "alone"])
    assert known_poses.code == 0, known_poses.text
    alone = {stage["name"]: stage["run"] for stage in run_json(Path("alone"))["stages"]}
    assert alone == dict.fromkeys(alone, 0), "the same stages have the same keys, whatever is beside them"


def test_without_in_a_second_branch_is_ambiguous_and_the_message_says_what_to_write(pano_mvs: Command) -> None:
    Path("two.yaml").write_text(
        "pano_mvs: 1\nextends: quickstart\nstages:\n  other: {use: depth.sweep}\n  median: {use: filters.median}\n"
    )
    result = pano_mvs("check", "two.yaml")
    assert result.code == 2
    assert "two.yaml:5:17: stage 'median': port range_map: Each[RangeMap] could be fed by" in result.flat
    assert "smooth, planes, other; choose with `in: {range_map: …}`" in result.flat
