"""The page in real browsers: opened from the disk, without a server."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator, Sequence
from importlib.resources import files
from pathlib import Path

import cv2
import numpy as np
import pytest
from box_run import (
    NAMES,
    POINT_SIGMA,
    RELATIVE_SIGMA,
    box_mesh,
    box_run,
    frame_of_page,
    wall_color,
    wall_range,
)
from pano_mvs_page.encoding import encode_jpeg
from pano_mvs_page.page_folder import PageFolder
from pano_mvs_page.scene_parts import RANGES_HW, ShareOptions
from pano_mvs_page.share import share_run

from pano_mvs.scene.image_file import decode_image, write_png
from tests.browsers.browser import Browser, open_browser
from tests.browsers.server import served
from tests.synthetic.viewed_scenes import HALF


def large_page(folder: Path, *, panoramas: int, levels: int, present: Sequence[int]) -> Path:
    """Write the page and return its path; of four levels, the largest is 8192 pixels wide.

    The tiles have few pixels, but their number and names are those of real ones.

    Args:
        folder: a new folder.
        panoramas: their number.
        levels: of each panorama.
        present: the panoramas whose tiles are written; those of the others are missing.
    """
    page = PageFolder(folder)
    tile = encode_jpeg(np.full((8, 8, 3), 120, np.uint8), 80)
    cameras = []
    for idx in range(panoramas):
        for level in range(levels if idx in present else 0):
            for row in range(max(1, 1 << level >> 1)):
                for column in range(1 << level):
                    page.put(f"panorama/{idx}/{level}-{column}-{row}", tile)
        center = [float(idx % 20), 0.0, float(idx // 20)]
        camera = {"name": f"{idx:03}.jpg", "center": center, "page_from_cam": np.diag([1.0, -1.0, -1.0]).tolist()}
        tiles = {"levels": levels, "width": 1024 << levels >> 1}
        cameras.append({**camera, **tiles, "ranges": None, "sigmas": None, "room": ""})
    scene = {"title": "Many", "unit": "m", "cameras": cameras, "ranges": list(RANGES_HW), "nodes": [], "bounds": []}
    page.put("scene", {**scene, "outline": [], "sigmas": [1, 2], "coverage": False, "mesh": None, "maps": []})
    page.finish("Many", max_single_file_bytes=0)
    return folder / "index.html"


_RUN = """axe.run(document, { resultTypes: ["violations"], preload: false }).then(({ violations }) =>
  violations.flatMap(({ id, nodes }) => nodes.map(({ html }) => `${id}: ${html.slice(0, 160)}`)))"""


def barriers(browser: Browser) -> list[str]:
    """Return what axe-core finds wrong with the page as it is now: the rule, and the element."""
    if not browser.evaluate("typeof axe === 'object'"):
        script = (files("axe_playwright_python") / "axe.min.js").read_text(encoding="utf-8")
        browser.evaluate(f"(() => {{ {script}\n }})()")
    return list(browser.evaluate(_RUN))


pytestmark = pytest.mark.browser

ESCAPE, ENTER, TAB, SHIFT = "\ue00c", "\ue007", "\ue004", "\ue008"
LEFT, UP, RIGHT, DOWN = "\ue012", "\ue013", "\ue014", "\ue015"
PAGE_UP, PAGE_DOWN = "\ue00e", "\ue00f"
TOOLS = 10
PHONE, DESKTOP = (390, 844), (1280, 720)


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("page")
    return share_run(box_run(folder, points=60_000, mesh=True), folder / "page", ShareOptions(title="Lobby")).page


@pytest.fixture(scope="module", params=["chromium", "firefox"])
def window(request: pytest.FixtureRequest) -> Iterator[Browser]:
    with open_browser(request.param) as browser:
        yield browser


@pytest.fixture
def browser(window: Browser, page: Path) -> Browser:
    window.resize(1280, 720)
    show(window, page.as_uri())
    return window


def show(browser: Browser, address: str) -> None:
    """Open the page and wait until it has drawn everything."""
    browser.open("about:blank")
    browser.open(address)
    browser.wait("typeof PanoMvs === 'object' && PanoMvs.page")
    settle(browser)


def settle(browser: Browser) -> None:
    browser.wait("PanoMvs.page.settled")


def step_inside(browser: Browser, index: int) -> None:
    browser.evaluate(f"PanoMvs.page.stepInside(PanoMvs.page.panoramas[{index}], true)")
    browser.wait(f"PanoMvs.page.mode === 'inside' && PanoMvs.page.here.index === {index}")
    settle(browser)


def place_of(browser: Browser, point_in_world: np.ndarray) -> tuple[float, float]:
    """Return the pixel of the window that shows a point."""
    x, y, z = frame_of_page().apply(point_in_world)
    shown = browser.evaluate(f"new THREE.Vector3({x}, {y}, {z}).project(PanoMvs.page.camera).toArray()")
    assert abs(shown[0]) < 1
    assert abs(shown[1]) < 1
    return (shown[0] + 1) / 2 * 1280, (1 - shown[1]) / 2 * 720


def expected_color(browser: Browser, x: int, y: int) -> np.ndarray:
    """Return the colour of the wall that a pixel of the window shows."""
    ray = "((ray) => [...ray.origin.toArray(), ...ray.direction.toArray()])"
    origin, direction = np.array(browser.evaluate(f"{ray}(PanoMvs.page.raycaster({x}, {y}).ray)")).reshape(2, 3)
    frame = frame_of_page().inverse()
    eye, ahead = frame.apply(origin), frame.rotation @ direction
    return wall_color(eye + wall_range(eye, ahead) * ahead).astype(float)


def measured(browser: Browser) -> tuple[float, float]:
    text = browser.evaluate("document.getElementById('measured').textContent")
    found = re.match(r"Distance ([\d.]+) m ± ([\d.]+):", text)
    assert found is not None, text
    return float(found[1]), float(found[2])


def differing(first: np.ndarray, second: np.ndarray) -> float:
    """Return the share of the pixels that differ clearly."""
    return float((np.abs(first.astype(int) - second.astype(int)).sum(axis=-1) > 60).mean())


def test_surface_and_cloud_are_drawn_and_the_console_is_empty(browser: Browser) -> None:
    surface = browser.screenshot()
    assert surface.shape == (720, 1280, 3)
    browser.press("s")
    settle(browser)
    cloud = browser.screenshot()
    for picture in (surface, cloud):
        ground = picture[5, 700].astype(int)
        assert (np.abs(picture[60:640].astype(int) - ground).sum(axis=-1) > 40).mean() > 0.1
    assert 0.001 < differing(surface, cloud) < 0.15
    assert browser.console() == []


def projected(browser: Browser) -> np.ndarray:
    """Return the corners and all other vertices of the mesh, (N, 2), in the window from -1 to 1."""
    matrices = "[PanoMvs.page.eye.projectionMatrix, PanoMvs.page.eye.matrixWorldInverse].map((each) => each.elements)"
    projection, view = np.array(browser.evaluate(matrices)).reshape(2, 4, 4).transpose(0, 2, 1)
    points = frame_of_page().apply(box_mesh()[0].astype(float))
    clip = np.column_stack([points, np.ones(len(points))]) @ (projection @ view).T
    assert (clip[:, 3] > 0).all()
    return np.asarray(clip[:, :2] / clip[:, 3:])


def test_the_page_opens_with_all_of_the_capture_in_the_window(browser: Browser, page: Path) -> None:
    for width, height in (DESKTOP, PHONE, PHONE[::-1]):
        browser.resize(width, height)
        show(browser, page.as_uri())
        for _ in ("as opened", "in a window of another shape"):
            places = projected(browser)
            assert (np.abs(places) < 1).all(axis=-1).mean() > 0.99
            tools = browser.evaluate("document.getElementById('tools').getBoundingClientRect().top")
            free = (tools - 50) / browser.evaluate("innerHeight")  # between the heading and the buttons
            filled = np.ptp(places, axis=0) / 2 / (1, free)
            assert filled.max() > 0.9
            assert filled.prod() > 0.3
            assert places[:, 1].min() > 0.95 - 2 * tools / browser.evaluate("innerHeight")
            browser.resize(height, width)
            browser.wait(f"Math.abs(PanoMvs.page.eye.aspect - {height / width}) < 0.001")
            settle(browser)


def test_the_single_file_shows_the_same(browser: Browser, page: Path) -> None:
    folder_picture = browser.screenshot()
    show(browser, page.with_name("page.html").as_uri())
    assert differing(browser.screenshot(), folder_picture) < 0.01
    assert browser.console() == []


def test_a_notebook_shows_the_page_in_a_frame_that_cannot_reach_it(browser: Browser, tmp_path: Path) -> None:
    shown = share_run(box_run(tmp_path, points=20_000), tmp_path / "page")._repr_html_()
    (tmp_path / "notebook.html").write_text(f"<!DOCTYPE html><title>before</title><body>{shown}", encoding="utf-8")
    browser.open((tmp_path / "notebook.html").as_uri())
    end = time.monotonic() + 60
    while browser.screenshot()[200:400, 400:800].std() < 10:  # the script of this page cannot ask the frame
        assert time.monotonic() < end, browser.console()
        time.sleep(0.2)
    assert browser.evaluate("document.querySelector('iframe').contentDocument") is None
    assert browser.console() == []


def test_a_panorama_is_seen_from_its_centre_the_right_way_round(browser: Browser) -> None:
    step_inside(browser, 1)
    picture = browser.screenshot()
    for x, y in [(300, 300), (900, 330), (640, 450)]:
        assert picture[y, x] == pytest.approx(expected_color(browser, x, y), abs=12)
    assert browser.console() == []


@pytest.mark.parametrize("part", [0.2, 0.5, 0.8])
def test_the_middle_of_a_walk_shows_the_room_from_there(browser: Browser, part: float) -> None:
    step_inside(browser, 0)
    browser.evaluate("PanoMvs.page.panoramas[2].open().then(() => 0)")
    browser.evaluate(
        f"""(({{panoramas: [from, , to]}}) => {{
          const began = performance.now() - {part} * 1e9, start = from.center.clone();
          Object.assign(PanoMvs.page, {{ here: to, move: {{ from, to, start, began, length: 1e9, flight: false }} }});
        }})(PanoMvs.page)"""
    )
    browser.wait("PanoMvs.page.eye.position.distanceTo(PanoMvs.page.panoramas[0].center) > 0.05")
    picture = browser.screenshot()
    for x, y in [(200, 200), (500, 330), (640, 500), (900, 330)]:
        assert picture[y, x] == pytest.approx(expected_color(browser, x, y), abs=14), (x, y)
    assert browser.console() == []


@pytest.mark.parametrize(("mode", "surface"), [("o", True), ("o", False), ("p", True), ("i", True)])
def test_clicks_on_known_places_give_known_distances(browser: Browser, mode: str, surface: bool) -> None:
    if not surface:
        browser.press("s")
    browser.press(mode)
    browser.wait(f"PanoMvs.page.mode.startsWith({mode!r})")
    settle(browser)
    browser.press("m")
    floor = HALF[1]
    first, second = np.array([-0.9, floor, -1.8]), np.array([0.8, floor, -2.6])
    sigma = np.sqrt(2) * POINT_SIGMA
    if mode == "i":
        browser.evaluate("Object.assign(PanoMvs.page.look, {yaw: 0, pitch: -0.9, fov: 110}), PanoMvs.page.changed(), 0")
        here = browser.evaluate("PanoMvs.page.here.center.toArray()")
        below = frame_of_page().inverse().apply(here) * [1, 0, 1] + [0, floor, 0]
        ahead = -frame_of_page().rotation[2]
        first, second = below + 0.5 * ahead, below + 1.6 * ahead
        height = np.linalg.norm(frame_of_page().inverse().apply(here) - below)
        sigma = RELATIVE_SIGMA * np.hypot(0.5, 1.6)  # range times the part of the error that lies along the floor
        assert height > 0.3
        settle(browser)
    for point in (first, second):
        browser.click(*place_of(browser, point))
    length, uncertainty = measured(browser)
    assert length == pytest.approx(np.linalg.norm(first - second), rel=0.03)
    assert sigma * 0.97 < uncertainty < sigma + 0.012
    assert browser.console() == []


def test_a_link_keeps_the_panorama_the_direction_and_the_measured_distance(browser: Browser) -> None:
    step_inside(browser, 0)
    browser.evaluate("Object.assign(PanoMvs.page.look, {pitch: -0.7}), PanoMvs.page.changed(), 0")
    browser.press("m")
    for x in (560, 760):
        browser.click(x, 480)
    told = measured(browser)
    settle(browser)
    before, link = browser.screenshot(), browser.evaluate("location.href")
    show(browser, link)
    assert browser.evaluate("[PanoMvs.page.mode, PanoMvs.page.here.index]") == ["inside", 0]
    assert measured(browser) == told
    assert differing(before, browser.screenshot()) < 0.01


@pytest.mark.parametrize("inside", [False, True])
def test_a_link_leads_to_a_single_marked_point(browser: Browser, inside: bool) -> None:
    if inside:
        step_inside(browser, 0)
    browser.press("m")
    browser.click(*((700, 420) if inside else place_of(browser, np.array([-0.9, HALF[1], -1.8]))))
    said = "document.getElementById('measured').textContent"
    marked, told = browser.evaluate("PanoMvs.page.ruler.picks[0].point.toArray()"), browser.evaluate(said)
    assert told.startswith("One point is marked")
    assert ("from this panorama" in told) == inside
    settle(browser)
    before, link = browser.screenshot(), browser.evaluate("location.href")
    show(browser, link)
    assert browser.evaluate("PanoMvs.page.ruler.picks.map(({point}) => point.toArray())") == [
        pytest.approx(marked, rel=1e-4)
    ]
    assert browser.evaluate(said) == told
    assert browser.evaluate("document.querySelector('#labels div').textContent") == "Marked point"
    assert differing(before, browser.screenshot()) < 0.01
    assert browser.console() == []


def test_a_keyboard_walks_turns_moves_and_measures(browser: Browser) -> None:
    place, facing = (f"document.getElementById('{name}').textContent" for name in ("place", "facing"))
    browser.press(TAB)
    assert browser.evaluate("document.activeElement.id") == "canvas"
    target = browser.evaluate("PanoMvs.page.orbit.target.toArray()")
    browser.press(RIGHT, holding=SHIFT)
    assert np.linalg.norm(np.subtract(browser.evaluate("PanoMvs.page.orbit.target.toArray()"), target)) > 0.1
    browser.press(ENTER)
    browser.wait("PanoMvs.page.mode === 'inside' && PanoMvs.page.settled")
    first = browser.evaluate("PanoMvs.page.here.camera.name")
    assert browser.evaluate(place) == first
    for _ in range(60):
        browser.wait(f"{facing}.startsWith('Facing')", seconds=10)
        if "Enter walks to" in browser.evaluate(facing):
            break
        browser.evaluate("document.getElementById('facing').textContent = ''")
        browser.press(RIGHT)
    other = re.search(r"Enter walks to (\S+), ([\d.]+) m away", browser.evaluate(facing))
    assert other is not None
    browser.press(ENTER)
    browser.wait("!PanoMvs.page.move && PanoMvs.page.settled")
    assert browser.evaluate(place) == other[1] != first
    browser.press("m")
    assert browser.evaluate("document.getElementById('aim').hidden") is False
    ends = []
    for key in (DOWN, RIGHT):
        for _ in range(4):
            browser.press(key)
        settle(browser)
        browser.press(ENTER)
        ray = "((ray) => [...ray.origin.toArray(), ...ray.direction.toArray()])"
        origin, direction = np.array(browser.evaluate(f"{ray}(PanoMvs.page.raycaster(640, 360).ray)")).reshape(2, 3)
        world = frame_of_page().inverse()
        eye, ahead = world.apply(origin), world.rotation @ direction
        ends.append(eye + wall_range(eye, ahead) * ahead)
    assert measured(browser)[0] == pytest.approx(np.linalg.norm(ends[0] - ends[1]), rel=0.03)
    browser.press(ESCAPE)
    assert browser.evaluate("document.getElementById('aim').hidden") is True
    browser.press(ESCAPE)
    browser.wait("PanoMvs.page.mode === 'overview'")
    browser.press("l")
    assert browser.evaluate("document.activeElement.textContent") == "lobby/000.png"
    browser.press(TAB)
    browser.press(ENTER)
    browser.wait("PanoMvs.page.here?.index === 1 && PanoMvs.page.settled")
    browser.press(PAGE_DOWN)
    browser.wait("PanoMvs.page.here?.index === 2 && PanoMvs.page.settled")
    browser.press(PAGE_UP)
    browser.wait("PanoMvs.page.here?.index === 1 && PanoMvs.page.settled")
    browser.press(ESCAPE)
    assert browser.evaluate("document.getElementById('panoramas').hidden") is True
    assert browser.console() == []


@pytest.mark.parametrize("size", [DESKTOP, PHONE])
def test_axe_finds_no_barrier_in_any_panel(browser: Browser, size: tuple[int, int]) -> None:
    browser.resize(*size)
    settle(browser)
    found = {}
    for _ in ("dark", "light"):
        for keys in ("", "?", "l", "n", "m", "c", "p", "i"):
            for key in keys:
                browser.press(key)
            if keys == "i":
                browser.wait("PanoMvs.page.mode === 'inside' && PanoMvs.page.settled")
            settle(browser)
            theme = browser.evaluate("document.documentElement.dataset.theme ?? ''")
            if said := barriers(browser):
                found[theme, keys] = said
            for key in keys if keys in ("?", "l", "n", "m", "c") else ("o" if keys else ""):
                browser.press(key)
        browser.press("t")
    assert found == {}
    assert browser.console() == []


@pytest.fixture(scope="module")
def large_room(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A page many times as large as what is shown first, of noise, which does not shrink."""
    folder = tmp_path_factory.mktemp("room")
    run = box_run(folder, points=500_000, mesh=90)
    rng = np.random.default_rng(0)
    for name in NAMES:
        image = cv2.resize(decode_image(folder / "images" / name), (2688, 1344)) + rng.normal(0, 8, (1344, 2688, 1))
        write_png(folder / "images" / name, np.rint(image).clip(0, 255).astype(np.uint8))
    shared = share_run(run, folder / "page", ShareOptions(title="Room"))
    assert shared.total_bytes > 12_000_000
    assert shared.triangles > 90_000
    return shared.page.parent


