"""`pano-mvs inspect`: a pixel of a run, by the run's own settings, from what it stored."""

from __future__ import annotations

import json
import shlex
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.engine.cache.store import Store
from pano_mvs.geometry import ray_from_pixel
from pano_mvs.scene.image_file import decode_image, write_png
from pano_mvs.session.running import run_session as run_whole
from pano_mvs.testing.room import capture_poses, default_room
from tests.cli.conftest import Outcome
from tests.synthetic.capture_files import write_capture

# Any stage with a setting `truth` says where the truth is.
PLUGIN = '''\
from pano_mvs.api import All, InputPath, Params, RangeMap, Scores, stage


class TruthParams(Params):
    truth: InputPath


@stage("scores.none")
def none(ranges: All[RangeMap], params: TruthParams) -> Scores:
    """Compare nothing."""
    return Scores({}, {})
'''
WORKFLOW = """\
pano_mvs: 1
name: tuned
plugins: [scores.py]
stages:
  images:  {use: source.folder, path: capture/images, nadir_deg: 20}
  poses:   {use: poses.from_model, path: halved.json}
  views:   {use: views.nearest, sources: 2}
  depth:   {use: depth.sweep, planes: 24, near: 0.3, far: 4}
  boxed:   {use: depth.sweep, planes: 24, aggregation: box}
  checked: {use: filters.consistency, in: {range_map: depth, sources: depth}}
  scores:  {use: scores.none, truth: capture/truth, in: {ranges: checked}}
"""
SIZE_HW = (64, 128)


def call(*arguments: object) -> Outcome:
    result = CliRunner().invoke(app, [str(argument) for argument in arguments], env={"COLUMNS": "140"})
    return Outcome(result.exit_code, result.output)


def inspected(*arguments: object) -> dict[str, Any]:
    found = call("inspect", *arguments, "--json")
    assert found.code == 0, found.text
    result: dict[str, Any] = json.loads(found.text)
    return result


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inspected")
    write_capture(folder / "capture", default_room(), capture_poses(3, spread=0.4), size_hw=SIZE_HW)
    (folder / "scores.py").write_text(PLUGIN)
    (folder / "wf.yaml").write_text(WORKFLOW)
    poses = json.loads((folder / "capture" / "truth" / "poses.json").read_text())
    for view in poses["views"]:  # scene units of two metres
        view["t"] = [0.5 * length for length in view["t"]]
    (folder / "halved.json").write_text(json.dumps(poses))
    outcome = call("run", folder / "wf.yaml", "--out", folder / "out", "--cache", folder / "cache")
    assert outcome.code == 0, outcome.text
    return folder


@pytest.mark.parametrize("stage", ["depth", "boxed"])
@pytest.mark.parametrize(("x", "y"), [(0, 3), (64, 30), (127, 40), (20.9, 55.5)])
def test_the_curves_winner_is_what_the_stage_stored(run: Path, stage: str, x: float, y: float) -> None:
    found = inspected(run / "out", "001.png", x, y, "--stage", stage)
    stored = next(one for one in found["stages"] if one["stage"] == stage)
    assert found["curve"]["range"] == pytest.approx(stored["range"], rel=1e-6)
    assert found["curve"]["confidence"] == stored["confidence"]
    assert (found["curve"]["aggregated"] is None) == (stage == "boxed")
    assert found["notes"] == []


def test_a_truth_of_other_pictures_is_not_mentioned_unless_it_was_asked_for(run: Path) -> None:
    truth = run / "elsewhere"
    truth.mkdir()
    poses = (run / "capture" / "truth" / "poses.json").read_text()
    (truth / "poses.json").write_text(poses.replace("images/00", "images/other"))
    (run / "other.yaml").write_text(WORKFLOW.replace("capture/truth", "elsewhere"))
    found = inspected(run / "other.yaml", "000", 40, 28, "--cache", run / "cache")
    assert (found["true_range"], found["notes"]) == (None, [])
    found = inspected(run / "other.yaml", "000", 40, 28, "--cache", run / "cache", "--truth", truth)
    assert "has no range map of 000.png" in found["notes"][0]


