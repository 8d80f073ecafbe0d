"""The page in a headset, which an emulator stands for: one looks around and walks in it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from box_run import box_run, frame_of_page, wall_color, wall_range
from pano_mvs_page.scene_parts import ShareOptions
from pano_mvs_page.share import share_run

from tests.browsers.browser import Browser, open_browser
from tests.foreign import npm_packages

pytestmark = pytest.mark.browser

WIDTH, HEIGHT = 1280, 720  # of both eyes' pictures, side by side; each covers 90° from top to bottom
EYE_WIDTH, FOCAL = WIDTH // 2, HEIGHT / 2
CONTROLLER = "emulated.controllers.right"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    return share_run(box_run(folder, points=60_000, mesh=True), folder / "page", ShareOptions(title="Lobby")).page


@pytest.fixture(scope="module", params=["chromium", "firefox"])
def window(request: pytest.FixtureRequest) -> Iterator[Browser]:
    with open_browser(request.param, width=WIDTH, height=HEIGHT) as browser:
        yield browser


@pytest.fixture(scope="module")
def emulator(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The script of an emulator of headsets by Meta; the head is upright at first."""
    modules = npm_packages(tmp_path_factory.mktemp("npm"), "iwer@2.5.0")
    script = (modules / "iwer" / "build" / "iwer.min.js").read_text(encoding="utf-8")
    device = "new IWER.XRDevice(IWER.metaQuest3, {stereoEnabled: true, visibilityMask: null})"
    return f"{script}\nwindow.emulated = {device};\nemulated.installRuntime({{forceInstall: true}});"


@pytest.fixture
def headset(window: Browser, page: Path, emulator: str) -> Iterator[Browser]:
    """The page in a headset, which looks from the first panorama in the direction of the second one."""
    put_on(window, page, emulator)
    yield window
    assert window.console() == []


def put_on(browser: Browser, page: Path, emulator: str) -> None:
    end = browser.prelude(emulator)
    show(browser, page.as_uri())
    end()
    browser.wait("!document.getElementById('headset').hidden")
    browser.evaluate("PanoMvs.page.stepInside(PanoMvs.page.panoramas[0], true)")
    browser.evaluate(f"(PanoMvs.page.look.yaw = {yaw_to_second(browser)}, 0)")
    browser.wait("PanoMvs.page.settled")
    browser.evaluate("document.getElementById('headset').click()")
    browser.wait("PanoMvs.page.renderer.xr.isPresenting")
    settle(browser)


def show(browser: Browser, address: str) -> None:
    browser.open("about:blank")
    browser.open(address)
    browser.wait("typeof PanoMvs === 'object' && PanoMvs.page?.settled")


def yaw_to_second(browser: Browser) -> float:
    first, second = (center_of(browser, idx) for idx in (0, 1))
    x, _, z = second - first
    return float(np.arctan2(x, -z))


def center_of(browser: Browser, idx: int) -> np.ndarray:
    return np.array(browser.evaluate(f"PanoMvs.page.panoramas[{idx}].center.toArray()"))


def settle(browser: Browser) -> None:
    """Wait until the headset has shown some more frames, with all that belongs to them."""
    frames = """new Promise((done) => {
      let left = 3;
      (function next() { left-- ? PanoMvs.page.headset.session.requestAnimationFrame(next) : done(); })();
    })"""
    browser.evaluate(frames)
    browser.wait("!PanoMvs.page.here.loading && !PanoMvs.page.loading")
    browser.evaluate(frames)


def press(browser: Browser, button: str) -> None:
    for value in (1, 0):
        browser.evaluate(f"({CONTROLLER}.updateButtonValue('{button}', {value}), 0)")
        settle(browser)


def push(browser: Browser, x: float, y: float) -> None:
    """Push the thumb stick for some frames, and let it go."""
    for part in (1, 0):
        browser.evaluate(f"({CONTROLLER}.updateAxes('thumbstick', {x * part}, {y * part}), 0)")
        settle(browser)


def head(browser: Browser) -> np.ndarray:
    """Return the place between the eyes."""
    places = "PanoMvs.page.renderer.xr.getCamera().cameras.map(({matrixWorld}) => matrixWorld.elements.slice(12, 15))"
    return np.asarray(np.mean(browser.evaluate(places), axis=0))


def heading(browser: Browser) -> np.ndarray:
    return np.array(browser.evaluate("PanoMvs.page.headset.camera.getWorldDirection(new THREE.Vector3()).toArray()"))


def test_without_a_headset_there_is_no_button(window: Browser, page: Path) -> None:
    show(window, page.as_uri())
    window.evaluate("navigator.xr?.isSessionSupported('immersive-vr')")
    assert window.evaluate("document.getElementById('headset').hidden") is True


