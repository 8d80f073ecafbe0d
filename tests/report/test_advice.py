"""The page lists what to do next time, and marks the places on the map."""

from __future__ import annotations

from pathlib import Path

import pytest

from pano_mvs.report.page import write_report
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.testing.tiny_capture import TinyCapture
from tests.report.conftest import summary_of
from tests.report.html_page import Page

ROW = {
    "registered": ["a", "b", "c", "d", "e"],
    "centers": [[0, 0, 0], [1, 0, 0], [2, 0, 0], [5, 0, 0], [6, 0, 0]],
    "metric": True,
}


def reported(out_dir: Path, summary: dict[str, object], values: StoredValues | None = None) -> Page:
    write_report(out_dir, RunSummary.from_json(summary), values)
    return Page((out_dir / "report.html").read_text(encoding="utf-8"))


def test_a_gap_is_listed_and_marked_on_the_map(out_dir: Path) -> None:
    page = reported(out_dir, {"poses": ROW})
    assert "Take 2 panoramas between c and d. They are 3 m apart" in page.words
    assert page.source.count('class="stand"') == 1
    assert "numbers are places to stand" in page.words
    assert page.all("a", href="#next-time")


def test_a_capture_without_gaps_is_said_to_have_none(out_dir: Path) -> None:
    even = {**ROW, "centers": [[idx, 0, 0] for idx in range(5)]}
    page = reported(out_dir, {"poses": even})
    assert "No gap was found" in page.words
    assert 'class="stand"' not in page.source
    assert "Next time" not in reported(out_dir, {}).words


def test_of_many_suggestions_the_first_are_shown_and_the_others_counted(out_dir: Path) -> None:
    names = [f"{idx:02}" for idx in range(40)]
    centers = [[idx + 4 * (idx // 2), 0, 0] for idx in range(40)]
    near = [[idx, 0, 0] for idx in range(40, 100)]
    poses = {
        "registered": names + [f"n{idx}" for idx in range(60)],
        "centers": centers + [[2000 + x, 0, 0] for x, *_ in near],
    }
    page = reported(out_dir, {"poses": poses})
    assert page.words.count("panoramas between") == 12
    assert "8 more are less urgent" in page.words


def test_the_next_page_does_not_read_the_ranges_again(
    results: StoredValues, tiny: TinyCapture, out_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    reported(out_dir, summary_of(tiny), results)
    monkeypatch.setattr("pano_mvs.report.content.coverage", lambda *_: pytest.fail("read again"))
    reported(out_dir, summary_of(tiny), results)
