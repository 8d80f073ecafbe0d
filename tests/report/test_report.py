"""The page: all that is known is said, whatever is missing, and nothing in it is markup of others."""

from __future__ import annotations

import base64
import hashlib
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pano_mvs.report import page as page_module
from pano_mvs.report import write_report
from pano_mvs.report.content import capture_facts, capture_name, date_in_words
from pano_mvs.report.view_cards import chosen_views
from pano_mvs.results.records import ViewSummary
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import Panorama
from pano_mvs.scene.scores import NO_TRUTH
from pano_mvs.testing.tiny_capture import TinyCapture
from tests.report.conftest import summary_of
from tests.report.html_page import Page

NAMES = ["a/1.png", "a/2.png", "a/3.png"]
SUMMARY: dict[str, Any] = {
    "workflow": {"name": "lobby", "path": "flows/lobby.yaml", "overrides": ["depth.planes=64"]},
    "version": "1.2.3",
    "started": "2026-11-21 04:17",
    "seconds": 187.2,
    "exit_code": 3,
    "stopped": "",
    "executor": {"name": "processes", "workers": 2, "threads": 1},
    "machine": {"processor": "x86_64", "cores": 2, "memory_gb": 16.4},
    "stages": [
        {
            "name": "depth",
            "use": "depth.sweep",
            "units": 4,
            "run": 2,
            "cached": 1,
            "failed": 1,
            "blocked": 9,
            "seconds": 90.0,
            "unit_seconds": 170.0,
            "metrics": {"planes": 128, "median_error_deg": 0.01234567},
            "params": {"planes": 128, "near": None, "cost": "census"},
        },
        {"name": "ply", "use": "export.ply", "units": 1, "run": 1, "cached": 0, "failed": 0, "seconds": 0.2},
    ],
    "failures": [
        {
            "stage": "depth",
            "item": "a/4.png",
            "cause": "it is truncated",
            "consequence": "no range map",
            "log": "logs/depth.txt",
        }
    ],
    "blocked": [{"stage": "ply", "item": "", "cause": "it needs depth"}],
    "rejected": {"a/5.png": {"stage": "images", "reason": "not a picture"}},
    "warnings": ["a blob was damaged"],
    "notes": ["one picture has no GPano metadata"],
    "poses": {
        "registered": NAMES,
        "rejected": {"a/4.png": "too few matches"},
        "doubts": {"a/1.png": "hardly confirmed"},
        "confirmed": {"a/1.png": [0.125, 0.62], "a/2.png": [0.6, None]},
        "centers": [[0, 0, 0], [1, 0.1, 0.2], [0.4, 0, 2]],
        "frame": "the first camera",
        "scale": "the first baseline is 1",
        "links": [
            ["a/1.png", "a/2.png", 300, 410, 0.021],
            ["a/2.png", "a/3.png", 30],
            ["a/1.png", "a/4.png", 3],
            ["a/1.png", "a/3.png", 0, 12, None],
        ],
    },
    "scores": {
        "poses": {"median_pair_error_deg": 0.0123, "registered": 3},
        "views": {
            "a/1.png": {"median_relative_error": 0.02},
            "a/2.png": {"median_relative_error": 0.04, "psnr_db": 30.0},
        },
        "notes": ["the scale was fitted"],
    },
    "all_scores": {},
    "views": [
        {"name": "a/1.png", "preview": "preview/a/1.jpg", "completeness": 0.98, "consistent": 0.7},
        {"name": "a/2.png", "preview": "preview/gone.jpg", "completeness": 0.9},
    ],
    "cloud": {"points": 1234567},
    "files": {"cloud.ply": "x", "range/a/1.tiff": "x", "range/a/2.tiff": "x"},
    "workflow_text": "pano_mvs: 1\nstages: {}\n",
    "versions": {"numpy": "2.1"},
}