@pytest.mark.parametrize(
    ("link", "needed"),
    [
        ("", r"scene\.js|mesh/coarse/"),
        ("#s=0&o=3,4,5,0,0,0", r"scene\.js|cloud/r\.js"),
        ("#i=1,0.5,-0.1,80", r"scene\.js|panorama/1/(0-0-0|ranges|sigmas)\.js"),
    ],
)
def test_three_megabytes_show_the_whole_room(window: Browser, large_room: Path, link: str, needed: str) -> None:
    """What more there is makes the picture finer, and is not even asked for before."""
    window.resize(1280, 720)
    window.open("about:blank")
    with served(large_room) as server:
        window.open(server.address + link)
        settle(window)
        limit = window.evaluate("PanoMvs.page.firstPicture")
        entries = "performance.getEntriesByType('resource').map(({name, startTime}) => [name, startTime])"
        early = [name.removeprefix(server.address) for name, at in window.evaluate(entries) if at < limit]
        data = [name for name in early if name.startswith("data/")]
        assert data
        assert all(re.search(needed, name) for name in data)
        assert sum((large_room / name).stat().st_size for name in ["index.html", *early]) < 3_000_000, early
        assert len(window.evaluate("PanoMvs.loaded")) > len(data)
        assert window.console() == []
        window.open("about:blank")


