"""The page in a real browser: opened from the disk, without a server."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from pano_mvs.share import ShareOptions, share_run
from tests.share.box_run import box_run, frame_of_page
from tests.share.browser import Browser, open_browser
from tests.viewer.scenes import HALF

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    return share_run(box_run(folder, points=120_000), folder / "page", ShareOptions(title="Lobby")).page


@pytest.fixture(scope="module")
def window() -> Iterator[Browser]:
    with open_browser() as browser:
        yield browser


@pytest.fixture
def browser(window: Browser, page: Path) -> Browser:
    window.resize(1280, 720)
    window.open("about:blank")
    show(window, page.as_uri())
    return window


def show(browser: Browser, address: str) -> None:
    """Open the page and wait until it has drawn everything."""
    browser.open(address)
    settle(browser)


def settle(browser: Browser) -> None:
    browser.wait("PanoMvs.page && !PanoMvs.page.dirty && !PanoMvs.page.move && PanoMvs.page.cloud.loading === 0")


def place_of(browser: Browser, point_in_world: np.ndarray) -> tuple[float, float]:
    """Return the pixel of the window that shows a point."""
    x, y, z = frame_of_page().apply(point_in_world)
    shown = browser.evaluate(f"new THREE.Vector3({x}, {y}, {z}).project(PanoMvs.page.camera).toArray()")
    assert abs(shown[0]) < 1
    assert abs(shown[1]) < 1
    return (shown[0] + 1) / 2 * 1280, (1 - shown[1]) / 2 * 720


def measured(browser: Browser) -> float:
    text = browser.evaluate("document.getElementById('measured').textContent")
    found = re.match(r"Distance ([\d.]+) m", text)
    assert found is not None, text
    return float(found[1])


def test_the_cloud_is_drawn_and_the_console_is_empty(browser: Browser) -> None:
    picture = browser.screenshot()
    ground = picture[5, 700].astype(int)
    drawn = np.abs(picture[60:640].astype(int) - ground).sum(axis=-1) > 40
    assert picture.shape == (720, 1280, 3)
    assert drawn.mean() > 0.1
    assert browser.console() == []


def test_the_single_file_shows_the_same(browser: Browser, page: Path) -> None:
    folder_picture = browser.screenshot()
    show(browser, page.with_name("page.html").as_uri())
    single = browser.screenshot()
    assert (np.abs(single.astype(int) - folder_picture.astype(int)).sum(axis=-1) > 60).mean() < 0.01
    assert browser.console() == []


def test_a_panorama_is_seen_from_its_centre_the_right_way_round(browser: Browser) -> None:
    browser.evaluate("PanoMvs.page.stepInside(PanoMvs.page.panoramas[1], true)")
    browser.wait("PanoMvs.page.mode === 'inside'")
    settle(browser)
    picture = browser.screenshot()
    rotation = frame_of_page().rotation
    for x, y in [(300, 300), (900, 330), (640, 450)]:
        ray = np.array(browser.evaluate(f"PanoMvs.page.raycaster({x}, {y}).ray.direction.toArray()"))
        expected = 128 + 100 * (ray / np.linalg.norm(ray)) @ rotation
        assert picture[y, x] == pytest.approx(expected, abs=12)
    assert browser.console() == []


@pytest.mark.parametrize("mode", ["o", "p", "i"])
def test_clicks_on_known_places_give_known_distances(browser: Browser, mode: str) -> None:
    browser.press(mode)
    browser.wait(f"PanoMvs.page.mode.startsWith({mode!r})")
    settle(browser)
    browser.press("m")
    floor = HALF[1]
    first, second = np.array([-0.9, floor, -1.8]), np.array([0.8, floor, -2.6])
    if mode == "i":
        browser.evaluate("Object.assign(PanoMvs.page.look, {yaw: 0, pitch: -0.9, fov: 110}), PanoMvs.page.changed(), 0")
        here = browser.evaluate("PanoMvs.page.here.center.toArray()")
        below = frame_of_page().inverse().apply(here) * [1, 0, 1] + [0, floor, 0]
        ahead = -frame_of_page().rotation[2]
        first, second = below + 0.5 * ahead, below + 1.6 * ahead
        settle(browser)
    for point in (first, second):
        browser.click(*place_of(browser, point))
    assert measured(browser) == pytest.approx(np.linalg.norm(first - second), rel=0.03)
    assert browser.console() == []


def test_walking_ends_in_the_other_panorama_and_the_link_leads_there(browser: Browser) -> None:
    browser.press("i")
    browser.wait("PanoMvs.page.mode === 'inside'")
    settle(browser)
    start = browser.evaluate("PanoMvs.page.here.index")
    other = (start + 1) % 3
    browser.evaluate(f"PanoMvs.page.stepInside(PanoMvs.page.panoramas[{other}])")
    browser.wait(f"PanoMvs.page.here.index === {other} && location.hash.startsWith('#i={other},')")
    settle(browser)
    before, link = browser.screenshot(), browser.evaluate("location.href")
    browser.open("about:blank")
    show(browser, link)
    browser.wait("PanoMvs.page.mode === 'inside'")
    settle(browser)
    assert (np.abs(before.astype(int) - browser.screenshot().astype(int)).sum(axis=-1) > 60).mean() < 0.01
    browser.press("\ue00c")  # Escape
    browser.wait("PanoMvs.page.mode === 'overview'")


@pytest.mark.parametrize(("width", "height"), [(360, 640), (1600, 900)])
def test_everything_can_be_reached_on_small_and_large_windows(browser: Browser, width: int, height: int) -> None:
    browser.resize(width, height)
    browser.wait(f"Math.abs(PanoMvs.page.eye.aspect - {width / height}) < 0.001")
    settle(browser)
    buttons = browser.evaluate(
        "[...document.querySelectorAll('#tools button')].map((button) => button.getBoundingClientRect().toJSON())"
    )
    assert len(buttons) == 8
    for box in buttons:
        assert box["left"] >= 0
        assert box["right"] <= width
        assert box["bottom"] <= height
        assert box["height"] >= 36
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    browser.press("l")
    assert browser.evaluate("document.querySelectorAll('#panoramas button').length") == 3


def test_all_controls_have_names_and_the_theme_can_be_changed(browser: Browser) -> None:
    named = "(e) => e.textContent.trim() || e.getAttribute('aria-label') || e.getAttribute('aria-live')"
    controls = "[...document.querySelectorAll('button, canvas, nav, output')]"
    assert browser.evaluate(f"{controls}.filter({named}).length === {controls}.length")
    grounds = []
    for _ in range(2):
        browser.press("t")
        settle(browser)
        grounds.append(browser.screenshot()[5, 700].astype(int).sum())
    assert abs(grounds[0] - grounds[1]) > 300


def test_a_missing_file_is_named(browser: Browser, page: Path) -> None:
    tile = page.parent / "data" / "panorama" / "2" / "0-0-0.js"
    kept = tile.read_text()
    tile.unlink()
    try:
        browser.evaluate("PanoMvs.page.stepInside(PanoMvs.page.panoramas[2])")
        browser.wait("!document.getElementById('problem').hidden")
        assert "panorama/2/0-0-0.js is missing" in browser.evaluate("document.getElementById('problem').textContent")
    finally:
        tile.write_text(kept)
    browser.console()