def reported(out_dir: Path, summary: Mapping[str, Any], results: StoredValues | None = None) -> Page:
    write_report(out_dir, RunSummary.from_json(summary), results)
    return Page((out_dir / "report.html").read_text(encoding="utf-8"))


def assert_sound(page: Page) -> None:
    """What holds of every page: nothing is fetched, what is referred to exists, pictures have words and decode."""
    forbidden = {"link", "iframe", "object", "embed", "base", "form", "audio", "video", "source"}
    assert not forbidden & set(page.tags)
    assert not re.search(r"https?://|url\(|@import|javascript:", page.source)
    for tag, name, value in page.attributes:
        assert not name.startswith("on"), (tag, name)
        if name in ("src", "href", "srcset", "data", "action"):
            assert value.startswith(("data:image/jpeg;base64,", "#")), value[:80]
    ids = [value for _, name, value in page.attributes if name == "id"]
    assert len(set(ids)) == len(ids)
    referred = [value for tag, name, value in page.attributes if (tag, name) == ("label", "for")]
    referred += [value[1:] for tag, name, value in page.attributes if (tag, name) == ("a", "href")]
    assert set(referred) <= set(ids)
    for attrs in page.all("img"):
        assert "alt" in attrs
        data = base64.b64decode(attrs["src"].partition(",")[2], validate=True)
        picture = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert picture is not None
        assert picture.shape[:2] == (int(attrs["height"]), int(attrs["width"]))
    for attrs in page.all("svg"):
        assert attrs["role"] == "img"
        assert attrs["aria-label"]


def test_everything_that_is_known_is_said(out_dir: Path) -> None:
    page = reported(out_dir, SUMMARY)
    assert_sound(page)
    for text in (
        "lobby",
        "Finished, with failed items",
        "3 of 4",
        "panoramas registered",
        "94 % of pixels have a range",
        "1.23 M points in the cloud",
        "0.012° median pose error",
        "3 % median range error",
        "Took 3 min",
        "5 units of work: 3 computed, 1 taken from the cache, 1 failed.",
        "it is truncated",
        "no range map",
        "too few matches",
        "one picture has no GPano metadata",
        "the first baseline is 1",
        "median error, °: 0.01235",
        "the scale was fitted",
        "PSNR dB",
        "pano_mvs: 1 stages: {}",
        "numpy 2.1",
        "no preview",
        "90 s",
        "9 blocked",
        "depth.planes=64",
        "logs/depth.txt",
        "1 further unit",
        "a blob was damaged",
        "not a picture",
        "workers: 2",
        "cores: 2",
        "range/ (2)",
        "cloud.ply",
        "planes",
        "census",
        "3 of 4 have a common geometry",
        "3 min of work",
        "show 1 of 1 rejected pair",
        "1 camera is doubtful: a/1.png (hardly confirmed).",
        "triangles are doubtful cameras",
        "a/1.png 12 % 62 % hardly confirmed",
        "Doubtful (1)",
        "in scene units, not metres",
        "no range map",
    ):
        assert text in page.words, text


def test_groups_of_stages_are_listed_before_the_stages(out_dir: Path) -> None:
    """The report of `quality` listed 44 stages, of which a reader knows nine groups."""
    depth, ply = SUMMARY["stages"]
    sky = {"name": "sky", "use": "filters.sky", "units": 4, "run": 4, "unit_seconds": 10.0}
    grouped = [depth | {"group": "ranges"}, sky | {"group": "ranges"}, ply]
    page = reported(out_dir, SUMMARY | {"stages": grouped})
    assert_sound(page)
    section = page.source.partition('<section id="stages">')[2].partition("</section>")[0]
    above, _, below = section.partition("<summary>Each stage</summary>")
    rows = [" ".join(re.sub(r"<[^>]+>", " ", row).split()) for row in above.split("<tr>")[2:]]
    assert rows == ["ranges depth, sky 8 6 1 1 9 blocked 3 min", "ply 1 1 0 0"]
    assert "depth.sweep" in below
    assert "Each stage" not in reported(out_dir, SUMMARY).source, "a workflow without groups"