def test_a_link_keeps_points_and_coverage(browser: Browser) -> None:
    for key in ("s", "c", "\ue012"):  # arrow to the left
        browser.press(key)
    settle(browser)
    before, link = browser.screenshot(), browser.evaluate("location.href")
    show(browser, link)
    assert browser.evaluate("[PanoMvs.page.surfaceShown, PanoMvs.page.covered]") == [False, True]
    assert differing(before, browser.screenshot()) < 0.01


def test_walking_ends_in_the_other_panorama_and_escape_leads_out(browser: Browser) -> None:
    step_inside(browser, 0)
    browser.evaluate(
        "(() => {"
        "window.moved = false;"
        "(function watch() { PanoMvs.page.move ? window.moved = true : requestAnimationFrame(watch) })();"
        "PanoMvs.page.stepInside(PanoMvs.page.panoramas[1]);"
        "})()"
    )
    browser.wait("window.moved")  # a look from here can miss the whole move
    browser.wait("PanoMvs.page.here.index === 1 && location.hash.startsWith('#i=1,') && PanoMvs.page.settled")
    assert browser.evaluate("PanoMvs.page.eye.position.distanceTo(PanoMvs.page.here.center)") < 1e-6
    browser.press(ESCAPE)
    browser.wait("PanoMvs.page.mode === 'overview'")


