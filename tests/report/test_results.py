"""What the page takes from the store: pictures of views and cloud, residuals, reasons; and what it keeps for later."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.report import write_report
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.results.pictures import Picture
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.testing.tiny_capture import TinyCapture
from tests.report.conftest import summary_of
from tests.report.html_page import Page
from tests.report.test_report import assert_sound


def reported(out_dir: Path, summary: Mapping[str, Any], results: StoredValues | None) -> Page:
    write_report(out_dir, RunSummary.from_json(summary), results)
    return Page((out_dir / "report.html").read_text(encoding="utf-8"))


def test_views_are_shown_with_panorama_range_and_confidence(
    out_dir: Path, results: StoredValues, tiny: TinyCapture
) -> None:
    page = reported(out_dir, summary_of(tiny), results)
    assert_sound(page)
    for name in tiny.names:
        words = [attrs["alt"] for attrs in page.all("img") if str(attrs["alt"]).startswith(f"{name}:")]
        assert [word.split()[-1] for word in words] == ["panorama", "(far)", "pixel"]
    assert page.all("img", alt="The cloud: From above")
    assert "From inside, where" in page.words
    assert "only 7 of 31 matches agree" in page.words
    assert "median reprojection residual" in page.words
    assert "Median epipolar residual of each matched pair: 5 pairs" in page.words
    assert "Not shown" not in page.words


def test_nothing_is_drawn_again_where_nothing_changed(
    out_dir: Path, results: StoredValues, tiny: TinyCapture, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second page is the first, byte for byte, and decodes no picture."""
    write_report(out_dir, RunSummary.from_json(summary_of(tiny)), results)
    before = (out_dir / "report.html").read_bytes()
    for decoder in ("pano_mvs.report.view_cards.color_mapped", "pano_mvs.report.cloud_pictures.draw_cloud"):
        monkeypatch.setattr(decoder, lambda *_, **__: pytest.fail("drawn again"))
    write_report(out_dir, RunSummary.from_json(summary_of(tiny)), results)
    assert (out_dir / "report.html").read_bytes() == before


def test_what_changed_is_drawn_again(out_dir: Path, results: StoredValues, tiny: TinyCapture) -> None:
    """A view whose range map is another shows it; the others' pictures stay."""
    first = reported(out_dir, summary_of(tiny), results)
    names = tiny.names
    ranges = dict(results.refs["ranges"]) | {names[0]: results.refs["ranges"][names[1]]}
    second = reported(out_dir, summary_of(tiny), StoredValues(results.store, dict(results.refs) | {"ranges": ranges}))
    pictures = [{attrs["alt"]: attrs["src"] for attrs in page.all("img")} for page in (first, second)]
    changed = {str(alt).partition(":")[0] for alt in pictures[0] if pictures[0][alt] != pictures[1][alt]}
    assert changed == {names[0]}


def test_a_page_that_was_tampered_with_is_no_source_of_markup(
    out_dir: Path, results: StoredValues, tiny: TinyCapture
) -> None:
    write_report(out_dir, RunSummary.from_json(summary_of(tiny)), results)
    path = out_dir / "report.html"
    text = path.read_text()
    facts = text.index('id="facts">') + len('id="facts">')
    end = text.index("</script>", facts)
    path.write_text(text[:facts] + "[1, {" + text[end:])
    assert_sound(reported(out_dir, summary_of(tiny), results))
    path.write_text(text.replace('"shares":', '"shares": "<b>", "other":'))
    assert EarlierPage.of_file(path).fact(next(iter(json.loads(text[facts:end])))) is None
    page = reported(out_dir, summary_of(tiny), results)
    assert_sound(page)
    assert "<b>" not in page.words
    path.write_bytes(b"\xff\xfe")
    assert_sound(reported(out_dir, summary_of(tiny), results))


@pytest.mark.parametrize("role", ["images", "pairs", "poses", "ranges", "cloud"])
def test_what_is_damaged_or_gone_is_left_out_and_told(
    out_dir: Path, results: StoredValues, tiny: TinyCapture, role: str
) -> None:
    assert results.store is not None
    for ref in results.refs[role].values():
        for part in ref.parts.values():
            if not part.external:
                results.store.blobs.path(part).unlink(missing_ok=True)
    store = Store(results.store.root)  # one that knows no paths of pictures either
    page = reported(out_dir, summary_of(tiny), StoredValues(store, results.refs))
    assert_sound(page)
    assert "Not shown:" in page.words


@pytest.mark.parametrize("source", ["images", "photos"])
def test_a_folder_and_its_cache_give_the_page_of_the_run(
    out_dir: Path, results: StoredValues, tiny: TinyCapture, source: str
) -> None:
    """`StoredValues.of_folder` finds the values of a run, also if a stage after the source made the panoramas."""
    store = results.store
    assert store is not None
    keys: dict[str, dict[str, str]] = {}
    for role, refs in results.refs.items():
        keys[role] = {item: f"{number:064x}" for number, item in enumerate(refs, start=1000 * len(keys))}
    for role, items in keys.items():
        for item, key in items.items():
            store.put(UnitRecord(key, {"stage": role}, results.refs[role][item]))
    store.runs.remember("f" * 64, keys, workflow="tiny", out=out_dir)
    summary = summary_of(tiny) | {"results": {role: role for role in keys}}
    read = {"name": source, "use": "source.folder", "params": {"path": str(tiny.folder / "images")}}
    summary["stages"] = [read, {"name": "images", "use": "masks.apply"}][: 1 + (source != "images")]
    again = StoredValues.of_folder(out_dir, RunSummary.from_json(summary), Store(store.root))
    assert {role: dict(refs) for role, refs in again.refs.items()} == results.refs
    panorama = again.panorama(tiny.names[0])
    assert panorama is not None
    assert panorama.load().shape == (32, 64, 3)
    assert again.notes == []
    elsewhere = StoredValues.of_folder(out_dir / "other", RunSummary.from_json(summary), store)
    assert "contains no run" in elsewhere.notes[0]
    assert StoredValues.of_folder(out_dir, RunSummary(), store).refs == {}


def decoded(picture: Picture) -> NDArray[Any]:
    data = base64.b64decode(picture.uri.partition(",")[2])
    image: NDArray[Any] | None = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert image is not None
    return image