def test_a_doubtful_camera_is_marked_wherever_it_is_shown(out_dir: Path) -> None:
    """On both maps, in its view card and in the table of all panoramas; nothing is where no camera is doubtful."""
    page = reported(out_dir, SUMMARY)
    assert page.source.count('class="doubtful"') == 2
    assert page.words.count("▲ doubtful: hardly confirmed") == 2
    poses = SUMMARY["poses"] | {"doubts": {}, "confirmed": {}}
    cleared = reported(out_dir, SUMMARY | {"poses": poses})
    assert 'class="doubtful"' not in cleared.source
    assert "doubtful:" not in cleared.words
    assert "triangles" not in cleared.words


def test_the_probability_of_a_pose_is_in_the_tables_and_the_colour_of_its_camera(out_dir: Path) -> None:
    poses = SUMMARY["poses"] | {"p_right": {"a/1.png": 0.5, "a/2.png": 0.995, "a/3.png": None}}
    page = reported(out_dir, SUMMARY | {"poses": poses})
    assert_sound(page)
    assert "a/1.png 50 % 12 % 62 % hardly confirmed" in page.words
    assert page.source.count('style="fill:#c7264a"') == page.source.count('style="fill:#1a9973"') == 2
    assert page.source.count('data-label="pose right"') == page.source.count("<tr data-doubt")
    assert "colours are the probability that a pose is right" in page.words
    assert "Pose right" not in reported(out_dir, SUMMARY).words


def test_of_very_many_views_doubtful_ones_are_always_shown_in_full() -> None:
    views = [ViewSummary(name=str(idx), metrics={"completeness": 1.0, "consistent": 0.01 * idx}) for idx in range(100)]
    assert 90 not in chosen_views(views)
    chosen = chosen_views(views, always=("90",))
    assert 90 in chosen
    assert len(chosen) == len(chosen_views(views))


@pytest.mark.parametrize("key", [None, *SUMMARY])
def test_any_key_may_be_missing_or_empty(out_dir: Path, key: str | None) -> None:
    without = {name: value for name, value in SUMMARY.items() if name != key}
    assert "pano-mvs" in reported(out_dir, without if key else {}).words
    if key is not None and isinstance(SUMMARY[key], dict | list):
        assert_sound(reported(out_dir, without | {key: type(SUMMARY[key])()}))
        assert_sound(reported(out_dir, without | {key: None}))


@pytest.mark.parametrize("key", SUMMARY["poses"])
def test_any_key_of_the_poses_may_be_missing(out_dir: Path, key: str) -> None:
    poses = {name: value for name, value in SUMMARY["poses"].items() if name != key}
    assert_sound(reported(out_dir, SUMMARY | {"poses": poses}))


@pytest.mark.parametrize("state", ["new", "damaged", "in the way", "missing"])
def test_compiled_templates_are_kept_where_that_is_possible(
    out_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, state: str
) -> None:
    before = reported(out_dir, SUMMARY).source

    def folder() -> Path:
        if state == "missing":
            raise OSError("nowhere")
        return tmp_path

    monkeypatch.setattr(page_module, "user_cache_folder", folder)
    page_module._environment.cache_clear()
    assert reported(out_dir, SUMMARY).source == before
    kept = list((tmp_path / "pano-mvs" / "templates").glob("*.cache"))
    assert (len(kept) > 5) == (state != "missing")
    for path in kept:
        if state == "damaged":
            path.write_bytes(path.read_bytes()[:50])
        elif state == "in the way":
            path.unlink()
            path.mkdir()
    page_module._environment.cache_clear()
    assert reported(out_dir, SUMMARY).source == before
    page_module._environment.cache_clear()