def test_a_click_on_the_map_leads_into_a_panorama(browser: Browser) -> None:
    boxes = browser.evaluate(
        "[...document.querySelectorAll('#places button')].map((b) => [b.ariaLabel, b.getBoundingClientRect().toJSON()])"
    )
    assert [name for name, _ in boxes] == ["lobby/000.png", "lobby/001.png", "lobby/002.png"]
    picture = browser.evaluate("(({left, top, width, height}) => [left, top, width, height])("
                               "document.querySelector('#places img').getBoundingClientRect())")  # fmt: skip
    lower, upper = browser.evaluate(
        "(([x, z, w, , , h]) => [[x, z], [x + w, z + h]])(PanoMvs.page.map.shown.page_from_map)"
    )
    centers = np.array(browser.evaluate("PanoMvs.page.panoramas.map(({center}) => [center.x, center.z])"))
    expected = np.array(picture[:2]) + (centers - lower) / np.subtract(upper, lower) * picture[2:]
    middles = [(box["left"] + box["width"] / 2, box["top"] + box["height"] / 2) for _, box in boxes]
    assert np.array(middles) == pytest.approx(expected, abs=1)
    browser.click(*middles[2])
    browser.wait("PanoMvs.page.mode === 'inside' && PanoMvs.page.here.index === 2 && PanoMvs.page.settled")
    you = browser.evaluate("document.getElementById('you').getBoundingClientRect().toJSON()")
    assert abs(you["left"] + you["width"] / 2 - middles[2][0]) < 25
    assert browser.evaluate("document.querySelector('#places [aria-current=true]').ariaLabel") == "lobby/002.png"