def test_a_picture_of_the_same_name_is_not_compared_with_the_truth_of_another(run: Path) -> None:
    truth = run / "of_others"
    shutil.copytree(run / "capture" / "truth", truth)
    poses = json.loads((truth / "poses.json").read_text())
    for view in poses["views"]:
        view["sha256"] = "0" * 64
    (truth / "poses.json").write_text(json.dumps(poses))
    found = inspected(run / "wf.yaml", "000", 40, 28, "--cache", run / "cache", "--truth", truth)
    assert found["true_range"] is None
    assert found["notes"] == ["000.png is not the image that the truth in of_others belongs to"]


def test_rays_colours_neighbours_and_the_truth_are_those_of_the_capture(run: Path) -> None:
    found = inspected(run / "wf.yaml", "000", 40, 28, "--cache", run / "cache")
    ray = ray_from_pixel([40.5, 28.5], SIZE_HW)
    np.testing.assert_allclose(found["ray_in_cam"], ray, atol=1e-12)
    with np.load(run / "capture" / "truth" / "depth.npz") as truth:
        assert found["true_range"] == pytest.approx(0.5 * float(truth["000"][28, 40]), rel=1e-5)
    picture = decode_image(run / "capture" / "images" / "000.png")
    assert found["color_rgb"] == picture[28, 40].tolist()
    assert {one["name"] for one in found["sources"]} == {"001.png", "002.png"}
    point = np.array(found["center_in_world"]) + np.array(found["ray_in_world"]) * found["curve"]["range"]
    poses = {f"{idx:03}.png": pose for idx, pose in enumerate(capture_poses(3, spread=0.4))}
    for one in found["sources"]:
        seen = poses[one["name"]].apply(2 * point)
        expected = ray_from_pixel(one["pixel_px"], SIZE_HW) * np.linalg.norm(seen)
        np.testing.assert_allclose(expected, seen, atol=1e-6)
        here = decode_image(run / "capture" / "images" / one["name"])[int(one["pixel_px"][1]), int(one["pixel_px"][0])]
        assert one["color_rgb"] == here.tolist()


