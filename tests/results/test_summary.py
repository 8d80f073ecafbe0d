"""The summary of a run: what run.json holds, whoever wrote it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from pydantic import ValidationError

from pano_mvs.core.errors import InputError
from pano_mvs.results.records import PairLink, PosesSummary, Verdict
from pano_mvs.results.summary import RunSummary
from tests.report.test_report import SUMMARY

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
    "p_right",
    "centers",
    "points",
    "frame",
    "scale",
    "metric",
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