def test_fingers_turn_and_zoom(browser: Browser) -> None:
    distance = "PanoMvs.page.eye.position.distanceTo(PanoMvs.page.orbit.target)"
    before = browser.evaluate(distance)
    browser.pinch((600, 350), 100, 300)
    assert browser.evaluate(distance) < 0.6 * before
    step_inside(browser, 1)
    yaw, fov = browser.evaluate("[PanoMvs.page.look.yaw, PanoMvs.page.look.fov]")
    browser.drag((700, 350), (500, 350), kind="touch")
    assert browser.evaluate("PanoMvs.page.look.yaw") == pytest.approx(yaw + np.deg2rad(fov) * 200 / 720, rel=0.05)
    browser.pinch((600, 350), 200, 300)
    assert browser.evaluate("PanoMvs.page.look.fov") == pytest.approx(fov * 2 / 3, rel=0.05)
    assert browser.evaluate("location.hash").startswith("#i=1,")


@pytest.mark.parametrize(("width", "height"), [(360, 740), (1600, 900)])
def test_everything_can_be_reached_on_small_and_large_windows(browser: Browser, width: int, height: int) -> None:
    browser.resize(width, height)
    browser.wait(f"Math.abs(PanoMvs.page.eye.aspect - {width / height}) < 0.001")
    settle(browser)
    shown = "[...document.querySelectorAll('#tools button:not([hidden])')]"
    boxes = f"{shown}.map((button) => button.getBoundingClientRect().toJSON())"
    buttons = browser.evaluate(boxes)
    assert len(buttons) == TOOLS
    for box in buttons:
        assert box["left"] >= 0
        assert box["right"] <= width
        assert box["bottom"] <= height
        assert box["height"] >= 36
    assert browser.evaluate("document.documentElement.scrollWidth") <= width
    if width < 520:
        assert browser.evaluate("document.getElementById('map').hidden")
        browser.press("n")
    figure = browser.evaluate("document.getElementById('map').getBoundingClientRect().toJSON()")
    assert 80 < figure["width"] < width / 2
    assert figure["bottom"] < min(box["top"] for box in buttons)
    browser.press("l")
    assert browser.evaluate("document.querySelectorAll('#panoramas button').length") == 3
    browser.press("m")
    said = browser.evaluate("document.getElementById('measured').getBoundingClientRect().toJSON()")
    assert figure["bottom"] < said["top"] < said["bottom"] <= min(box["top"] for box in buttons)


