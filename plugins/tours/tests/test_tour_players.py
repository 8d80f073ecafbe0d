"""Tours in Pannellum and Marzipano themselves, from tilted panoramas with marks painted at true directions."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import ArrayLike, NDArray
from pano_mvs_tours.exports import PanoramasParams, TourExportParams, panoramas, tour_of_panoramas
from pano_mvs_tours.tour_players import MARZIPANO, PANNELLUM

from pano_mvs.api import Context, Panorama, Pose, Poses, WorldAxes
from pano_mvs.geometry import Rigid3, ray_grid, rotation_from_rotvec
from pano_mvs.scene import FilePart
from pano_mvs.scene.image_file import write_png
from tests.browsers.browser import Browser
from tests.browsers.chromium import chromium
from tests.browsers.server import served
from tests.foreign import npm_packages

pytestmark = pytest.mark.browser

SIZE_HW = (1024, 2048)
WINDOW_WH = (800, 600)
FOV_DEG = 60.0
# With this field of view, upwards or sideways, a tenth of a degree is at least this wide in the middle of the window.
TENTH_OF_A_DEGREE_PX = np.deg2rad(0.1) * WINDOW_WH[1] / 2 / np.tan(np.deg2rad(FOV_DEG / 2))
CAMERAS = {
    "a.png": Rigid3.from_center(rotation_from_rotvec(np.array([0.2, 1.1, -0.3])), [0.0, 0.0, 0.0]),
    "<img src=x onerror=alert(1)>.png": Rigid3.from_center(
        rotation_from_rotvec(np.array([-0.4, 2.0, 0.1])), [2.0, -0.7, -1.5]
    ),
}
TO_B = np.subtract(*(camera.center for camera in reversed(CAMERAS.values())))
NORTH = np.array([0.0, 0.0, 1.0])
HEADING_DEG = np.rad2deg(np.arctan2(TO_B[0], TO_B[2]))
PITCH_DEG = np.rad2deg(np.arctan2(-TO_B[1], np.hypot(TO_B[0], TO_B[2])))

PAGES = {
    "pannellum": {
        "ready": "window.viewer && viewer.isLoaded() && viewer.getScene() == 'scene_0'",
        "look": "viewer.lookAt({pitch_deg}, {yaw_deg}, {fov_deg}, false) && 0",
        "spot": "document.querySelector('.pnlm-hotspot').getBoundingClientRect().toJSON()",
    },
    "marzipano": {
        "ready": "document.querySelector('canvas') && scenes.get('scene_0').scene.visible()",
        "look": "scenes.get('scene_0').scene.view().setParameters("
        "{{yaw: {yaw_deg} / 180 * Math.PI, pitch: -{pitch_deg} / 180 * Math.PI, fov: {fov_deg} / 180 * Math.PI}}) && 0",
        "spot": "scenes.get('scene_0').scene.hotspotContainer().listHotspots()[0].domElement().querySelector('button')"
        ".getBoundingClientRect().toJSON()",
    },
}


def marked(camera: Rigid3, to_other: ArrayLike) -> NDArray[np.uint8]:
    """Return a grey panorama with a red mark at the other camera, and a green one in the north."""
    picture = np.full((*SIZE_HW, 3), 128.0)
    for direction, color in ((to_other, (255, 0, 0)), (NORTH, (0, 255, 0))):
        unit = camera.rotation @ (np.asarray(direction) / np.linalg.norm(direction))
        away = np.linalg.norm(ray_grid(SIZE_HW) - unit, axis=-1)
        share = np.clip((0.03 - away) * SIZE_HW[1] / (2 * np.pi) + 0.5, 0, 1)[..., None]
        picture = picture * (1 - share) + share * color
    return np.asarray(np.rint(picture), np.uint8)


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Export a tour of two tilted panoramas that face along their path, and serve it with the players beside it."""
    folder = tmp_path_factory.mktemp("tour")
    poses = Poses.without_points(CAMERAS, frame="", scale="", metric=False, axes=WorldAxes.NORTH)
    images, made = {}, {}
    for name, camera in CAMERAS.items():
        write_png(folder / name, marked(camera, TO_B if name == "a.png" else -TO_B))
        images[name] = Panorama(FilePart(folder / name, external=True), SIZE_HW, SIZE_HW)
        (folder / name[:4]).mkdir()
        ctx = Context(np.random.default_rng(0), folder / name[:4])
        params = PanoramasParams(facing="path", format="png", ranges=False)
        made[name] = panoramas(images[name], Pose(camera), poses, None, params, ctx)
    players = TourExportParams(players=("pannellum", "marzipano"))
    files = tour_of_panoramas(made, poses, images, players, Context(np.random.default_rng(0), folder)).files
    site = folder / "site"
    site.mkdir()
    for target, path in files.items():
        text = path.read_text().replace('pannellum.viewer("', 'window.viewer = pannellum.viewer("')
        local = re.sub(r"https://cdn\.jsdelivr\.net/npm/(\w+)@[\d.]+/", r"node_modules/\1/", text)
        (site / Path(target).name).write_text(local)
    for name, picture in made.items():
        picture.files["panoramas/{item}.png"].rename(site / name)
    npm_packages(site, f"pannellum@{PANNELLUM}", f"marzipano@{MARZIPANO}")
    with served(site) as server:
        yield server.address


