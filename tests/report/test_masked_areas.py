"""The report shows what is masked, and why."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.report.content import measured_shares
from pano_mvs.report.earlier_page import EarlierPage
from pano_mvs.report.masked_areas import KINDS, chosen_pictures, masked_areas, masked_kinds
from pano_mvs.report.page import write_report
from pano_mvs.results.records import ViewSummary
from pano_mvs.results.stored_values import StoredValues
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import Panorama, RangeMap
from pano_mvs.scene.panorama import StaticMasks
from pano_mvs.testing.tiny_capture import TinyCapture, Variant, tiny_capture
from tests.report.html_page import Page
from tests.report.test_results import decoded


def with_masks(results: StoredValues, masks: StaticMasks) -> StoredValues:
    assert results.store is not None
    return replace(results, refs={**results.refs, "static": {"": results.store.put_value(masks)}})


def sky_above(tiny: TinyCapture, name: str) -> RangeMap:
    """Return a range map whose upper half is sky."""
    known = tiny.each(RangeMap)[name]
    sky = np.zeros(known.range.shape, np.bool_)
    sky[:16] = True
    return replace(
        known,
        range=np.where(sky, np.float32(np.nan), known.range),
        confidence=np.where(sky, np.uint8(0), known.confidence),
        sky=sky,
    )


@pytest.fixture
def masked(results: StoredValues, tiny: TinyCapture, tmp_path: Path) -> StoredValues:
    """A capture in which the first image has a nadir cap, the second a sky, and the tripod is masked in the third."""
    store = results.store
    assert store is not None
    first, second, third, _ = tiny.names
    images, masks = tiny.each(Panorama), tiny.whole(StaticMasks)
    pixels = masks.of(images[third])
    assert pixels is not None
    changed = {
        first: store.put_value(replace(images[first], nadir_deg=45.0, zenith_deg=22.5)),
        third: store.put_value(images[third].with_mask(~pixels, tmp_path)),
    }
    ranges = {**results.refs["ranges"], second: store.put_value(sky_above(tiny, second))}
    refs = {**results.refs, "images": {**results.refs["images"], **changed}, "ranges": ranges}
    return with_masks(replace(results, refs=refs), masks)


def test_each_reason_is_counted_and_shown(masked: StoredValues, tiny: TinyCapture) -> None:
    found = masked_areas(masked, EarlierPage())
    first, second, third, last = tiny.names
    assert [(count.kind.name, count.panoramas) for count in found.counts] == [
        ("nadir", 1),
        ("zenith", 1),
        ("static", 1),
        ("sky", 1),
    ]
    shares = {count.kind.name: count.mean_share for count in found.counts}
    assert shares["nadir"] == pytest.approx((1 - np.cos(np.deg2rad(45))) / 2, rel=0.01)
    assert shares["zenith"] == pytest.approx((1 - np.cos(np.deg2rad(22.5))) / 2, rel=0.01)
    assert shares["sky"] == pytest.approx(0.5)
    assert 0.02 < shares["static"] < 0.2
    assert (found.examined, found.total) == (4, 4)
    assert [name for name, _, _ in found.pictures] == [first, second, third]
    assert last not in dict.fromkeys(name for name, _, _ in found.pictures)


def test_masked_pixels_are_tinted_by_their_reason_and_no_others(masked: StoredValues, tiny: TinyCapture) -> None:
    for name, _, shown in masked_areas(masked, EarlierPage()).pictures:
        drawn = decoded(shown)[..., ::-1].astype(float)
        panorama = masked.panorama(name)
        assert panorama is not None
        plain = panorama.load_unmasked().astype(float)
        kinds = masked_kinds(panorama, static=masked.static_masks, sky=masked.sky(name))
        assert drawn.shape == plain.shape == (32, 64, 3)
        for kind in KINDS:
            if kind.name in kinds:
                pixels = kinds[kind.name]
                expected = 0.5 * plain[pixels].mean(axis=0) + 0.5 * np.array(kind.color_rgb)
                assert drawn[pixels].mean(axis=0) == pytest.approx(expected, abs=25), kind.name
        rest = ~np.any(list(kinds.values()), axis=0)
        assert drawn[rest].mean(axis=0) == pytest.approx(plain[rest].mean(axis=0), abs=10)


def test_a_mask_file_is_a_reason_of_its_own() -> None:
    tiny = tiny_capture(Variant(masked=True))
    (kinds,) = {tuple(masked_kinds(panorama)) for panorama in tiny.images.values()}
    assert kinds == ("other",)


def test_what_a_crop_leaves_out_is_named() -> None:
    panorama = tiny_capture(Variant(cropped=True)).images["000.png"]
    found = masked_kinds(panorama)
    assert list(found) == ["outside"]
    assert found["outside"][:4].all()
    assert not found["outside"][4:-4].any()


def test_the_page_shows_them_and_the_next_page_reuses_them(
    masked: StoredValues, tiny: TinyCapture, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "page"
    out.mkdir()
    write_report(out, RunSummary(), masked)
    page = Page((out / "report.html").read_text(encoding="utf-8"))
    assert "moves with the camera: tripod, rig, hand 1 of 4" in page.words
    assert "set enabled: false in the stage masks.static" in page.words
    assert len([image for image in page.all("img") if "masked areas tinted" in image["alt"]]) == 3
    earlier = EarlierPage.of_file(out / "report.html")
    monkeypatch.setattr("pano_mvs.report.masked_areas.masked_kinds", lambda *_, **__: pytest.fail("examined again"))
    assert len(masked_areas(masked, earlier).pictures) == 3


def test_nothing_is_shown_without_masks(results: StoredValues, tmp_path: Path) -> None:
    assert masked_areas(results, EarlierPage()).counts == ()
    assert masked_areas(StoredValues(), EarlierPage()).counts == ()
    nothing = StaticMasks(np.zeros((0, 8, 16), np.uint8))
    assert masked_areas(with_masks(results, nothing), EarlierPage()).pictures == ()
    write_report(tmp_path, RunSummary(), results)
    assert "masked" not in {
        value for _, name, value in Page((tmp_path / "report.html").read_text()).attributes if name == "id"
    }


def test_a_mask_that_is_gone_is_named_and_no_failure(results: StoredValues, tiny: TinyCapture, tmp_path: Path) -> None:
    assert results.store is not None
    gone = tiny.each(Panorama)[tiny.names[0]].with_mask(np.zeros((32, 64), np.bool_), tmp_path)
    refs = {**results.refs["images"], tiny.names[0]: results.store.put_value(gone)}
    assert gone.mask_file is not None
    changed = replace(results, refs={**results.refs, "images": refs})
    panorama = changed.panorama(tiny.names[0])
    assert panorama is not None
    assert panorama.mask_file is not None
    panorama.mask_file.path.unlink()
    assert masked_areas(changed, EarlierPage()).examined == 3
    assert len(changed.notes) == 1


def test_of_many_panoramas_each_reason_has_its_largest_and_the_rest_are_spread() -> None:
    shares: dict[str, dict[str, float]] = {f"{idx}": {"sky": 0.2} for idx in range(60)}
    shares |= {"7": {"sky": 0.1, "static": 0.01}, "31": {"sky": 0.9}, "50": {}}
    chosen = chosen_pictures(shares)
    assert {"7", "31"} <= set(chosen)
    assert "50" not in chosen
    assert len(chosen) == 12
    assert chosen == sorted(chosen, key=int)
    assert int(chosen[-1]) == 59


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