def test_all_controls_have_names_and_the_theme_can_be_changed(browser: Browser) -> None:
    named = "(e) => e.textContent.trim() || e.getAttribute('aria-label') || e.alt || e.getAttribute('aria-live')"
    controls = "[...document.querySelectorAll('button, canvas, nav, output, img, figure, [role]')]"
    assert browser.evaluate(f"{controls}.filter((e) => !({named})(e)).map((e) => e.outerHTML)") == [
        '<p id="problem" role="alert" hidden=""></p>'
    ]
    grounds = []
    for _ in range(2):
        browser.press("t")
        settle(browser)
        grounds.append(browser.screenshot()[5, 700].astype(int).sum())
    assert abs(grounds[0] - grounds[1]) > 300


def test_the_page_is_as_dark_or_light_as_the_system(browser: Browser) -> None:
    for scheme in browser.schemes:
        browser.prefer(scheme)
        browser.wait("PanoMvs.page.dirty || true")
        settle(browser)
        ground = browser.screenshot()[5, 700].astype(int).sum()
        assert ground < 150 if scheme == "dark" else ground > 600


@pytest.mark.parametrize("window", ["chromium"], indirect=True)  # Firefox cannot change the preference while it runs
def test_reduced_motion_jumps(browser: Browser) -> None:
    browser.prefer(browser.schemes[0], reduced_motion=True)
    try:
        step_inside(browser, 0)
        browser.evaluate("PanoMvs.page.stepInside(PanoMvs.page.panoramas[1]).then(() => 0)")
        assert browser.evaluate("[PanoMvs.page.here.index, PanoMvs.page.move]") == [1, None]
    finally:
        browser.prefer(browser.schemes[0])