def test_a_run_in_which_an_image_failed_can_be_inspected(run: Path, tmp_path: Path) -> None:
    for name in ("wf.yaml", "scores.py", "halved.json"):
        shutil.copy(run / name, tmp_path)
    shutil.copytree(run / "capture", tmp_path / "capture")
    whole = (tmp_path / "capture" / "images" / "000.png").read_bytes()
    (tmp_path / "capture" / "images" / "half.png").write_bytes(whole[: len(whole) // 2])
    outcome = call("run", tmp_path / "wf.yaml", "--out", tmp_path / "out", "--cache", run / "cache")
    assert outcome.code == 3, outcome.text
    assert inspected(tmp_path / "out", "001", 40, 28) == inspected(run / "out", "001", 40, 28)


def test_other_settings_are_tried_without_a_run(run: Path) -> None:
    found = inspected(run / "out", "000.png", 40, 28, "--set", "depth.cost=zncc", "--set", "depth.planes=40")
    assert len(found["curve"]["ranges"]) == 40
    assert [one["stage"] for one in found["stages"]] == ["boxed"]
    assert "not in the cache" in found["notes"][0]
    assert found["curve"]["range"] == pytest.approx(found["true_range"], rel=0.15)


def test_a_masked_pixel_has_a_curve_and_no_range(run: Path) -> None:
    found = inspected(run / "out", "000.png", 40, 63)
    assert found["curve"]["range"] is None
    assert "masked" in found["notes"][0]
    assert found["color_rgb"] == decode_image(run / "capture" / "images" / "000.png")[63, 40].tolist()


def test_a_sweep_from_coarse_to_fine_says_that_it_tried_less(run: Path) -> None:
    found = inspected(run / "out", "000.png", 40, 28, "--set", "depth.levels=2")
    assert any("tests a few ranges around a guide" in note for note in found["notes"])


@pytest.mark.slow
def test_a_sweep_with_floors_says_that_it_compared_more(run: Path) -> None:
    levelled = "  levelled: {use: poses.level, evidence: cameras}\n  floors: {use: depth.floors}\n  views: "
    (run / "floors.yaml").write_text(WORKFLOW.replace("  views: ", levelled))
    outcome = call("run", run / "floors.yaml", "--out", run / "floors", "--cache", run / "cache")
    assert outcome.code == 0, outcome.text
    found = inspected(run / "floors", "000", 40, 28)
    assert "windows on known floors" in found["notes"][0]
    assert inspected(run / "floors", "000", 40, 28, "--stage", "boxed")["notes"] == []


def test_people_see_tables_a_plot_and_a_picture(run: Path, tmp_path: Path) -> None:
    plot = tmp_path / "plots" / "curve.png"
    outcome = call("inspect", run / "out", "000.png", 40, 28, "--plot", plot)
    assert outcome.code == 0, outcome.text
    for word in (
        "azimuth",
        "filters.consistency",
        "parallax",
        "after semi-global matching",
        "▲ winner",
        "off the truth",
    ):
        assert word in outcome.text
    picture = decode_image(plot)
    assert picture.shape[1] == 1040
    red = (picture.astype(int) - [200, 50, 50]).__abs__().sum(axis=-1) < 40
    assert red.any()  # the winner's mark


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("000.png", 500, 3), "there is no pixel (500, 3); x is 0 to 127"),
        (("000.png", "nan", 3), "(nan, 3.0) is not a pixel"),
        (("000.png", 5, "inf"), "(5.0, inf) is not a pixel"),
        (("0", 5, 3), "3 images match '0'"),
        (("lobby.jpg", 5, 3), "no images match 'lobby.jpg'; there are: 000.png"),
        (("000.png", 5, 3, "--stage", "checked"), "which has: depth, boxed"),
        (("000.png", 5, 3, "--plot", "curve.pdf"), "the plot is a PNG"),
        (("000.png", 5, 3, "--set", "images.nadir_deg=30"), "run the workflow with these settings first"),
    ],
)
def test_mistakes_are_told_with_a_remedy(run: Path, arguments: tuple[object, ...], message: str) -> None:
    outcome = call("inspect", run / "out", *arguments)
    assert outcome.code == 2
    assert message.casefold() in outcome.flat.casefold()


