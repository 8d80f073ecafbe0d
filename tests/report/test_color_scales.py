"""One colour scale for all views of a group, and one of each view."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.io.images.preview import color_mapped, mark_unconfirmed
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.report.page import write_report
from pano_mvs.report.view_cards import RangeScales, ViewCard, common_limits, range_ticks, view_cards
from pano_mvs.results.records import ViewSummary
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import RangeMap
from pano_mvs.testing.tiny_capture import TinyCapture
from tests.report.conftest import summary_of
from tests.report.html_page import Page
from tests.report.test_results import decoded


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