def test_nothing_but_the_files_of_the_page_can_be_loaded(browser: Browser) -> None:
    """The policy refuses inline code, evaluated code, and connections."""
    assert browser.evaluate("fetch('https://example.org/').then(() => 'sent', () => 'refused')") == "refused"
    assert (
        browser.evaluate(
            """new Promise((resolve) => {
          const refused = ({ effectiveDirective }) => resolve(effectiveDirective);
          document.addEventListener("securitypolicyviolation", refused, { once: true });
          document.head.append(Object.assign(document.createElement("script"), { textContent: "window.ran = true" }));
        })"""
        )
        == "script-src-elem"
    )
    assert browser.evaluate("window.ran") is None
    names = browser.evaluate("performance.getEntriesByType('resource').map(({name}) => name)")
    assert not [name for name in names if not name.startswith(("file:", "data:", "https://example.org/"))]
    assert browser.evaluate("document.cookie + Object.keys(localStorage)") == ""
    assert len(browser.console()) >= 2


def test_the_coarser_surface_of_motion_shows_the_same_with_fewer_triangles(browser: Browser) -> None:
    before = browser.screenshot()
    whole, coarse = browser.evaluate(
        """PanoMvs.page.surface.group.children.reduce((sums, { geometry }) => {
          const corners = coarser(geometry.index.array, geometry.attributes.position.array, 3);
          const counts = [sums[0] + geometry.index.count, sums[1] + corners.length];
          geometry.setIndex([...corners]);
          PanoMvs.page.changed();
          return counts;
        }, [0, 0])"""
    )
    settle(browser)
    assert 0 < coarse < 0.6 * whole
    drawn = [
        np.abs(picture.astype(int) - picture[5, 700]).sum(axis=-1) > 40 for picture in (before, browser.screenshot())
    ]
    assert 0 < (drawn[0] != drawn[1]).mean() < 0.01 < drawn[0].mean()