def test_the_command_that_mends_it_can_be_copied(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It once left out --images and --set, so that it computed something else, and was not quoted."""
    shutil.copytree(run / "capture" / "images", tmp_path / "it's: a #new" / "hall")
    monkeypatch.chdir(tmp_path)
    arguments = (
        "000.png",
        40,
        28,
        "--images",
        "it's: a #new/hall",
        "--set",
        "images.nadir_deg=33",
        "--cache",
        "a b",
        "--set",
        "depth.planes=9",
    )
    mistake = call("inspect", run / "wf.yaml", *arguments)
    assert mistake.code == 2
    program, *command = shlex.split(mistake.text[mistake.text.index("pano-mvs run") :])
    assert program == "pano-mvs"
    outcome = call(*command)
    assert outcome.code == 0, outcome.text
    assert len(inspected(run / "wf.yaml", *arguments)["curve"]["ranges"]) == 9


def test_folders_that_are_no_output_are_refused(run: Path, tmp_path: Path) -> None:
    outcome = call("inspect", tmp_path, "000.png", 1, 1)
    assert outcome.code == 2
    assert "run.json cannot be read" in outcome.flat
    moved = shutil.copytree(run / "out", tmp_path / "out")
    summary = json.loads((moved / "run.json").read_text())
    summary["workflow"]["path"] = "/nowhere/wf.yaml"
    (moved / "run.json").write_text(json.dumps(summary))
    assert "its workflow /nowhere/wf.yaml is missing" in call("inspect", moved, "000.png", 1, 1).flat


def test_the_pictures_of_the_run_are_found_from_anywhere(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`--images` relative to where the run was started is not relative to where it is inspected."""
    shutil.copytree(run / "capture", tmp_path / "here" / "capture")
    picture = tmp_path / "here" / "capture" / "images" / "000.png"
    write_png(picture, decode_image(picture)[::-1].copy())
    monkeypatch.chdir(tmp_path / "here")
    outcome = call("run", run / "wf.yaml", "--images", "capture/images", "--out", "out", "--until", "depth")
    assert outcome.code == 0, outcome.text
    monkeypatch.chdir(tmp_path)
    found = inspected("here/out", "000.png", 40, 28)
    assert found["color_rgb"] == decode_image(picture)[28, 40].tolist()


def test_a_workflow_without_a_sweep_is_told(tmp_path: Path, run: Path) -> None:
    text = (
        WORKFLOW.replace("capture/", f"{run}/capture/")
        .replace("halved", f"{run}/halved")
        .replace("scores.py", f"{run}/scores.py")
        .split("  depth:")[0]
    )
    (tmp_path / "none.yaml").write_text(text)
    assert "no depth.sweep" in call("inspect", tmp_path / "none.yaml", "000.png", 1, 1).flat


@pytest.mark.slow
def test_a_dropped_result_is_computed_again_for_its_pixel(run: Path, tmp_path: Path) -> None:
    text = WORKFLOW.replace(
        "sources: depth}}",
        "sources: depth}, temporary: true}\n  smooth:  {use: filters.median, in: {range_map: checked}}",
    )
    (run / "temporary.yaml").write_text(text.replace("{ranges: checked}", "{ranges: smooth}"))
    options = ("--out", tmp_path / "out", "--cache", tmp_path / "cache")
    assert call("run", run / "temporary.yaml", *options, "--executor", "serial").code == 0
    store = Store(tmp_path / "cache")
    keys = next(store.runs.each()).keys["checked"]

    def is_dropped(image: str) -> bool:
        return store.find(keys[image]) is None and store.find(keys[image], or_dropped=True) is not None

    assert is_dropped("000.png")
    found = call("inspect", tmp_path / "out", "000", 40, 28)
    assert found.code == 0, found.text
    assert "computing again what was dropped: checked:000.png" in found.flat
    assert (is_dropped("000.png"), is_dropped("001.png")) == (False, True)
    again = call("inspect", tmp_path / "out", "000", 40, 28)
    assert "computing again" not in again.text
    kept = inspected(run / "wf.yaml", "000", 40, 28, "--cache", run / "cache")
    here = inspected(tmp_path / "out", "000", 40, 28)
    ranges = [{one["stage"]: one["range"] for one in view["stages"]} for view in (kept, here)]
    assert ranges[0]["checked"] == ranges[1]["checked"]
    assert "smooth" in ranges[1]
    assert len(list(store.runs.each())) == 1, "only that of the run itself is remembered"
    assert call("run", run / "temporary.yaml", *options, "--executor", "serial").code == 0
    assert is_dropped("000.png")


@pytest.mark.slow
def test_an_interrupted_inspection_is_not_remembered_as_a_run(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    text = WORKFLOW.replace(
        "sources: depth}}",
        "sources: depth}, temporary: true}\n  smooth:  {use: filters.median, in: {range_map: checked}}",
    )
    (run / "interrupted.yaml").write_text(text.replace("{ranges: checked}", "{ranges: smooth}"))
    options = ("--out", tmp_path / "out", "--cache", tmp_path / "cache")
    assert call("run", run / "interrupted.yaml", *options, "--executor", "serial").code == 0

    def run_session(*arguments: Any, **others: Any) -> None:
        run_whole(*arguments, **others)
        raise KeyboardInterrupt

    monkeypatch.setattr("pano_mvs.cli.inspect_command.run_session", run_session)
    assert call("inspect", tmp_path / "out", "000", 40, 28).code != 0
    assert len(list(Store(tmp_path / "cache").runs.each())) == 1
