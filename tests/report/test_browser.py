"""The report in a real browser, opened from the disk: the cloud turns, and everything fits and can be read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from pano_mvs.engine.cache.store import Store
from pano_mvs.report import write_report
from pano_mvs.results.summary import RunSummary
from pano_mvs.scene import Panorama
from pano_mvs.testing.tiny_capture import TinyCapture
from tests.browsers.chromium import Chromium, chromium
from tests.report.conftest import stored, summary_of
from tests.report.test_results import farther
from tests.synthetic.viewed_scenes import box_cloud

GROUND = "getComputedStyle(document.querySelector('#viewer canvas')).backgroundColor.match(/\\d+/g).map(Number)"

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, tiny: TinyCapture) -> Path:
    """A report with a cloud of a box, masked areas, a doubtful camera, suggestions, and views on two scales."""
    out = tmp_path_factory.mktemp("report")
    values = farther(stored(Store(out / "cache"), tiny), tiny)
    assert values.store is not None
    capped = replace(tiny.each(Panorama)[tiny.names[0]], nadir_deg=45.0)
    images = {**values.refs["images"], tiny.names[0]: values.store.put_value(capped)}
    cloud = {"": values.store.put_value(box_cloud(40_000, quality=False))}
    values = replace(values, refs={**values.refs, "images": images, "cloud": cloud})
    summary = summary_of(tiny)
    summary["poses"] |= {"doubts": {tiny.names[1]: "hardly confirmed"}}
    write_report(out, RunSummary.from_json(summary), values)
    return out / "report.html"


@pytest.fixture(scope="module")
def window() -> Iterator[Chromium]:
    with chromium(width=1200, height=900) as browser:
        yield browser


def opened(window: Chromium, page: Path) -> None:
    """Open the report and wait for its viewer; a busy machine does not always give a context to draw in at once."""
    for _ in range(3):
        window.open(page.as_uri())
        if not window.evaluate("document.getElementById('viewer').hidden"):
            return
    pytest.fail(f"no viewer; console: {window.console()}")


@pytest.fixture
def browser(window: Chromium, page: Path) -> Iterator[Chromium]:
    window.resize(1200, 900)
    opened(window, page)
    yield window
    assert window.console() == []
    window.command("Emulation.setEmulatedMedia", media="", features=[])


def cloud_of(browser: Chromium) -> NDArray[np.int64]:
    """Return the part of the window that shows the cloud."""
    browser.wait("!document.getElementById('viewer').hidden && document.readyState === 'complete'")
    browser.evaluate(
        "document.querySelector('#viewer canvas').scrollIntoView({block: 'center', behavior: 'instant'}),"
        " new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(() => done(0))))"
    )
    box: dict[str, Any] = browser.evaluate("document.querySelector('#viewer canvas').getBoundingClientRect().toJSON()")
    top, left = round(box["top"]), round(box["left"])
    picture = browser.screenshot()[top : top + round(box["height"]), left : left + round(box["width"])]
    return picture.astype(np.int64)


def changed(first: NDArray[np.int64], second: NDArray[np.int64]) -> float:
    """Return the share of pixels that differ clearly."""
    return float((np.abs(first - second).sum(axis=-1) > 60).mean())


def drag(browser: Chromium, across: int, down: int) -> None:
    box = browser.evaluate("document.querySelector('#viewer canvas').getBoundingClientRect().toJSON()")
    x, y = box["left"] + box["width"] / 2, box["top"] + box["height"] / 2
    for kind, place in (
        ("mousePressed", (x, y)),
        ("mouseMoved", (x + across, y + down)),
        ("mouseReleased", (x + across, y + down)),
    ):
        browser.command(
            "Input.dispatchMouseEvent", type=kind, x=place[0], y=place[1], button="left", buttons=1, clickCount=1
        )


def test_the_cloud_is_drawn_and_can_be_turned(browser: Chromium) -> None:
    first = cloud_of(browser)
    ground = first[5, 5]
    assert (np.abs(first - ground).sum(axis=-1) > 40).mean() > 0.15
    assert changed(first, cloud_of(browser)) < 0.001, "nothing moves by itself"
    drag(browser, 150, 0)
    turned = cloud_of(browser)
    assert changed(first, turned) > 0.1
    drag(browser, -150, 0)
    assert changed(first, cloud_of(browser)) < 0.02


def test_the_cloud_is_turned_by_keys_and_seen_from_other_places(browser: Chromium) -> None:
    pictures = [cloud_of(browser)]
    browser.evaluate("document.querySelector('#viewer canvas').focus(), 0")
    for _ in range(4):
        browser.press("\ue014")  # arrow to the right
    pictures.append(cloud_of(browser))
    for name in ("above", "inside", "farther", "cameras"):
        browser.evaluate(f"document.getElementById('viewer-{name}').click(), 0")
        pictures.append(cloud_of(browser))
        if name == "inside":
            assert "Where 000.png was taken" in browser.evaluate("document.getElementById('viewer-place').textContent")
    limits = (0.1, 0.1, 0.1, 0.05, 0.0001)
    for before, after, limit in zip(pictures[:-1], pictures[1:], limits, strict=True):
        assert changed(before, after) > limit


def test_inside_the_picture_is_not_mirrored(browser: Chromium, tiny: TinyCapture) -> None:
    """Walls are coloured by their place: red grows to the right of a camera that looks along +z of the world."""
    for name in ("inside", "cameras"):
        browser.evaluate(f"document.getElementById('viewer-{name}').click(), 0")
    assert "was taken" in browser.evaluate("document.getElementById('viewer-place').textContent")
    ground = np.array(browser.evaluate(GROUND))
    seen = []
    for _ in range(30):
        picture = cloud_of(browser)
        band = picture[picture.shape[0] // 2 - 20 : picture.shape[0] // 2 + 20]
        thirds = [
            part[np.abs(part - ground).sum(axis=-1) > 40].mean(axis=0) for part in np.array_split(band, 3, axis=1)
        ]
        left, centre, right = thirds
        seen.append(centre.round().tolist())
        if centre[2] > 190 and abs(centre[0] - 128) < 40:  # blue grows along z
            assert left[0] + 30 < centre[0] < right[0] - 30
            return
        browser.evaluate("document.querySelector('#viewer canvas').focus(), 0")
        browser.press("\ue014")
        browser.press("\ue014")
    pytest.fail(f"the wall ahead was not found: {seen}")


@pytest.mark.parametrize("width", [360, 800, 1600])
@pytest.mark.parametrize("theme", ["light", "dark"])
def test_everything_fits_and_text_is_large_enough(browser: Chromium, page: Path, width: int, theme: str) -> None:
    browser.command("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": theme}])
    browser.resize(width, 900)
    opened(browser, page)
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    small = browser.evaluate(
        "[...document.querySelectorAll('svg text')].map((text) => [text.textContent,"
        " parseFloat(getComputedStyle(text).fontSize) * text.getScreenCTM().a]).filter((pair) => pair[1] < 11.9)"
    )
    assert small == []
    clipped = browser.evaluate(
        "[...document.querySelectorAll('svg text')].filter((text) => { const own = text.getBoundingClientRect(),"
        " all = text.ownerSVGElement.getBoundingClientRect();"
        " return own.left < all.left - 1 || own.right > all.right + 1 || own.top < all.top - 1; })"
        ".map((text) => text.textContent)"
    )
    assert clipped == []
    tiny_text = browser.evaluate(
        "[...document.querySelectorAll('p, span, td, th, dd, li, button, b, figcaption')].filter((e) =>"
        " e.textContent.trim() && parseFloat(getComputedStyle(e).fontSize) < 12).length"
    )
    assert tiny_text == 0


def test_the_scale_of_the_range_maps_is_switched_by_the_keyboard(browser: Chromium) -> None:
    shown = "[...document.querySelectorAll('.view .own')].filter((e) => getComputedStyle(e).display !== 'none').length"
    assert browser.evaluate(shown) == 0
    browser.evaluate("document.getElementById('own-scale').focus(), 0")
    browser.press(" ")
    assert browser.evaluate(shown) >= 2, "an image and its scale"
    common = "[...document.querySelectorAll('.view .common')].every((e) => getComputedStyle(e).display === 'none')"
    assert browser.evaluate(common)


def test_in_print_the_images_of_the_cloud_take_the_place_of_the_viewer(browser: Chromium) -> None:
    display = (
        "['#viewer', '.clouds', '#own-scale'].map((name) => getComputedStyle(document.querySelector(name)).display)"
    )
    viewer, images, _ = browser.evaluate(display)
    assert (viewer != "none", images) == (True, "none")
    browser.command("Emulation.setEmulatedMedia", media="print")
    viewer, images, switch = browser.evaluate(display)
    assert (viewer, images != "none", switch) == ("none", True, "none")


def test_without_webgl_the_images_remain(browser: Chromium, page: Path) -> None:
    script = "HTMLCanvasElement.prototype.getContext = function () { return null; };"
    added = browser.command("Page.addScriptToEvaluateOnNewDocument", source=script)
    browser.open(page.as_uri())
    assert browser.evaluate("document.getElementById('viewer').hidden")
    assert browser.evaluate("getComputedStyle(document.querySelector('.clouds')).display") != "none"
    browser.command("Page.removeScriptToEvaluateOnNewDocument", identifier=added["identifier"])


def test_all_controls_have_names(browser: Chromium) -> None:
    nameless = browser.evaluate(
        "[...document.querySelectorAll('button, input, canvas, select')].filter((e) => !e.textContent.trim() &&"
        " !e.getAttribute('aria-label') && !(e.labels && e.labels.length)).map((e) => e.outerHTML.slice(0, 80))"
    )
    assert nameless == []


def test_a_view_is_compared_with_what_is_shown_over_it(browser: Chromium) -> None:
    browser.evaluate("document.querySelector('.slider').focus(), 0")
    clip = "getComputedStyle(document.querySelector('.laid .pane.range')).clipPath"
    before = browser.evaluate(clip)
    browser.press("\ue012")  # arrow to the left
    assert browser.evaluate(clip) != before
    browser.evaluate("document.querySelector('.tabs').lastElementChild.click(), 0")
    assert browser.evaluate(clip.replace(".clipPath", ".display")) == "none"
    label = browser.evaluate("document.querySelector('.slider').getAttribute('aria-label')")
    assert label == "000.png: panorama left of the line, confidence right of it"


def test_panoramas_are_found_by_a_part_of_their_names(browser: Chromium) -> None:
    shown = "[...document.querySelectorAll('#rows tr b')].map((name) => name.textContent)"
    assert len(browser.evaluate(shown)) == 4
    find = "Object.assign(document.getElementById('find'), {value: VALUE}).dispatchEvent(new Event('input'))"
    browser.evaluate(find.replace("VALUE", "'02.p'"))
    assert browser.evaluate(shown) == ["002.png"]
    browser.evaluate(find.replace("VALUE", "'nothing'"))
    assert browser.evaluate("document.getElementById('page').textContent") == "none found"