def test_a_missing_file_is_named(browser: Browser, page: Path) -> None:
    tile = page.parent / "data" / "panorama" / "2" / "0-0-0.js"
    kept = tile.read_text()
    tile.unlink()
    try:
        browser.evaluate("PanoMvs.page.stepInside(PanoMvs.page.panoramas[2]), 0")
        browser.wait("!document.getElementById('problem').hidden")
        assert "panorama/2/0-0-0.js is missing" in browser.evaluate("document.getElementById('problem').textContent")
    finally:
        tile.write_text(kept)
    browser.console()


def test_of_200_large_panoramas_only_what_is_seen_is_loaded(window: Browser, tmp_path: Path) -> None:
    window.resize(1280, 720)
    visited = (7, 120, 199, 3, 60, 140)
    page = large_page(tmp_path / "page", panoramas=200, levels=4, present=visited)
    show(window, page.as_uri())

    def loaded() -> int:
        return sum((page.parent / "data" / f"{key}.js").stat().st_size for key in window.evaluate("PanoMvs.loaded"))

    assert loaded() < 300_000
    assert window.evaluate("PanoMvs.loaded") == ["scene"]
    for index in visited:
        step_inside(window, index)
    keys = window.evaluate("PanoMvs.loaded")
    assert len(keys) < 6 * 16
    window.evaluate("PanoMvs.page.zoom(0.3), 0")
    settle(window)
    assert any(key.startswith("panorama/140/3-") for key in window.evaluate("PanoMvs.loaded"))
    assert window.evaluate("PanoMvs.page.panoramas.filter(({group}) => group.children.length).length") <= 4
    assert window.evaluate("Math.max(...PanoMvs.page.panoramas.map(({tiles}) => tiles.size))") <= 24
    assert window.console() == []
