"""`evaluate depth` on folders of ranges and on what a run leaves, and `evaluate run` on parts of that."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pano_mvs_evaluation.clouds.true_surface import TrueView, view_points
from pano_mvs_evaluation.ranges.view_scores import score_view

from pano_mvs.geometry import Rigid3
from pano_mvs.io.colmap.writer import write_colmap_model
from pano_mvs.io.ply import write_ply
from pano_mvs.io.ranges import write_confidence_png, write_range_tiff
from pano_mvs.io.truth import read_truth
from pano_mvs.scene import PointCloud, Poses
from tests.cli.conftest import SIZE_HW, Command, Outcome
from tests.stored import read_picture, write_npz

SCALE = 2.5


@pytest.fixture(scope="module")
def truth(rendered: Path) -> Path:
    return rendered / "truth"


@pytest.fixture
def output(tmp_path: Path, truth: Path) -> Path:
    """What a run leaves: ranges with a known error in units 2.5 times the truth's, confidences, poses."""
    known = read_truth(truth)
    folder = tmp_path / "out"
    for name in ("range", "confidence", "colmap/sparse/0"):
        (folder / name).mkdir(parents=True)
    for name, view in list(known.views.items())[:3]:
        ranges = known.range_map(view)
        assert ranges is not None
        stem, wrong = Path(name).stem, ranges * np.float32(1.1 / SCALE)
        wrong[:20] = np.nan
        write_range_tiff(folder / "range" / f"{stem}.tiff", wrong)
        confidence = np.where(np.arange(SIZE_HW[1]) < SIZE_HW[1] // 2, 200, 90) * np.isfinite(wrong)
        write_confidence_png(folder / "confidence" / f"{stem}.png", confidence.astype(np.uint8))
    poses = {Path(name).name: Rigid3(pose.rotation, pose.translation / SCALE) for name, pose in known.poses.items()}
    model = Poses.without_points(poses, frame="of the test", scale="of the test", metric=False)
    write_colmap_model(folder / "colmap/sparse/0", model, dict.fromkeys(poses, SIZE_HW))
    return folder


def told(outcome: Outcome) -> dict[str, Any]:
    assert outcome.code == 0, outcome.text
    scores: dict[str, Any] = json.loads(outcome.text)
    return scores


def test_scores_are_those_of_the_library_with_the_scale_of_the_cameras(
    pano_mvs: Command, output: Path, truth: Path
) -> None:
    report = told(pano_mvs("evaluate", "depth", output, "--truth", truth, "--json"))
    assert report["scale"] == pytest.approx(SCALE)
    assert "centres of 4 cameras" in report["scale_reason"]
    assert list(report["views"]) == ["000", "001", "002"]
    assert report["without_estimate"] == ["images/003.png"]
    known = read_truth(truth)
    true = known.range_map(known.views["images/001.png"])
    assert true is not None
    wrong = (true * np.float32(1.1)).astype(np.float64)
    wrong[:20] = np.nan
    expected = score_view(wrong, true)
    found = report["views"]["001"]
    assert found["scores"]["w_mae"] == pytest.approx(expected.scores["w_mae"], rel=1e-5)
    assert found["scores"]["valid_abs_rel"] == pytest.approx(0.1, rel=1e-5)
    assert found["constant"]["best"]["psnr_db"] == pytest.approx(expected.constants["best"]["psnr_db"], rel=1e-5)
    # the error is the same everywhere: no confidence could rank it
    assert found["scores"]["ause"] == pytest.approx(0, abs=1e-6)
    for prefix in ("", "w_", "valid_", "valid_w_"):
        assert set(found["constant"]) == {"best", "median", "mean"}
        assert found["constant"]["best"][f"{prefix}mae"] <= found["constant"]["median"][f"{prefix}mae"]
    views = [view["scores"]["psnr_db"] for view in report["views"].values()]
    assert report["mean"]["psnr_db"] == pytest.approx(np.mean(views))


def test_the_table_tells_how_it_was_judged_and_what_constants_score(
    pano_mvs: Command, output: Path, truth: Path
) -> None:
    plain = pano_mvs("evaluate", "depth", output, "--truth", truth)
    assert plain.code == 0
    assert "estimates × 2.5: from the centres of 4 cameras" in plain.flat
    assert "ranges are not fitted to the ground truth (--align none)" in plain.flat
    assert plain.text.count("constant") >= 4
    assert "no estimate of images/003.png" in plain.flat
    fitted = pano_mvs("evaluate", "depth", output, "--truth", truth, "--align", "median", "--baseline", "mean")
    assert "RANGES ARE FITTED TO THE GROUND TRUTH" in fitted.flat
    assert "0.90909 to 0.90909" in fitted.flat
    assert "the mean of the view's true ranges" in fitted.flat


@pytest.mark.slow
def test_pictures_json_and_csv_are_written(pano_mvs: Command, output: Path, truth: Path, tmp_path: Path) -> None:
    arguments = (
        "--truth",
        truth,
        "--out",
        tmp_path / "e",
        "--csv",
        tmp_path / "new" / "s.csv",
        "--bad",
        "2%",
        "--bad",
        "0.3",
    )
    result = pano_mvs("evaluate", "depth", output, *arguments)
    assert result.code == 0, result.text
    names = ["000.jpg", "001.jpg", "002.jpg", "scores.csv", "scores.json"]
    assert sorted(path.name for path in (tmp_path / "e").iterdir()) == names
    scores = json.loads((tmp_path / "e" / "scores.json").read_text())
    rows = list(csv.DictReader((tmp_path / "new" / "s.csv").read_text().splitlines()))
    assert [row["view"] for row in rows] == ["000", "001", "002", "mean"]
    for name in ("psnr_db", "bad_2", "valid_w_bad_abs_0.3", "plain_ause"):
        assert float(rows[1][name]) == scores["views"]["001"]["scores"][name]
        assert float(rows[3][f"best_constant_{name}"]) == scores["mean_constant"]["best"][name]
    # 10 % too far: red, missing above: black; the panorama was found beside the truth
    picture = read_picture(tmp_path / "e" / "000.jpg")
    errors = picture[:600, 1024:].astype(int)
    red, black = (np.abs(errors - color).max(axis=-1) < 25 for color in ((18, 18, 116), (25, 25, 25)))
    assert red.mean() > 0.3
    assert 0.02 < black.mean() < 0.3
    assert np.nonzero(black)[0].mean() < np.nonzero(red)[0].mean() - 100
    assert picture[60:560, 60:960].std() > 20


@pytest.mark.slow
def test_foreign_folders_are_compared_in_their_units(pano_mvs: Command, truth: Path, tmp_path: Path) -> None:
    """Millimetres in 16-bit PNG against an archive of arrays at twice the size, no poses anywhere."""
    known = read_truth(truth)
    (tmp_path / "png").mkdir()
    arrays = {}
    for name, view in known.views.items():
        ranges = known.range_map(view)
        assert ranges is not None
        arrays[Path(name).stem] = ranges
        half = ranges[::2, ::2]
        cv2.imwrite(
            str(tmp_path / "png" / f"{Path(name).stem}.png"), np.nan_to_num(1000 * half).round().astype(np.uint16)
        )
    write_npz(tmp_path / "true.npz", arrays)
    arguments = ("evaluate", "depth", tmp_path / "png", "--truth", tmp_path / "true.npz")
    report = told(pano_mvs(*arguments, "--unit", "0.001", "--json"))
    assert report["scale"] == 1
    assert "the same unit" in report["scale_reason"]
    assert report["mean"]["w_delta_105"] > 0.8
    text = pano_mvs(*arguments, "--unit", "0.001").flat
    assert f"{SIZE_HW[1] // 2}×{SIZE_HW[0] // 2}, their truth {SIZE_HW[1]}×{SIZE_HW[0]}" in text
    scaled = told(pano_mvs(*arguments, "--scale", "0.001", "--json"))
    assert scaled["mean"]["mae"] == pytest.approx(report["mean"]["mae"], rel=1e-4)


def test_of_many_views_the_worst_are_listed(pano_mvs: Command, tmp_path: Path) -> None:
    true = {f"v{idx:02d}": np.full((4, 8), 2, np.float32) for idx in range(43)}
    wrong = {name: np.where(np.arange(8) < idx % 5, 9, ranges) for idx, (name, ranges) in enumerate(true.items())}
    write_npz(tmp_path / "true.npz", true)
    write_npz(tmp_path / "found.npz", wrong)
    text = pano_mvs("evaluate", "depth", tmp_path / "found.npz", "--truth", tmp_path / "true.npz").text
    assert "the 40 of 43 views with the worst δ<1.05" in text
    assert "v42" in text
    assert "v40" not in text  # one of nine without an error


def test_views_without_a_true_range_are_told_and_none_at_all_is_refused(pano_mvs: Command, tmp_path: Path) -> None:
    """They counted as views of the mean, and a truth of nothing but NaN gave a table of dashes and exit code 0."""
    known, nothing = np.full((8, 16), 2, np.float32), np.full((8, 16), np.nan, np.float32)
    np.savez(tmp_path / "found.npz", a=known, b=known, c=known)
    np.savez(tmp_path / "true.npz", a=known, b=nothing, c=known)
    outcome = pano_mvs("evaluate", "depth", tmp_path / "found.npz", "--truth", tmp_path / "true.npz")
    assert outcome.code == 0
    assert "mean of 2" in outcome.flat
    assert "no true range that counts in b: not in the scores" in outcome.flat
    np.savez(tmp_path / "true.npz", a=nothing, b=nothing, c=0 * known)
    outcome = pano_mvs("evaluate", "depth", tmp_path / "found.npz", "--truth", tmp_path / "true.npz")
    assert (outcome.code, "no pixel of any view has a true range that counts" in outcome.flat) == (2, True)


@pytest.mark.slow
def test_masks_and_confidence_leave_out_what_they_say(
    pano_mvs: Command, output: Path, truth: Path, tmp_path: Path
) -> None:
    counted = np.zeros(SIZE_HW, np.uint8)
    counted[60:100, 40:80] = 255
    (tmp_path / "masks").mkdir()
    cv2.imwrite(str(tmp_path / "masks" / "000.png"), 255 - counted)  # of 000.png.png, which is looked for first
    cv2.imwrite(str(tmp_path / "masks" / "000.png.png"), counted)
    cv2.imwrite(str(tmp_path / "masks" / "001.png"), counted)
    report = told(pano_mvs("evaluate", "depth", output, "--truth", truth, "--masks", tmp_path / "masks", "--json"))
    assert [view["pixels"] for view in report["views"].values()][:2] == [1600, 1600]
    assert report["views"]["002"]["pixels"] > 40_000
    assert report["without_mask"] == ["002"]
    noted = pano_mvs("evaluate", "depth", output, "--truth", truth, "--masks", tmp_path / "masks")
    assert "no mask in --masks for 1 of 3 views, 002 first" in noted.flat
    cv2.imwrite(str(tmp_path / "masks" / "002.JPG.png"), counted)
    named = told(pano_mvs("evaluate", "depth", output, "--truth", truth, "--masks", tmp_path / "masks", "--json"))
    assert named["without_mask"] == []
    assert named["views"]["002"]["pixels"] == 1600  # as cameras write names: it was not found
    half = cv2.resize(counted, (SIZE_HW[1] // 2, SIZE_HW[0] // 2), interpolation=cv2.INTER_NEAREST)
    cv2.imwrite(str(tmp_path / "one.png"), half)
    alone = told(pano_mvs("evaluate", "depth", output, "--truth", truth, "--mask", tmp_path / "one.png", "--json"))
    assert {view["pixels"] for view in alone["views"].values()} == {1600}
    sure = pano_mvs("evaluate", "depth", output, "--truth", truth, "--min-confidence", "128", "--json")
    every = told(pano_mvs("evaluate", "depth", output, "--truth", truth, "--json"))
    assert told(sure)["mean"]["completeness"] == pytest.approx(every["mean"]["completeness"] / 2, rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--min-confidence", "128"), "so a minimum confidence cannot apply"),
        (("--scale", "big"), "'big' is not a scale"),
        (("--bad", "often"), "not a limit for bad pixels"),
        (("--unit", "0"), "unit must be a positive number"),
        (("--peak", "0"), "peak must be a positive length"),
        (("--masks", "none"), "masks must be a folder"),
        (("--masks", "."), "no mask in it belongs to an image"),
        (("--poses", "none.json"), "none.json: no such file"),
        (("--images", "none"), None),
    ],
)
def test_what_cannot_be_done_is_named(
    pano_mvs: Command, output: Path, truth: Path, arguments: tuple[str, str], words: str | None
) -> None:
    shutil.rmtree(output / "confidence")
    result = pano_mvs("evaluate", "depth", output, "--truth", truth, *arguments)
    if words is None:  # only pictures need them
        assert result.code == 0
        result = pano_mvs("evaluate", "depth", output, "--truth", truth, *arguments, "--out", "x")
        words = "no such folder"
    assert (result.code, words in result.flat) == (2, True), result.text


def test_strangers_are_named_with_what_either_has(pano_mvs: Command, output: Path, tmp_path: Path) -> None:
    np.savez(tmp_path / "other.npz", zebra=np.ones((4, 8), np.float32))
    result = pano_mvs("evaluate", "depth", output, "--truth", tmp_path / "other.npz")
    assert result.code == 2
    assert "no image in common: the first has 000, 001, 002, the other zebra" in result.flat
    write_npz(tmp_path / "shape.npz", {"001": np.ones((30, 50), np.float32)})
    result = pano_mvs("evaluate", "depth", output, "--truth", tmp_path / "shape.npz")
    assert result.code == 2
    assert "001.tiff against" in result.flat
    assert "must be full panoramas" in result.flat


class TestRun:
    """`evaluate run` once demanded a COLMAP model, and said nothing of ranges without it."""

    def test_all_that_is_there(self, pano_mvs: Command, output: Path, truth: Path) -> None:
        result = pano_mvs("evaluate", output, "--truth", truth)
        assert result.code == 0, result.text
        assert "4 of 4 registered" in result.flat
        assert "3 views of" in result.flat
        assert "cloud: not compared, there is no cloud.ply" in result.flat

    @pytest.mark.slow
    def test_a_cloud_too(self, pano_mvs: Command, output: Path, truth: Path) -> None:
        known = read_truth(truth)
        views = [(view.cam_from_world, known.range_map(view)) for view in known.views.values()]
        points = np.concatenate([view_points(TrueView(pose, ranges)) for pose, ranges in views if ranges is not None])
        points /= SCALE  # the frame and the unit of the model
        up = np.tile(np.array([0, -1, 0], np.float32), (len(points), 1))
        grey = np.full((len(points), 3), 99, np.uint8)
        write_ply(output / "cloud.ply", PointCloud(points, up, grey, np.ones(len(points), np.uint8)))
        result = pano_mvs("evaluate", output, "--truth", truth)
        assert result.code == 0, result.text
        assert "not compared" not in result.flat
        assert f"{len(points)} points against the surface that 4 views see" in result.flat
        assert "100.00" in result.text

    def test_ranges_alone(self, pano_mvs: Command, output: Path, truth: Path) -> None:
        shutil.rmtree(output / "colmap")
        result = pano_mvs("evaluate", "run", output, "--truth", truth)
        assert result.code == 0, result.text
        assert "poses: not compared, there is no colmap/sparse/0" in result.flat
        assert "PSNR" in result.text
        assert "both are assumed to have the same unit" in result.flat

    def test_poses_alone(self, pano_mvs: Command, output: Path, truth: Path, tmp_path: Path) -> None:
        shutil.rmtree(output / "range")
        result = pano_mvs("evaluate", "run", output, "--truth", truth)
        assert result.code == 0, result.text
        assert "4 of 4 registered" in result.flat
        assert "ranges: not compared, there is no folder range" in result.flat

    def test_nothing_to_compare_is_an_error_that_says_what_is_missing(
        self, pano_mvs: Command, output: Path, tmp_path: Path
    ) -> None:
        np.savez(tmp_path / "other.npz", zebra=np.ones((4, 8), np.float32))
        result = pano_mvs("evaluate", "run", output, "--truth", tmp_path / "other.npz")
        assert result.code == 2
        for words in ("the truth has no poses", "knows none of their images", "there is no cloud.ply"):
            assert words in result.flat
