"""The report shows what moves with the camera."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.report.page import write_report
from pano_mvs.report.static_pictures import static_pictures
from pano_mvs.report.thumbnails import measured_shares
from pano_mvs.results.records import ViewSummary
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import RangeMap
from pano_mvs.scene.static_masks import StaticMasks
from pano_mvs.testing.tiny_capture import TinyCapture


def with_masks(results: StoredValues, masks: StaticMasks) -> StoredValues:
    assert results.store is not None
    return replace(results, refs={**results.refs, "static": {"": results.store.put_value(masks)}})


def test_each_masked_camera_has_a_picture(results: StoredValues, tiny: TinyCapture, tmp_path: Path) -> None:
    masks = tiny.whole(StaticMasks)
    ((name, share, picture),) = static_pictures(with_masks(results, masks), EarlierPage())
    assert name == tiny.names[0]
    assert 0.02 < share < 0.2
    assert picture.size_hw == (32, 64)
    out = tmp_path / "page"
    out.mkdir()
    write_report(out, RunSummary(), with_masks(results, masks))
    page = (out / "report.html").read_text(encoding="utf-8")
    assert page.count("Moves with the camera") == 2
    assert EarlierPage.of_file(out / "report.html").picture(picture.key) is not None


def test_nothing_is_shown_without_masks(results: StoredValues) -> None:
    assert static_pictures(results, EarlierPage()) == ()
    nothing = StaticMasks(np.zeros((0, 8, 16), np.uint8))
    assert static_pictures(with_masks(results, nothing), EarlierPage()) == ()


def test_the_sky_does_not_count_as_missing(results: StoredValues, tiny: TinyCapture) -> None:
    """A correct run outdoors had too few pixels with a range."""
    assert results.store is not None
    known = tiny.each(RangeMap)[tiny.names[0]]
    sky = ~known.valid
    with_sky = {"v": results.store.put_value(replace(known, sky=sky))}
    without = {"v": results.store.put_value(known)}
    views = [ViewSummary(name="v")]
    shown = {
        name: measured_shares(views, replace(results, refs={**results.refs, "ranges": refs}), EarlierPage())["v"]
        for name, refs in (("with", with_sky), ("without", without))
    }
    assert sky.any()
    assert shown["without"].complete < 1
    assert shown["with"].complete == pytest.approx(1)
    assert shown["with"].masked > 0
