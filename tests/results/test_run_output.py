"""run.json, and the output of a run as Python objects."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from pydantic import ValidationError

from pano_mvs.core.errors import InputError
from pano_mvs.geometry import Rigid3
from pano_mvs.io.ranges import write_confidence_png, write_range_tiff
from pano_mvs.results.records import PairLink, PosesSummary, Verdict
from pano_mvs.results.run_output import RunOutput, load
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.testing.tiny_capture import TinyCapture
from tests.report.conftest import summary_of
from tests.report.test_report import SUMMARY
from tests.synthetic.viewed_scenes import box_cloud, write_output


@pytest.fixture
def run(tmp_path: Path, tiny: TinyCapture, results: StoredValues) -> RunOutput:
    return RunOutput(tmp_path / "out", RunSummary.from_json(summary_of(tiny)), results)


def test_values_come_from_the_cache(run: RunOutput, tiny: TinyCapture) -> None:
    name = tiny.names[1]
    view = run.views[name]
    assert list(run.views) == list(tiny.names)
    assert len(run.views) == 4
    assert view.range_map is not None
    assert view.range_map.shape == (32, 64)
    assert view.confidence is not None
    assert np.array_equal(view.confidence > 0, np.isfinite(view.range_map))
    assert view.image is not None
    assert view.image.shape == (32, 64, 3)
    assert view.summary.consistent == 0.5
    assert view.preview is None
    assert run.poses is not None
    assert view.cam_from_world is not None
    assert view.cam_from_world.translation == pytest.approx(run.poses.translations[1])
    assert run.cloud is not None
    assert len(run.cloud) == 240
    with pytest.raises(KeyError, match=r"nothing\.png"):
        run.views["nothing.png"]


def test_a_notebook_shows_the_verdict_pictures_and_stages(run: RunOutput) -> None:
    text = run._repr_html_()
    assert run.verdict.judgement in text
    assert text.count("data:image/jpeg;base64,") == 2 * len(run.views)
    assert "depth.sweep" in text
    assert "http" not in text
    assert repr(run).startswith("RunOutput(")
    assert repr(run.views) == "<4 views: 000.png, 001.png, 002.png, …>"


def test_a_notebook_shows_names_as_text() -> None:
    evil = "<script>"
    summary = RunSummary.from_json(
        {
            "workflow": {"name": evil},
            "stopped": evil,
            "stages": [{"name": evil, "use": evil}],
            "exit_code": 4,
        }
    )
    assert evil not in RunOutput(Path(evil), summary, StoredValues())._repr_html_()


def test_exported_files_stand_in_for_a_cache_that_is_gone(tmp_path: Path) -> None:
    out = write_output(tmp_path, {"a.png": Rigid3.identity(), "b.jpg.png": Rigid3.identity()}, points=200)
    views = [{"name": "a.png"}, {"name": "b.jpg.png"}]
    RunSummary.read(out).model_copy(update={"views": RunSummary.from_json({"views": views}).views}).write(out)
    for folder in ("range", "confidence", "uncertainty"):
        (out / folder).mkdir()
    ranges = np.arange(1, 9, dtype=np.float32).reshape(2, 4)
    write_range_tiff(out / "range" / "a.tiff", ranges)
    write_confidence_png(out / "confidence" / "a.png.png", np.full((2, 4), 200, np.uint8))
    write_range_tiff(out / "uncertainty" / "a.tiff", ranges / np.float32(100))
    run = load(out)
    view = run.views["a.png"]
    assert view.range_map is not None
    assert np.array_equal(view.range_map, ranges)
    assert view.confidence is not None
    assert view.confidence.min() == 200
    assert view.uncertainty is not None
    assert np.array_equal(view.uncertainty, ranges / np.float32(100))
    assert run.views["b.jpg.png"].range_map is None
    assert view.image is not None
    assert view.image.shape[2] == 3
    assert run.poses is not None
    assert run.poses.names == ("a.png", "b.jpg.png")
    assert view.cam_from_world is not None
    assert view.cam_from_world.translation == pytest.approx(np.zeros(3))
    assert run.cloud is not None
    # The file has z up; the cloud is in the world of the poses.
    np.testing.assert_array_equal(run.cloud.points_in_world, box_cloud(200, quality=False).points_in_world)
    np.testing.assert_array_equal(run.cloud.normals_in_world, box_cloud(200, quality=False).normals_in_world)
    with pytest.raises(InputError, match="is not a cache"):
        load(out, cache=tmp_path)


def test_what_a_run_does_not_have_is_none(tmp_path: Path) -> None:
    run = RunOutput(tmp_path, RunSummary.from_json({"views": [{"name": "a.png"}]}), StoredValues())
    assert (run.poses, run.cloud) == (None, None)
    view = run.views["a.png"]
    assert (view.range_map, view.confidence, view.image, view.cam_from_world) == (None, None, None, None)
    assert view.uncertainty is None


# The fields of run.json before it had a schema: programs of users read these.
FIELDS = [
    "workflow",
    "cache",
    "version",
    "started",
    "machine",
    "executor",
    "seconds",
    "exit_code",
    "stopped",
    "units",
    "stages",
    "failures",
    "blocked",
    "rejected",
    "doubts",
    "warnings",
    "notes",
    "results",
    "poses",
    "scores",
    "all_scores",
    "views",
    "cloud",
    "workflow_text",
    "versions",
    "files",
    "left_over",
]
POSES = [
    "registered",
    "blocked",
    "rejected",
    "doubts",
    "confirmed",
    "evidence",
    "p_right",
    "centers",
    "points",
    "frame",
    "scale",
    "metric",
    "axes",
    "origin_lla",
    "up",
    "groups",
    "links",
]


def test_every_field_of_run_json_keeps_its_name_and_value() -> None:
    written = json.loads(json.dumps(RunSummary.from_json(SUMMARY).to_json()))
    assert [*written] == ["schema", *FIELDS, "verdict", "merged", "inputs"]
    assert [*written["poses"]] == POSES
    for name in ("workflow", "exit_code", "machine", "executor", "rejected", "cloud", "files", "versions"):
        assert written[name] == SUMMARY[name]
    assert written["views"] == SUMMARY["views"]
    assert written["poses"]["links"][0] == ["a/1.png", "a/2.png", 300, 410, 0.021]
    assert written["scores"]["views"]["a/2.png"]["psnr_db"] == 30.0


def test_a_summary_survives_run_json(tmp_path: Path) -> None:
    verdict = Verdict("fair", "Finished", "Usable, with doubts: see below.", "", (), ())
    summary = RunSummary.from_json(SUMMARY).model_copy(update={"verdict": verdict})
    summary.write(tmp_path)
    assert RunSummary.read(tmp_path) == summary
    assert json.loads((tmp_path / "run.json").read_text())["schema"] == 1


def test_a_run_without_poses_scores_or_cloud_has_empty_objects_there() -> None:
    written = RunSummary().to_json()
    assert (written["poses"], written["scores"], written["cloud"]) == ({}, {}, {})
    assert not RunSummary.from_json(written).poses
    assert RunSummary.from_json({"cloud": {"points": 0}}).to_json()["cloud"] == {"points": 0}


def test_names_that_are_no_utf_8_survive(tmp_path: Path) -> None:
    """Linux has file names of any bytes."""
    summary = RunSummary.from_json({"stages": [], "poses": {"registered": ["\udcff.jpg"]}, "files": {"\udcff": "x"}})
    summary.write(tmp_path)
    assert RunSummary.read(tmp_path) == summary


def test_a_summary_cannot_be_changed() -> None:
    with pytest.raises(ValidationError, match="frozen"):
        RunSummary().exit_code = 3


@pytest.mark.parametrize(
    ("value", "place"),
    [([], "the whole file"), ({"exit_code": "no"}, "exit_code"), ({"poses": {"links": [["a"]]}}, "poses.links.0")],
)
def test_what_is_no_summary_is_an_error_that_names_the_place(value: object, place: str) -> None:
    with pytest.raises(InputError, match=f"^{place}"):
        RunSummary.from_json(value)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"stages": 3}', '{"stages": [], "units": []}'])
def test_a_damaged_file_is_an_error_with_a_remedy(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(InputError, match=r"is not a .*run\.json.*Run the workflow again"):
        RunSummary.read(tmp_path)


def test_links_of_early_versions_had_fewer_fields() -> None:
    links = RunSummary.from_json({"poses": {"links": [["a", "b", 9], ["a", "c", 0, 12]]}}).poses.links
    assert links == (PairLink("a", "b", 9), PairLink("a", "c", 0, 12))


def test_poses_by_group_have_the_groups_own_frames_and_the_cameras_doubts() -> None:
    poses = PosesSummary.model_validate(
        {
            "registered": ["a", "b", "x"],
            "centers": [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
            "doubts": {"x": "dark"},
            "links": [["a", "b", 9], ["a", "x", 0]],
            "groups": [{"images": ["a", "b"], "scale": "s"}, {"images": ["x"], "metric": True, "points": 7}],
        }
    )
    large, small = poses.by_group()
    assert (large.registered, large.scale, large.links) == (("a", "b"), "s", (PairLink("a", "b", 9),))
    assert (small.centers, small.metric, small.points, small.doubts) == (((2, 0, 0),), True, 7, {"x": "dark"})


def test_doubts_of_the_poses_come_first_and_the_source_is_found() -> None:
    stages = [{"name": "images", "use": "source.folder", "params": {"path": "/photos"}}]
    doubts = {"b": {"stage": "judge", "reason": "dark"}, "a": {"stage": "judge", "reason": "other"}}
    summary = RunSummary.from_json({"stages": stages, "doubts": doubts, "poses": {"doubts": {"a": "unconfirmed"}}})
    assert summary.doubtful_images == {"a": "unconfirmed", "b": "dark"}
    assert summary.source_folder == Path("/photos")
    assert RunSummary().source_folder is None
