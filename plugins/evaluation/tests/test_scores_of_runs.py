"""Scores within a run, and of a finished one."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.cli.conftest import Command, run_json
from tests.cli.test_compare_sweeps import ALIKE, SAD, write_both
from tests.report.html_page import Page


def test_quickstart_tells_the_accuracy_and_where_the_results_are(quickstart: tuple[Path, str]) -> None:
    out, text = quickstart
    assert "against the ground truth" in text
    assert "PSNR" in text
    assert str(out) in "".join(text.split())


def test_the_report_compares_with_the_truth(quickstart: tuple[Path, str]) -> None:
    page = Page((quickstart[0] / "report.html").read_text(encoding="utf-8"))
    assert "Comparison with ground truth" in page.words


def test_quickstart_recovers_poses_and_ranges(quickstart: tuple[Path, str]) -> None:
    scores = run_json(quickstart[0])["scores"]
    assert scores["poses"]["registered"] == 4
    assert scores["poses"]["median_pair_error_deg"] < 0.3
    assert scores["poses"]["scale_ratio_error_max"] < 0.03
    for view in scores["views"].values():
        assert view["psnr_db"] > view["constant_psnr_db"] + 6
        assert view["w_delta_105"] > 0.6
        assert view["completeness"] > 0.95


@pytest.mark.slow
def test_evaluate_compares_an_output_folder_with_the_truth(
    quickstart: tuple[Path, str], rendered: Path, pano_mvs: Command
) -> None:
    result = pano_mvs("evaluate", quickstart[0], "--truth", rendered / "truth")
    assert result.code == 0, result.text
    psnr = run_json(quickstart[0])["scores"]["views"]["000.png"]["psnr_db"]
    assert f"{psnr:.2f}" in result.text
    nothing = pano_mvs("evaluate", rendered, "--truth", rendered / "truth")
    assert nothing.code == 2
    assert "Give the output folder of a finished run" in nothing.flat


@pytest.mark.slow
def test_two_sweeps_have_scores_of_their_own(pano_mvs: Command, rendered: Path) -> None:
    write_both(rendered / "truth")
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
