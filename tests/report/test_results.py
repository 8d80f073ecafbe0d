"""Pictures of views in the page: their colours, their size, and when they are drawn again."""

from __future__ import annotations

import base64
import json
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.engine.cache.store import Store, UnitRecord
from pano_mvs.io.images.preview import color_mapped, mark_unconfirmed
from pano_mvs.report import cloud as cloud_module
from pano_mvs.report import content, masked_areas, write_report
from pano_mvs.report import view_cards as cards_module
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.report.view_cards import RangeScales, ViewCard, common_limits, range_ticks, view_cards
from pano_mvs.results.pictures import Picture, picture, preview_panels
from pano_mvs.results.records import ViewSummary
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import RangeMap
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
    for decoder in ("pano_mvs.report.view_cards.color_mapped", "pano_mvs.report.cloud.draw_cloud"):
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


def test_the_common_scale_spans_all_views_of_a_group_and_no_others() -> None:
    own = {"a": (1.0, 4.0), "b": (0.5, 3.0), "c": (100.0, 300.0), "d": None}
    assert common_limits(own, {"a": 0, "b": 0, "c": 1}) == {0: (0.5, 4.0), 1: (100.0, 300.0)}
    assert common_limits({"d": None}, {}) == {}


@pytest.mark.parametrize(
    ("own", "differ"), [((1.0, 10.0), False), ((1.05, 9.5), False), ((1.2, 10.0), True), ((1.0, 8.0), True)]
)
def test_a_view_has_its_own_scale_where_it_would_look_different(own: tuple[float, float], differ: bool) -> None:
    assert RangeScales((1.0, 10.0), own).differ is differ
    assert not RangeScales((1.0, 10.0), None).differ


def test_ticks_stand_where_their_colours_are() -> None:
    for at, value in range_ticks(0.5, 8.0):
        assert 0.5 * (8.0 / 0.5) ** at == pytest.approx(value, rel=1e-3)


def farther(results: StoredValues, tiny: TinyCapture) -> StoredValues:
    """Return the values with a last view in which all is three times as far away."""
    assert results.store is not None
    known = tiny.each(RangeMap)[tiny.names[3]]
    far = results.store.put_value(replace(known, range=(3 * known.range).astype(np.float32)))
    return replace(results, refs={**results.refs, "ranges": {**results.refs["ranges"], tiny.names[3]: far}})


def cards_of(results: StoredValues, tiny: TinyCapture, earlier: EarlierPage, **groups: int) -> tuple[ViewCard, ...]:
    views = [ViewSummary(name=name) for name in tiny.names]
    return view_cards(
        Path("nowhere"), views, results, kept=earlier, groups={name: groups.get(name[2], 0) for name in tiny.names}
    )


def test_equal_ranges_have_equal_colours_in_all_views(results: StoredValues, tiny: TinyCapture) -> None:
    far = farther(results, tiny)
    cards = cards_of(far, tiny, EarlierPage())
    assert len({card.ticks for card in cards}) == 1
    last = far.range_map(tiny.names[3])
    assert last is not None
    limits = common_limits({card.name: _limits(far, card.name) for card in cards}, {})[0]
    expected = mark_unconfirmed(color_mapped(last.range, *limits), last.confidence)
    own = cards[3].own_range
    assert own is not None
    off = [
        np.abs(decoded(shown)[..., ::-1] - expected.astype(float)).mean() for shown in (cards[3].pictures["range"], own)
    ]
    assert off[0] < 0.5 * off[1], "what is left are losses of a small JPEG"
    assert cards[3].own_ticks != cards[3].ticks


def _limits(values: StoredValues, name: str) -> tuple[float, float]:
    from pano_mvs.io.images.preview import range_limits

    found = values.range_map(name)
    assert found is not None
    return range_limits(found.range)


def test_views_of_another_group_do_not_share_the_scale(results: StoredValues, tiny: TinyCapture) -> None:
    """Their unit of length is another one."""
    together, apart = (cards_of(farther(results, tiny), tiny, EarlierPage(), **groups) for groups in ({}, {"3": 1}))
    assert apart[3].ticks != apart[0].ticks
    assert apart[3].own_range is None
    assert together[3].own_range is not None


def test_a_new_view_far_away_changes_the_common_scale_of_kept_pages(
    results: StoredValues, tiny: TinyCapture, tmp_path: Path
) -> None:
    summary = RunSummary.from_json(summary_of(tiny))
    write_report(tmp_path, summary, results)
    before = EarlierPage.of_file(tmp_path / "report.html")
    again = cards_of(farther(results, tiny), tiny, before)
    assert again == cards_of(farther(results, tiny), tiny, EarlierPage())


def test_the_page_has_a_switch_if_scales_differ(results: StoredValues, tiny: TinyCapture, out_dir: Path) -> None:
    summary = RunSummary.from_json(summary_of(tiny))
    write_report(out_dir, summary, farther(results, tiny))
    page = Page((out_dir / "report.html").read_text(encoding="utf-8"))
    assert page.all("input", id="own-scale", type="checkbox")
    assert page.all("label", **{"for": "own-scale"})
    assert page.source.count('class="own"') == page.source.count('class="scale own"') >= 1


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


@pytest.mark.slow
def test_five_thousand_views_fit_with_all_their_pictures(tmp_path: Path) -> None:
    """The text of the largest page, and all pictures at the largest size that each may have, base64 and all."""
    write_report(tmp_path, RunSummary.from_json(large(5000)))
    text = (tmp_path / "report.html").stat().st_size
    cards = cards_module.MAX_CARDS * sum(cards_module.MAX_BYTES.values())
    small = content.MAX_THUMBNAILS * content.MAX_BYTES
    cloud = 3 * cloud_module.MAX_BYTES + cloud_module.MAX_POINTS * cloud_module.POINT_BYTES
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
        cards_module,
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
