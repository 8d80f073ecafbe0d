"""The head of the page says which capture it is about."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pano_mvs.report.content import capture_facts, capture_name, date_in_words
from pano_mvs.report.page import write_report
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import Panorama
from pano_mvs.testing.tiny_capture import TinyCapture
from tests.report.conftest import summary_of
from tests.report.html_page import Page


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