def test_each_eye_sees_the_room_from_its_place(headset: Browser) -> None:
    headset.evaluate("(emulated.ipd = 0.4, emulated.position.x += 0.2, emulated.position.y -= 0.1, 0)")
    yaw, world = yaw_to_second(headset), frame_of_page().inverse()
    ahead, up = np.array([np.sin(yaw), 0, -np.cos(yaw)]), np.array([0, 1, 0])
    right = np.cross(ahead, up)
    between = center_of(headset, 0) + 0.2 * right - 0.1 * up
    for shown, limit in (("panorama", 25), ("mesh", 40), ("cloud", 40)):
        if shown == "mesh":
            press(headset, "squeeze")
        if shown == "cloud":
            headset.evaluate("(PanoMvs.page.showSurface(false), 0)")
        settle(headset)
        picture = headset.screenshot().astype(float)
        apart = np.abs(picture[:, :EYE_WIDTH] - picture[:, EYE_WIDTH:]).sum(axis=-1)
        assert (apart > 20).mean() > 0.3, shown
        for column, side in ((0, -0.5), (EYE_WIDTH, 0.5)):
            eye = world.apply(between + side * 0.4 * right)
            for x, y in ((150, 150), (500, 420), (200, 560)):
                ray = ahead + (x + 0.5 - EYE_WIDTH / 2) / FOCAL * right - (y + 0.5 - HEIGHT / 2) / FOCAL * up
                direction = world.rotation @ (ray / np.linalg.norm(ray))
                wall = wall_color(eye + wall_range(eye, direction) * direction).astype(float)
                assert picture[y, x + column] == pytest.approx(wall, abs=limit), (shown, column, x, y)


@pytest.mark.parametrize("way", ["trigger", "thumb stick"])
def test_one_walks_to_the_panorama_ahead(headset: Browser, way: str) -> None:
    assert head(headset) == pytest.approx(center_of(headset, 0), abs=1e-3)
    if way == "trigger":
        press(headset, "trigger")
    else:
        push(headset, 0, -1)
    assert headset.evaluate("PanoMvs.page.here.index") == 1
    assert head(headset) == pytest.approx(center_of(headset, 1), abs=1e-3)


def test_the_thumb_stick_turns_by_30_degrees_for_each_push(headset: Browser) -> None:
    before = heading(headset)
    push(headset, 1, 0)
    after = heading(headset)
    assert np.rad2deg(np.arccos(before @ after)) == pytest.approx(30, abs=0.01)
    assert np.cross(before, after)[1] < 0  # to the right
    push(headset, -1, 0)
    assert heading(headset) == pytest.approx(before, abs=1e-4)


def test_without_metres_a_camera_stands_as_high_as_a_person_sees(
    window: Browser, emulator: str, tmp_path: Path
) -> None:
    shared = share_run(box_run(tmp_path, metric=False), tmp_path / "page", ShareOptions(title="Lobby"))
    put_on(window, shared.page, emulator)
    before, world = head(window), frame_of_page().inverse()
    assert before == pytest.approx(center_of(window, 0), abs=1e-3)
    window.evaluate("(emulated.position.y -= 1.6, 0)")  # down to the floor
    settle(window)
    down = world.rotation @ np.array([0.0, -1.0, 0.0])
    height = float(wall_range(world.apply(before), down))
    assert head(window) == pytest.approx(before - [0, height, 0], rel=0.02, abs=1e-3)
    assert window.console() == []


def test_the_page_is_as_before_once_the_headset_is_taken_off(headset: Browser, page: Path) -> None:
    yaw = headset.evaluate("PanoMvs.page.look.yaw")
    push(headset, 1, 0)
    headset.evaluate("PanoMvs.page.headset.session.end()")
    # The emulator puts the canvas in front of all that the page shows over it, and not where it was.
    headset.evaluate("(document.querySelector('main').prepend(PanoMvs.page.canvas), PanoMvs.page.changed())")
    headset.wait("!PanoMvs.page.renderer.xr.isPresenting && PanoMvs.page.settled")
    assert headset.evaluate("[PanoMvs.page.here.index, PanoMvs.page.look.yaw]") == [0, yaw]
    headset.evaluate("(document.getElementById('headset').hidden = true, 0)")  # as without the emulator
    shown = headset.screenshot().astype(float)
    link = headset.evaluate("(PanoMvs.page.writeLink(), PanoMvs.page.link)")
    show(headset, page.as_uri() + link)
    assert (np.abs(shown - headset.screenshot()).max(axis=-1) > 20).mean() < 0.01
