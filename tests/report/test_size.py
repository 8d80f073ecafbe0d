"""The page stays below 30 MB, whatever it shows."""

from __future__ import annotations

import base64
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pano_mvs.report import cloud_pictures, cloud_points, content, masked_areas, view_cards, write_report
from pano_mvs.results.pictures import picture, preview_panels
from pano_mvs.results.summary import RunSummary
from tests.report.html_page import Page

MOST_BYTES = 30_000_000
NAMES = [f"a folder with a rather long name/and another/picture {number:05d}.jpg" for number in range(5000)]


def large(count: int) -> dict[str, Any]:
    names = NAMES[:count]
    links = [[names[i], names[(i + k) % count], 50 * (k % 3), 99, 0.03] for i in range(count) for k in range(1, 9)]
    return {
        "exit_code": 3,
        "poses": {
            "registered": names,
            "rejected": {f"x{name}": "too few matches with any other" for name in names},
            "centers": [[i % 70, 0, i // 70] for i in range(count)],
            "links": links,
        },
        "views": [
            {"name": name, "preview": "preview/1.jpg", "completeness": (idx % 997) / 997, "consistent": 0.4}
            for idx, name in enumerate(names)
        ],
        "failures": [{"stage": "depth", "item": name, "cause": "it is truncated " * 9} for name in names],
        "notes": [f"note {number} on something" for number in range(count)],
        "scores": {"views": {name: {"psnr_db": 30.0, "w_mae": 0.1, "completeness": 1.0} for name in names}},
    }


@pytest.mark.parametrize(("width", "most_bytes"), [(768, 35_000), (160, 6_000), (960, 300_000)])
def test_a_picture_takes_no_more_than_its_share_though_it_be_noise(width: int, most_bytes: int) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (width // 2, width, 3), np.uint8)
    made = picture(noise, width=width, most_bytes=most_bytes)
    assert len(base64.b64decode(made.uri.partition(",")[2])) <= most_bytes


def test_tiny_pictures_end_too() -> None:
    assert picture(np.zeros((1, 1, 3), np.uint8), width=8, most_bytes=1).size_hw == (1, 1)


def test_five_thousand_views_fit_with_all_their_pictures(tmp_path: Path) -> None:
    """The text of the largest page, and all pictures at the largest size that each may have, base64 and all."""
    write_report(tmp_path, RunSummary.from_json(large(5000)))
    text = (tmp_path / "report.html").stat().st_size
    cards = view_cards.MAX_CARDS * sum(view_cards.MAX_BYTES.values())
    small = content.MAX_THUMBNAILS * content.MAX_BYTES
    cloud = 3 * cloud_pictures.MAX_BYTES + cloud_points.MAX_POINTS * cloud_points.POINT_BYTES
    masked = masked_areas.MAX_PICTURES * masked_areas.MAX_BYTES
    assert text + (cards + small + cloud + masked) * 4 / 3 + 1000 * 300 < MOST_BYTES


def test_of_many_views_the_worst_and_some_others_are_shown_in_full(tmp_path: Path) -> None:
    views = [{"name": f"view {idx}", "completeness": 0.2 if idx in (400, 411) else 0.9} for idx in range(1000)]
    write_report(tmp_path, RunSummary.from_json({"views": views}))
    page = Page((tmp_path / "report.html").read_text())
    assert "36 of 1000 views are shown in full" in page.words
    assert page.words.count("no preview") == 36
    shown = set(re.findall(r'<b class="name">(view \d+)</b>', page.source))
    assert {"view 400", "view 411", "view 999"} <= shown
    assert len(shown) == 36
    assert page.source.count("<tr data-doubt") == 1000, "all are in the table"


@pytest.mark.slow
def test_a_thousand_views_of_noise_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(1)
    monkeypatch.setattr(
        content,
        "preview_panels",
        lambda *_, **__: tuple(rng.integers(0, 255, (80, 160, 3), np.uint8) for _ in range(2)),
    )
    monkeypatch.setattr(
        view_cards,
        "preview_panels",
        lambda *_, **__: tuple(rng.integers(0, 255, (640, 1280, 3), np.uint8) for _ in range(2)),
    )
    write_report(tmp_path, RunSummary.from_json(large(1000)))
    page = (tmp_path / "report.html").read_text()
    assert page.count("<img ") == 1000 + 2 * 36
    assert len(page) < MOST_BYTES


def test_previews_of_other_shapes_are_none_of_ours(tmp_path: Path) -> None:
    (tmp_path / "1.jpg").write_bytes(b"")
    assert preview_panels(tmp_path, "1.jpg") == ()
    assert preview_panels(tmp_path, "") == ()