def test_only_our_own_script_may_run(out_dir: Path) -> None:
    """The policy names the script by its digest: one that a file name might smuggle in has another."""
    page = reported(out_dir, SUMMARY)
    facts, *scripts = page.scripts
    assert facts.strip() == "{}"
    digests = [base64.b64encode(hashlib.sha256(script.encode()).digest()).decode() for script in scripts]
    (policy,) = [attrs["content"] for attrs in page.all("meta") if attrs.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'; img-src data:; style-src 'unsafe-inline'; ")
    assert f"script-src 'sha256-{digests[0]}' 'sha256-{digests[1]}';" in policy


def test_every_element_that_the_script_asks_for_is_there(out_dir: Path) -> None:
    page = reported(out_dir, SUMMARY)
    ids = {value for _, name, value in page.attributes if name == "id"}
    assert set(re.findall(r'getElementById\("(\w+)"\)', page.scripts[1])) <= ids


def test_every_element_that_the_viewer_asks_for_is_there(
    out_dir: Path, results: StoredValues, tiny: TinyCapture
) -> None:
    page = reported(out_dir, summary_of(tiny), results)
    ids = {value for _, name, value in page.attributes if name == "id"}
    asked = set(re.findall(r'(?:getElementById|press)\("([\w-]+)"', page.scripts[2]))
    assert len(asked) == 9
    assert asked <= ids


def test_names_and_causes_are_text_and_never_markup(out_dir: Path) -> None:
    evil = '<script>alert("1")</script>&\'">'
    summary = {
        "workflow": {"name": evil, "path": evil, "overrides": [evil]},
        "notes": [evil],
        "workflow_text": evil,
        "versions": {evil: evil},
        "failures": [{"stage": evil, "item": evil, "cause": evil, "log": evil}],
        "poses": {
            "registered": [evil],
            "centers": [[0, 0, 0]],
            "rejected": {evil + "2": evil},
            "frame": evil,
            "scale": evil,
            "links": [[evil, evil, 0, 2, None]],
        },
        "views": [{"name": evil, "preview": evil}],
        "stopped": evil,
        "machine": {evil: evil},
        "stages": [{"name": evil, "use": evil, "metrics": {evil: 1}, "params": {evil: [evil]}}],
        "scores": {"poses": {evil: 1}, "views": {evil: {evil: 1}}, "notes": [evil]},
        "files": {evil: evil},
    }
    page = reported(out_dir, summary)
    assert page.tags.count("script") == 3, "our two and the facts"
    assert_sound(page)
    assert page.words.count(evil) >= 24


def test_previews_stand_in_for_what_is_not_in_the_store(out_dir: Path) -> None:
    page = reported(out_dir, SUMMARY)
    full = [attrs for attrs in page.all("img") if attrs["alt"]]
    assert [attrs["alt"].partition(":")[0] for attrs in full] == ["a/1.png", "a/1.png"]
    assert {(attrs["width"], attrs["height"]) for attrs in full} == {("768", "384")}
    assert len(page.all("img")) == 3, "and a small one in the table"


@pytest.mark.parametrize("preview", ["../secret.jpg", "empty.jpg", "text.jpg", "", "preview", "flat.jpg"])
def test_what_is_no_preview_within_the_folder_is_not_shown(out_dir: Path, preview: str) -> None:
    inside = out_dir / "out"
    (inside / "preview").mkdir(parents=True)
    cv2.imwrite(str(out_dir / "secret.jpg"), np.zeros((80, 16, 3), np.uint8))
    cv2.imwrite(str(inside / "flat.jpg"), np.zeros((8, 16, 3), np.uint8))
    (inside / "empty.jpg").touch()
    (inside / "text.jpg").write_text("hello")
    page = reported(inside, {"views": [{"name": "1", "preview": preview}]})
    assert "img" not in page.tags
    assert "no preview" in page.words


def test_scores_of_all_branches_are_told_apart(out_dir: Path) -> None:
    both = {"ours": SUMMARY["scores"], "papers": {"poses": {}, "views": {"a/1.png": {"psnr_db": 11.25}}, "notes": []}}
    words = reported(out_dir, SUMMARY | {"all_scores": both}).words
    beside = words[words.index("Median over views") :]
    assert beside.index("ours") < beside.index("30") < beside.index("papers") < beside.index("11.25")
    assert words.count("11.25") == 2, "and in the table of its branch"
    assert "Median over views" not in reported(out_dir, SUMMARY).words


def test_nothing_is_said_of_a_ground_truth_that_nobody_has(out_dir: Path) -> None:
    scores = {"poses": {}, "views": {}, "notes": [NO_TRUTH]}
    assert "ground truth" not in reported(out_dir, SUMMARY | {"scores": scores}).words
    other = reported(out_dir, SUMMARY | {"scores": scores | {"notes": [NO_TRUTH, "1.png is another image"]}})
    assert "1.png is another image" in other.words


def test_where_nothing_failed_nothing_is_said_of_failures(out_dir: Path) -> None:
    assert "Failures" not in reported(out_dir, SUMMARY | {"failures": []}).words


def with_source(path: str, use: str = "source.folder") -> dict[str, Any]:
    return {"stages": [{"name": "images", "use": use, "params": {"path": path}}], "workflow": {"name": "quality"}}


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("/tours/old mill/Images", "old mill / Images"),
        ("/tours/old mill", "old mill"),
        ("walk.mp4", "walk.mp4"),
        ("images", "images"),
        ("/", "quality"),
        ("", "quality"),
    ],
)
def test_a_capture_is_called_like_its_folder(path: str, name: str) -> None:
    assert capture_name(RunSummary.from_json(with_source(path))) == name
    assert capture_name(RunSummary.from_json(with_source(path, use="poses.from_file"))) == "quality"