@pytest.fixture(scope="module")
def window() -> Iterator[Browser]:
    with chromium(width=WINDOW_WH[0], height=WINDOW_WH[1]) as browser:
        yield browser


@pytest.fixture(params=list(PAGES))
def player(request: pytest.FixtureRequest, window: Browser, address: str) -> str:
    """Open the tour in a player, without anything that covers a mark."""
    name = str(request.param)
    window.open(f"{address}{'tour' if name == 'pannellum' else name}.html")
    window.wait(f"(() => {{ try {{ return {PAGES[name]['ready']}; }} catch {{ return false; }} }})()")
    window.evaluate("document.head.insertAdjacentHTML('beforeend', '<style>.pnlm-ui, button {opacity: 0 !important}')")
    return name


def mark_after_look(window: Browser, player: str, yaw_deg: float, pitch_deg: float, *, channel: int) -> np.ndarray:
    """Turn the view, and return where the middle of the red (0) or green (1) mark then is, (x, y) in pixels."""
    window.evaluate(PAGES[player]["look"].format(yaw_deg=yaw_deg, pitch_deg=pitch_deg, fov_deg=FOV_DEG))
    before = np.zeros(())
    for _ in range(50):
        window.evaluate("new Promise((done) => setTimeout(done, 200))")
        shown = window.screenshot().astype(float)
        color = np.clip(shown[..., channel] - np.delete(shown, channel, axis=2).max(axis=2) - 40, 0, None)
        if color.sum() > 1000 and np.array_equal(shown, before):
            rows, columns = np.indices(color.shape) + 0.5
            return np.array([(columns * color).sum() / color.sum(), (rows * color).sum() / color.sum()])
        before = shown
    raise AssertionError(f"{player} never shows the mark; console: {window.console()}")


@pytest.mark.parametrize(("right_deg", "up_deg"), [(0, 0), (8, -5), (-6, 7)])
def test_links_lie_on_the_other_cameras(window: Browser, player: str, right_deg: float, up_deg: float) -> None:
    """The picture faces the path, so that the link has yaw 0; its pitch is that of the level world."""
    mark = mark_after_look(window, player, right_deg, PITCH_DEG + up_deg, channel=0)
    box = window.evaluate(PAGES[player]["spot"])
    spot = np.array([(box["left"] + box["right"]) / 2, (box["top"] + box["bottom"]) / 2])
    assert mark == pytest.approx(spot, abs=TENTH_OF_A_DEGREE_PX)
    if not right_deg:
        assert mark == pytest.approx(np.array(WINDOW_WH) / 2, abs=TENTH_OF_A_DEGREE_PX)


def test_north_is_level_and_where_the_heading_says(window: Browser, player: str) -> None:
    mark = mark_after_look(window, player, -HEADING_DEG, 0, channel=1)
    assert mark == pytest.approx(np.array(WINDOW_WH) / 2, abs=TENTH_OF_A_DEGREE_PX)
    if player == "pannellum":
        assert window.evaluate("viewer.getNorthOffset()") == pytest.approx(HEADING_DEG, abs=1e-6)


def test_a_link_leads_to_the_other_camera_and_on(window: Browser, player: str) -> None:
    """One arrives looking the way one went: away from the camera that one left."""
    click = {"pannellum": "document.querySelector('.pnlm-hotspot')", "marzipano": "document.querySelector('button')"}
    window.evaluate(f"{click[player]}.dispatchEvent(new MouseEvent('click', {{bubbles: true}}))")
    arrived = {
        "pannellum": "viewer.getScene() == 'scene_1' && viewer.isLoaded() && [viewer.getYaw(), viewer.getPitch()]",
        "marzipano": "viewer.scene() == scenes.get('scene_1').scene && "
        "[viewer.view().yaw() * 180 / Math.PI, viewer.view().pitch() * 180 / Math.PI]",
    }
    window.wait(arrived[player])
    # The last panorama faces the way that the path came.
    assert window.evaluate(arrived[player]) == pytest.approx([0, 0], abs=0.1)


def test_a_title_is_text(window: Browser, player: str) -> None:
    """Pannellum took the names of files for HTML, with the scripts in them."""
    spots = {"pannellum": ".pnlm-hotspot span", "marzipano": "button"}
    shown = f"[...document.querySelectorAll('{spots[player]}')].map((spot) => spot.textContent)"
    assert "<img src=x onerror=alert(1)>" in window.evaluate(shown)
    assert window.evaluate("document.querySelectorAll('img[src=x]').length") == 0
