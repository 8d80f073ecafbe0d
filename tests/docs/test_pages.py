"""What pages of the documentation show works as it stands: workflows, plugins, settings and defaults.

tests/cli/workflows/test_frame.py runs the workflow of frames_and_scale.md.
"""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from pano_mvs.cli.app import app
from pano_mvs.engine.stages.registry import Registry
from pano_mvs.io.images.captures import PICTURE_SUFFIXES, VIDEO_SUFFIXES
from pano_mvs.io.ply import read_ply
from pano_mvs.io.ranges import read_range_tiff
from pano_mvs.io.rig_calibration import MODELS, read_rig
from pano_mvs.scene import FilePart
from pano_mvs.stages.poses_frame import ScaleParams
from pano_mvs.testing.conformance import stage_contract_tests
from pano_mvs.testing.room import capture_poses, default_room
from tests.cli.conftest import Command, run_json
from tests.docs.pages import ROOT, block, copy_plugin, text_of
from tests.stored import read_picture
from tests.synthetic.capture_files import write_capture
from tests.synthetic.video_files import write_video

LevelParams = Registry.installed().stages["poses.level"].params_type

INPUT, RIGS = text_of("input.md"), text_of("rigs.md")


@pytest.mark.slow
def test_plugin_and_workflow_of_the_readme_run_as_they_stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_capture(tmp_path / "room", default_room(), capture_poses(3, spread=0.4), size_hw=(128, 256))
    (tmp_path / "room" / "images").rename(tmp_path / "photos")
    (tmp_path / "far_cut.py").write_text(block("README.md", "plugin"))
    (tmp_path / "mine.yaml").write_text(block("README.md", "workflow"))
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["run", "mine.yaml", "--set", "depth.planes=16", "--set", "near.far=8"])
    assert result.exit_code == 0, result.output
    for path in sorted((tmp_path / "out" / "mine" / "range").iterdir()):
        ranges = read_picture(path, cv2.IMREAD_UNCHANGED)
        assert ranges[ranges == ranges].max() <= 8


def test_quickstart_command_names_a_workflow_that_is_there() -> None:
    workflow = re.search(r"pano-mvs run (\S+)", block("README.md", "command: run"))
    assert workflow
    assert (ROOT / workflow.group(1)).is_file()


@pytest.mark.parametrize("line", block("frames_and_scale.md", "variants").splitlines())
def test_every_way_to_metres_is_accepted(tmp_path: Path, line: str) -> None:
    (tmp_path / "photos").mkdir()
    (tmp_path / "survey.csv").touch()
    text, count = re.subn(r"  metres: .*", lambda _: f"  {line}", block("frames_and_scale.md", "workflow"))
    assert count == 1
    (tmp_path / "mine.yaml").write_text(text)
    result = CliRunner().invoke(app, ["check", str(tmp_path / "mine.yaml")])
    assert result.exit_code == 0, result.output


def test_every_choice_of_evidence_is_explained() -> None:
    text = text_of("frames_and_scale.md")
    choices = LevelParams.model_json_schema()["properties"]["evidence"]["enum"]
    assert all(f"| `{choice}` |" in text for choice in choices if choice != "auto")
    assert all(f"`{name}" in text for name in ScaleParams.model_fields)


def test_the_workflow_for_a_video_runs(pano_mvs: Command) -> None:
    Path("mine.yaml").write_text(block("input.md", "workflow").replace("walk.mp4", "walk.avi"))
    write_video(Path("walk.avi"), 60)
    result = pano_mvs("run", "mine.yaml", "--until", "pairs", "--out", "out")
    assert result.code == 0, result.text
    assert run_json(Path("out"))["stages"][0]["run"] == 3


@pytest.mark.slow
@pytest.mark.parametrize(("preset", "last"), [("quickstart", "pairs"), ("walk", "masked")])
def test_the_commands_for_a_folder_of_videos_run(preset: str, last: str, pano_mvs: Command) -> None:
    (line,) = [line for line in INPUT.splitlines() if line.startswith(f"pano-mvs run {preset}")]
    Path("videos").mkdir()
    write_video(Path("videos/walk.avi"), 60)
    result = pano_mvs(*line.split()[1:], "--set", "images.max_s=1", "--until", last, "--out", "out")
    assert result.code == 0, result.text


def test_all_settings_and_kinds_are_told() -> None:
    assert all(f"`{name}`" in INPUT for name in Registry.installed().stages["source.video"].params_type.model_fields)
    assert all(f"`{suffix.lstrip('.')}`" in INPUT for suffix in VIDEO_SUFFIXES)
    told = INPUT.lower()
    assert all(suffix.lstrip(".").replace("jpg", "jpeg").replace("heif", "heic") in told for suffix in PICTURE_SUFFIXES)


def test_all_extras_are_told() -> None:
    project = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    section = project.partition("[project.optional-dependencies]")[2].partition("\n[")[0]
    extras = re.findall(r"^(\w+) = \[", section, re.MULTILINE)
    assert len(extras) >= 4
    assert all(f"'pano-mvs[{extra}]'" in text_of("installation.md") for extra in extras)


def test_the_calibration_file_of_the_page_can_be_read(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text(block("rigs.md", "calibration"), encoding="utf-8")
    rig = read_rig(FilePart(tmp_path / "rig.yaml"), stitch_distance_m=3.0)
    assert rig.names == ("front", "back")
    assert 2 * rig.lens_offset_m == pytest.approx(np.linalg.norm((0.0004, -0.0002, -0.0291)))
    assert rig.lens_of_bearings([(0, 0, 1), (0, 0, -1)]).tolist() == [0, 1]
    assert all(model in RIGS for model in MODELS)


def test_defaults_on_the_page_are_those_of_the_stage() -> None:
    defaults = (
        Registry.installed().stages["source.dual_fisheye"].params_type.model_validate({"path": "photos"}).model_dump()
    )
    assert f"`stitch_distance_m` ({defaults['stitch_distance_m']:g} by default" in RIGS
    assert f"`blend_deg` ({defaults['blend_deg']:g})" in RIGS


def test_the_mask_on_the_page_keeps_the_contract(tmp_path: Path) -> None:
    for contract_test in stage_contract_tests(copy_plugin("masks.md", tmp_path)):
        contract_test.check()


@pytest.mark.slow
def test_nothing_of_a_bearer_is_left_in_any_output(pano_mvs: Command, capture: Path, tmp_path: Path) -> None:
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
    workflow = copy_plugin("masks.md", tmp_path).with_name("masked.yaml")
    text = block("masks.md", "workflow")
    workflow.write_text(text.replace("photos", str(capture / "images")), encoding="utf-8")
    result = pano_mvs(
        *("run", workflow, "--out", "out", "--set", "depth.planes=32", "--set", "features.max_keypoints=1500"),
        *("--set", "views.sources=2"),
    )
    assert result.code == 0, result.text
    for path in sorted(Path("out/range").iterdir()):
        ranges = read_range_tiff(path)
        assert np.isnan(ranges[bearer]).all()
        assert np.isfinite(ranges[~bearer]).mean() > 0.7
    colors = read_ply(Path("out/cloud.ply")).colors_rgb.astype(np.int64)
    assert len(colors) > 1000
    assert not ((colors[:, 0] > 170) & (colors[:, 2] < 40)).any()