@pytest.mark.parametrize(
    ("started", "words"),
    [
        ("2026-01-09T23:30:01+00:00", "9 Jan 2026, 23:30 UTC"),
        ("2026-01-09T23:30:01-02:00", "10 Jan 2026, 01:30 UTC"),
        ("2026-12-31 04:17", "31 Dec 2026, 04:17"),
        ("yesterday", "yesterday"),
        ("", ""),
    ],
)
def test_dates_are_written_in_words(started: str, words: str) -> None:
    assert date_in_words(started) == words


def test_sizes_are_those_of_the_files_the_most_frequent_first(results: StoredValues, tiny: TinyCapture) -> None:
    assert results.store is not None
    known = tiny.each(Panorama)
    large = replace(known[tiny.names[1]], source_size_hw=(64, 128))
    refs = {**results.refs["images"], tiny.names[1]: results.store.put_value(large)}
    mixed = replace(results, refs={**results.refs, "images": refs})
    facts = capture_facts(RunSummary(), mixed, panoramas=5)
    assert facts.sizes == (((32, 64), 3), ((64, 128), 1))
    assert (facts.measured, facts.panoramas, facts.working_hw) == (4, 5, (32, 64))
    assert capture_facts(RunSummary(), results, panoramas=4).working_hw is None
    assert capture_facts(RunSummary(), StoredValues(), panoramas=0).sizes == ()


def test_the_head_names_the_capture(results: StoredValues, tiny: TinyCapture, tmp_path: Path) -> None:
    summary = summary_of(tiny)
    summary |= {
        "stages": [*summary["stages"], *with_source("/tours/old mill")["stages"]],
        "started": "2026-02-03T10:00",
    }
    write_report(tmp_path, RunSummary.from_json(summary), results)
    page = Page((tmp_path / "report.html").read_text(encoding="utf-8"))
    assert "<h1>old mill</h1>" in page.source
    assert "<title>old mill: Finished</title>" in page.source
    assert "4 panoramas of 64 × 32 px Workflow tiny 3 Feb 2026, 10:00" in page.words.replace("</span>", " ")
